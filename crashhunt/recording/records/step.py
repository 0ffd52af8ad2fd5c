"""A step that is complete: int64 step, float64 time in s, float64 reward of each agent, and the values of the scene.

These are, of all actors of the roster, x and y alternating, then all headings, then all speeds.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

import numpy as np

from crashhunt.recording._divergence import Divergence, first_difference
from crashhunt.recording._reading import StepRecord
from crashhunt.recording.records import roster
from crashhunt.recording.records._type import SCENE, Form, RecordType
from crashhunt.world import Scene

if TYPE_CHECKING:
    from collections.abc import Mapping

    from crashhunt.recording._reading import Reading, SceneParts
    from crashhunt.recording.records._type import Fields, Message
    from crashhunt.recording.records.prologue import AgentChannel, Prologue

__all__ = ["TYPE", "time_of"]

_HEAD = struct.Struct("<qd")


def time_of(payload: bytes) -> float:
    """Return the simulation time of a step, in s."""
    time_s: float = _HEAD.unpack_from(payload)[1]
    return time_s


class _StepForm(Form):
    messages: Mapping[str, Mapping[str, str]] = {
        "Step": {
            "step": "int64",
            "time_s": "double",
            "rewards": "double*",
            "positions": "double*",
            "headings": "double*",
            "speeds": "double*",
        }
    }

    def to_message(self, payload: bytes, prologue: Prologue, aux: int) -> tuple[str, Fields]:
        step, time_s = _HEAD.unpack_from(payload)
        values = np.frombuffer(payload, "<f8", offset=_HEAD.size).tolist()
        agents = len(prologue.agents)
        rewards, scene = values[:agents], values[agents:]
        count = len(scene) // 4
        return "Step", {
            "step": step,
            "time_s": time_s,
            "rewards": rewards,
            "positions": scene[: 2 * count],
            "headings": scene[2 * count : 3 * count],
            "speeds": scene[3 * count :],
        }

    def to_payload(self, message: Message, prologue: Prologue | None, aux: int) -> bytes:
        values = np.array([*message.rewards, *message.positions, *message.headings, *message.speeds], "<f8")
        return _HEAD.pack(message.step, message.time_s) + values.tobytes()


def _read(reading: Reading, _aux: int, payload: bytes) -> None:
    agents, steps, current = reading.prologue.agents, reading.steps, reading.current
    step, time_s = _HEAD.unpack_from(payload)
    values = np.frombuffer(payload, "<f8", offset=_HEAD.size).tolist()
    rewards, values = values[: len(agents)], values[len(agents) :]
    count = len(reading.roster)
    if step != len(steps) or len(rewards) != len(agents) or len(values) != 4 * count:
        raise ValueError(f"step {step} follows {len(steps) - 1}")
    points = list(zip(values[: 2 * count : 2], values[1 : 2 * count : 2], strict=True))
    headings, speeds = values[2 * count : 3 * count], values[3 * count :]
    parts: SceneParts = {"heights": [], "grades": [], **reading.scene}
    scene = current.scene = Scene(time_s, reading.roster, points, headings, speeds, **parts)
    if len(scene.heights) not in (0, count) or any(row >= count for row in scene.spines):
        raise ValueError(f"step {step} is about more actors than there are")
    scene.events = reading.events
    scene.previous = steps[-1].scene if steps else None
    current.step = step
    current.rewards = {agent.id: reward for agent, reward in zip(agents, rewards, strict=True)}
    steps.append(current)
    reading.current, reading.scene, reading.events = StepRecord(step + 1), {}, ()


def _difference(left: StepRecord, right: StepRecord, _: AgentChannel | None) -> Divergence | None:
    step, was, now = left.step, left.scene, right.scene
    if was is None or now is None:
        return None if was is now else Divergence(step, "", SCENE, was and "present", now and "present")
    for name in left.rewards:
        if np.float64(left.rewards[name]).tobytes() != np.float64(right.rewards[name]).tobytes():
            return Divergence(step, name, "reward", left.rewards[name], right.rewards[name])
    if was.time_s != now.time_s:
        return Divergence(step, "", "time_s", was.time_s, now.time_s)
    other = roster.difference(step, was.roster, now.roster)
    if other is not None:
        return other
    was_data, now_data = was.data, now.data
    if was_data.tobytes() == now_data.tobytes():
        return None
    row, column = first_difference(was_data, now_data)
    name = ("x", "y", "heading", "speed")[column]
    values = float(was_data[row, column]), float(now_data[row, column])
    return Divergence(step, was.roster.actors[row].id, f"scene.{name}", *values, (SCENE, (column,)))


def _value(step: StepRecord, actor: str, index: tuple[int, ...]) -> object:
    if step.scene is None or actor not in step.scene.roster.index:
        return None
    return float(step.scene.data[step.scene.roster.index[actor], index[0]])


TYPE = RecordType(6, SCENE, "/scene", _StepForm(), _read, _difference, _value)
