"""The bridge to ROS 2 on the guide page, against a recorded session and a stand-in for rclpy."""

from __future__ import annotations

import json
import os
import subprocess
import sys

from json_schemas import validator
from pages import Page

STAND_IN = {
    "rclpy/__init__.py": """
import json, os
record = open(os.environ["RECORDED"], "a")
answers = iter(json.load(open(os.environ["ANSWERS"])))
state = {"clock": 0, "callback": None}

class Publisher:
    def __init__(self, topic): self.topic = topic
    def publish(self, message):
        if self.topic == "/clock":
            state["clock"] = message.clock.sec * 10**9 + message.clock.nanosec
            record.write(json.dumps([self.topic, state["clock"]]) + "\\n")
        else:
            record.write(json.dumps([self.topic, list(message.data)]) + "\\n")
        record.flush()

class Node:
    def create_publisher(self, kind, topic, depth): return Publisher(topic)
    def create_subscription(self, kind, topic, callback, depth): state["callback"] = callback
    def destroy_node(self): record.write('"destroyed"\\n')

def init(): pass
def shutdown(): record.close()
def create_node(name): return Node()

def spin_once(node):
    from geometry_msgs.msg import TwistStamped
    late, speed = next(answers)
    command = TwistStamped()
    command.header.stamp.sec, command.header.stamp.nanosec = divmod(state["clock"] - late, 10**9)
    command.twist.linear.x = speed
    state["callback"](command)
""",
    "geometry_msgs/msg.py": """
from types import SimpleNamespace as Space
class TwistStamped:
    def __init__(self): self.header, self.twist = Space(stamp=Space(sec=0, nanosec=0)), Space(linear=Space(x=0.0))
""",
    "rosgraph_msgs/msg.py": """
from types import SimpleNamespace as Space
class Clock:
    def __init__(self): self.clock = Space(sec=0, nanosec=0)
""",
    "std_msgs/msg.py": """
class Float64MultiArray:
    def __init__(self, data): self.data = data
""",
}


def test_the_bridge_publishes_time_and_observation_and_takes_the_command_of_the_step(tmp_path):
    for name, text in STAND_IN.items():
        file = tmp_path / name
        file.parent.mkdir(exist_ok=True)
        file.write_text(text, encoding="utf-8")
    (tmp_path / "ros_bridge.py").write_text(Page("ros").files["ros_bridge.py"], encoding="utf-8")
    second = 10**9
    # The second command belongs to an earlier step.
    (tmp_path / "answers").write_text(json.dumps([[0, 9.5], [second // 10, 1.0], [0, 8.25], [0, 7.0]]))
    rows = [[[1.0, 0.5], [0.0, -3.25]], [[1.0, 1.5], [1.0, -2.25]], [[1.0, 2.5], [0.0, 0.0]]]
    observe = [{"type": "observe", "step": step, "time_s": step / 10, "observation": rows[step]} for step in range(3)]
    hello, reset, close = {"type": "hello", "protocol": 1}, {"type": "reset", "seed": 7}, {"type": "close"}
    asked = [hello, reset, *observe[:2], hello, reset, {**observe[2], "step": 0, "time_s": 0.0}, close]
    done = subprocess.run(
        [sys.executable, "ros_bridge.py"], input="".join(f"{json.dumps(each)}\n" for each in asked), cwd=tmp_path,
        capture_output=True, text=True, check=True,
        env={**os.environ, "RECORDED": str(tmp_path / "recorded"), "ANSWERS": str(tmp_path / "answers")},
    )  # fmt: skip
    acts = [{"type": "act", "action": [speed, 0]} for speed in (9.5, 8.25, 7.0)]
    answers = [json.loads(line) for line in done.stdout.splitlines()]
    assert answers == [{"type": "ready"}, {"type": "ok"}, *acts[:2], {"type": "ready"}, {"type": "ok"}, acts[2]]
    for answer in answers:
        validator("messages/exec-answer").validate(answer)
    times = [second, second + second // 10, 2 * second + second // 10]
    expected = [
        line
        for time, each in zip(times, rows, strict=True)
        for line in (["/clock", time], ["/crashhunt/observation", [number for row in each for number in row]])
    ]
    published = [json.loads(line) for line in (tmp_path / "recorded").read_text().splitlines()]
    assert published == [*expected, "destroyed"]
