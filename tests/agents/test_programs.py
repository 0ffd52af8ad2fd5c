"""Agents that are programs: the protocol, the harm that programs do, and what is left of their processes."""

from __future__ import annotations

import json
import os
import re
import signal
import time
from contextlib import nullcontext
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from conftest import mostly_nightly
from gymnasium import spaces
from json_schemas import validator
from programs import COMPILER, PYTHON, compile_program, write_binary_program, write_program
from simulated import Simulated, answers_in_python, observations

import crashhunt
from crashhunt.agents import ProgramFactory
from crashhunt.agents._programs import _described_observation, hello_of
from crashhunt.base import forks
from crashhunt.base.agent_locators import command_of, files_of
from crashhunt.base.errors import ActionError, PluginError, ProgramError
from crashhunt.panels import labelled
from crashhunt.plans import Request, plan_with_code, takes_of
from crashhunt.scenario import ObservationSetup
from crashhunt.simulators import AccelerationAndLaneChange, Kinematics, MetaAction, SpeedAndLaneChange
from crashhunt.trial import Range, signature_of
from crashhunt.world import MapLane, RoadMap, StopLine, VehicleData


class WithRoads(Simulated):
    """A simulator whose map has as many lanes as `lanes` says."""

    lanes = 1

    def prepare_road_maps(self): ...

    def road_map(self, agent):
        lines = np.array([[0.0, 1.0], [2.0, 1.0], [4.0, 1.0]])
        lane = MapLane(
            id="0", road="r", index=0, center=lines, left_line=lines + 1.5, right_line=lines - 1.5, width=3.0,
            speed_limit=13.9, length=4.0, successors=("1",), predecessors=(), left="", right="", can_change_left=False,
            can_change_right=False, allowed=frozenset({"passenger", "bus"}), is_open=True, is_internal=False,
        )  # fmt: skip
        stop = StopLine(lane="0", junction="j", ends=lines[:2], kind="yield", signal="")
        names = map(str, range(self.lanes))
        return RoadMap(
            lanes={name: replace(lane, id=name) for name in names}, stop_lines=(stop,), route=("0",),
            reference_path=lines, is_left_hand=False,
        )  # fmt: skip

    def vehicle_data(self, agent):
        numbers = dict.fromkeys((field.name for field in fields(VehicleData)), 1.0)
        return VehicleData(**{**numbers, "kind": "passenger", "wheelbase": 2.8})


def agent_of(locator, folder, *, form=None, limit_s=None, is_forked=False, **arguments):
    return ProgramFactory(locator).agent(
        "ego", Simulated(form), arguments, folder=folder, files={}, limit_s=limit_s, is_forked=is_forked
    )


CAUGHT = 'Traceback (most recent call last):\n  File "a.py", line 1, in f\n    g()\nValueError: it was caught\n'


@pytest.mark.parametrize(
    ("kind", "message"),
    {
        "garbage": "its answer to observe of step 3 is not MessagePack",
        "number": "its answer to observe of step 3 is not of type 'act'",
        "long": "its answer to observe of step 3 is longer than 16 MB: ",
        "empty": "its answer to observe of step 3 is not MessagePack: an empty message; write only messages to "
        "standard output, each after its length in 4 bytes, and logs to standard error",
        "half": "exited with 0 instead of answering observe of step 3, in the middle of a message",
    }.items(),
)
def test_harm_in_binary_messages_is_an_error_of_the_agent(tmp_path, kind, message):
    agent = agent_of(f"exec:{write_binary_program(tmp_path)} {kind}", tmp_path)
    agent.reset(1)
    with pytest.raises(ProgramError, match=f"^ego: .*{re.escape(message)}"):
        drive(agent)
    agent.close()


@pytest.mark.parametrize(
    ("log", "reason"),
    [
        (
            "==7==ERROR\nSUMMARY: AddressSanitizer: heap-use-after-free a.cpp:14:9 in f()\n==7==ABORTING",
            "f()",
        ),
        ("planner.cpp:9:3: runtime error: division by zero", "division by zero"),
        ("planner: a.cpp:7: int main(): Assertion `lanes > 0' failed.", "Assertion `lanes > 0' failed."),
        (
            "terminate called after throwing an instance of 'std::out_of_range'\n  what():  lane 5",
            ": std::out_of_range: lane 5",
        ),
        ("ready\n*** stack smashing detected ***: terminated", ": *** stack smashing detected ***: terminated"),
        ("ready\nfree(): invalid pointer", ": free(): invalid pointer"),
        (
            "ready\nthread 'main' (7) panicked at a.rs:1:88:\nindex out of bounds\nstack:",
            ": a.rs:1:88: index out of bounds",
        ),
        ("panic: no lane\n\ngoroutine 1 [running]:\n", ": panic: no lane"),
        ('Exception in thread "main" P: no lane\n\tat P.main(P.java:1)\n', ": P: no lane"),
        (
            "Error: it was caught\n    at b\n\na.js:1\n\nTypeError: no lane\n    at b\n\nNode.js v20.20.2\n",
            ": TypeError: no lane",
        ),
        (
            "RangeError: no\n    at f (a.js:2) {\n code: 1,\n  [cause]: Error: a\n      at f\n}\n\nNode.js v20.1\n",
            ": RangeError: no",
        ),
        (f"{CAUGHT}{CAUGHT.replace('was caught', 'ends')}", ": ValueError: it ends"),
        (f"{CAUGHT}goodbye", "answering hello"),
        ("goodbye", "answering hello"),
    ],
    ids=[
        "address",
        "undefined",
        "assert",
        "exception",
        "stack",
        "heap",
        "rust",
        "go",
        "java",
        "node",
        "node with a cause",
        "python",
        "caught",
        "none",
    ],
)
def test_the_reason_in_the_log_of_a_program_that_ends_is_part_of_the_error(tmp_path, capfd, log, reason):
    program = tmp_path / "ends"
    (tmp_path / "text").write_text(log, encoding="utf-8")
    program.write_text(f"#!/bin/sh\ncat {tmp_path}/text >&2\nexit 1\n", encoding="utf-8")
    program.chmod(0o755)
    agent = agent_of(f"exec:{program}", tmp_path)
    with pytest.raises(ProgramError, match=f"^ego: the program exited with 1 instead of .*{re.escape(reason)}$"):
        agent.act(observations(1)[0])
    agent.close()


def drive(agent):
    return [agent.act(seen) for seen in observations()]


@pytest.fixture
def planner(tmp_path):
    return write_program(tmp_path)


def test_programs_in_python_and_c_and_one_with_binary_messages_act_like_the_agent_in_python(tmp_path, planner):
    wanted = answers_in_python(speed=9.125)
    programs = [planner, write_binary_program(tmp_path), *([compile_program(tmp_path, "compiled")] if COMPILER else [])]
    for program in programs:
        agent = agent_of(f"exec:{program}", tmp_path / "scratch", speed=9.125)
        agent.reset(7)
        assert [tuple(agent.act(seen)) for seen in observations()] == wanted
        agent.close()
    assert {speed for speed, _ in wanted} == {0.0, 9.125}


def test_the_command_is_split_as_a_shell_would_and_runs_in_the_scratch_folder_without_a_shell(tmp_path):
    said = tmp_path / "said"
    program = tmp_path / "two words"
    program.write_text(f'#!/bin/sh\nprintf "%s|" "$PWD" "$@" > {said}\n', encoding="utf-8")
    program.chmod(0o755)
    agent = agent_of(f"exec:'{program}' --mode 'a b' $HOME ;", tmp_path / "scratch")
    agent.reset(1)
    with pytest.raises(ProgramError, match="exited with 0 instead of answering hello"):
        agent.act(observations()[0])
    agent.close()
    assert said.read_text().split("|") == [str(tmp_path / "scratch" / "agent-ego"), "--mode", "a b", "$HOME", ";", ""]


def test_messages_are_those_of_the_protocol(tmp_path):
    program = tmp_path / "echo"
    log = tmp_path / "log"
    answers = ('{"type":"ready"}', '{"type":"ok"}', '{"type":"act","action":[2]}', '{"type":"act","action":3}')
    lines = [f"read -r line; echo \"$line\" >&3; echo '{answer}'" for answer in answers]
    lines = ["#!/bin/sh", f"exec 3> {log}", *lines, 'read -r line; echo "$line" >&3', ""]
    program.write_text("\n".join(lines), encoding="utf-8")
    program.chmod(0o755)
    agent = agent_of(f"exec:{program}", tmp_path, form=MetaAction(), speed=5.0, mode="test")
    agent.reset(7)
    seen = np.zeros((8, 7), np.float32)
    seen[0, 1] = 0.5
    assert [agent.act(seen), agent.act(seen)] == [2, 3]
    agent.close()
    rows = str([[0.0, 0.5, *[0.0] * 5], *[[0.0] * 7] * 7]).replace(" ", "")
    hello = (
        '{"type":"hello","protocol":1,"agent":"ego","arguments":{"speed":5.0,"mode":"test"},"observation":{"kinematics":'
        '{"shape":[8,7],"columns":["presence","x","y","vx","vy","cos_h","sin_h"],"units":["","m","m","m/s","m/s","",""]'
        '}},"action":{"shape":[],"columns":["meta_action"],"units":[""],"bounds":[[0,4]],"meanings":["LANE_LEFT","IDLE",'
        '"LANE_RIGHT","FASTER","SLOWER"]},"step_length_s":0.1}'
    )
    assert log.read_text().splitlines() == [
        hello,
        '{"type":"reset","seed":7}',
        f'{{"type":"observe","step":0,"time_s":0.0,"observation":{rows}}}',
        f'{{"type":"observe","step":1,"time_s":0.1,"observation":{rows}}}',
        '{"type":"close"}',
    ]


def test_hello_has_the_units_of_every_form_of_actions():
    simulator = Simulated(AccelerationAndLaneChange())
    assert hello_of("ego", simulator, {})["action"]["units"] == ["m/s²", ""]


def test_hello_has_no_units_for_normalised_values_and_for_those_of_an_unknown_scale():
    def units(space, names):
        return _described_observation(space, names)["kinematics"]["units"]

    for normalize, expected in ((False, ["m", "m/s"]), (True, ["", ""])):
        table = Kinematics(ObservationSetup(features=("x", "vx"), normalize=normalize))
        assert units(table.space, table.features) == expected
    assert units(spaces.Box(-np.inf, np.inf, (5, 2)), ("x", "vx")) == ["", ""]


HARMS = [
    ("garbage", "observe", "its answer to observe of step 3 is not JSON: thinking"),
    (
        "half",
        "observe",
        'exited with 0 instead of answering observe of step 3, in the middle of a message: {"type": ',
    ),
    ("closes", "observe", "has closed its end instead of answering observe of step 3, and is still running"),
    ("SIGSEGV", "observe", "died of SIGSEGV instead of answering observe of step 3"),
    ("SIGSEGV", "reset", "died of SIGSEGV instead of answering reset"),
    ("exits", "hello", "exited with 3 instead of answering hello"),
    ("protocol", "hello", "its protocol is 2 (allowed: 1)"),
    ("format", "hello", 'its format is "xml" (allowed: json or msgpack)'),
    ("other", "observe", "its answer to observe of step 3 is not of type 'act'"),
    ("without", "observe", "its answer to observe of step 3 has no action"),
    ("twice", "observe", "it has sent something before observe of step 4"),
    ("long", "observe", "its answer to observe of step 3 is longer than 16 MB"),
    ("flood", "observe", "exited with 1 instead of answering observe of step 3: its log has reached 64 MB"),
]


@pytest.mark.parametrize(
    ("kind", "when", "message"),
    mostly_nightly(HARMS, HARMS[::2]),
)
def test_harm_is_an_error_that_names_the_agent_and_the_message(planner, tmp_path, kind, when, message):
    agent = agent_of(f"exec:{planner} {kind} {when}", tmp_path)
    agent.reset(1)
    kept = os.dup(2)
    with open(tmp_path / "log", "wb") as log:
        os.dup2(log.fileno(), 2)
    try:
        with pytest.raises(ProgramError, match=f"^ego: .*{re.escape(message)}"):
            drive(agent)
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        agent.close()
    assert (tmp_path / "log").stat().st_size <= 64 << 20


@pytest.mark.parametrize("size", [(8, 7), (400, 400)])
def test_a_late_answer_is_an_error_that_names_the_step_also_if_the_program_does_not_read(planner, tmp_path, size):
    agent = agent_of(f"exec:{planner} late observe", tmp_path, limit_s=0.3)
    agent.reset(1)
    for seen in observations(3):
        agent.act(seen)
    agent._process._process.send_signal(signal.SIGSTOP)
    with pytest.raises(ProgramError, match=r"^ego: it has not answered observe of step 3 within 0\.3 s$"):
        agent.act(np.zeros(size, np.float32))
    agent._process._process.send_signal(signal.SIGCONT)
    agent.close()


def answering(folder, panels, *, before=""):
    """An agent whose program answers the first observation with panels."""
    program = folder / "shows"
    answers = ('{"type":"ready"}', '{"type":"ok"}', f'{{"type":"act","action":[2,0],"panels":{panels}}}')
    lines = [f"read -r line; {before} echo '{answer}'" for answer in answers]
    program.write_text("\n".join(["#!/bin/sh", *lines, "read -r line", ""]), encoding="utf-8")
    program.chmod(0o755)
    agent = agent_of(f"exec:{program}", folder)
    agent.reset(1)
    assert agent.act(observations(1)[0]) == [2, 0]
    agent.close()
    return agent


def test_panels_of_a_program_are_shown_by_the_kind_of_their_values(tmp_path):
    shown = '{"mode":"wait","costs":[1,2.5],"grid":[[0,1],[2,3]],"weights":{"a":1,"b":2},"plans":{"a":[1,2],"b":[3,4]}}'
    panels = dict(labelled(answering(tmp_path, shown).panels()))
    assert {label: type(panel).__name__ for label, panel in panels.items()} == {
        "mode": "Text", "costs": "Curve", "grid": "Heatmap", "weights": "Bar", "plans": "Curve",
    }  # fmt: skip
    assert all(panel.draw().dtype == np.uint8 for panel in panels.values())
    assert answering(tmp_path, "null").panels() == {}


@pytest.mark.parametrize("shown", ['{"odd":[[1],[2,3]]}', '{"odd":{"a":"b"}}', '{"odd":[]}', '{"odd":null}'])
def test_panels_that_cannot_be_shown_fail_when_they_are_shown(tmp_path, shown):
    with pytest.raises(ValueError, match="the panel 'odd' is neither text nor numbers"):
        answering(tmp_path, shown).panels()
    with pytest.raises(ValueError, match="panels is not an object"):
        answering(tmp_path, "[1]").panels()


def test_a_script_moves_the_messages_of_a_program_that_prints_to_another_descriptor(tmp_path, capfd):
    page = (Path(crashhunt.__file__).parent / "guide" / "reference" / "exec-protocol.md").read_text(encoding="utf-8")
    script = next(block for block in re.findall(r"```text\n(.*?)```", page, re.DOTALL) if "$@" in block)
    (tmp_path / "quiet.sh").write_text(script, encoding="utf-8")
    (tmp_path / "quiet.sh").chmod(0o755)
    program = write_program(tmp_path)
    answer = "print('hm', flush=True); os.write(3, f'{json.dumps(message)}\\n'.encode())"
    text = program.read_text(encoding="utf-8").replace("print(json.dumps(message), flush=True)", answer)
    program.write_text(text, encoding="utf-8")
    agent = agent_of(f"exec:{tmp_path}/quiet.sh {program}", tmp_path, speed=9.0)
    agent.reset(1)
    assert {tuple(agent.act(seen)) for seen in observations()} == {(9.0, 0), (0.0, 0)}
    agent.close()
    assert capfd.readouterr().err.count("hm") == 22


def test_a_program_does_not_import_from_the_code_of_a_snapshot(tmp_path, monkeypatch):
    code = tmp_path / "snapshot" / "code"
    (code / "crashhunt").mkdir(parents=True)
    (code.parent / "manifest.json").write_text("{}", encoding="utf-8")
    monkeypatch.setattr("crashhunt.base.layout.PACKAGE", code / "crashhunt")
    monkeypatch.setenv("PYTHONPATH", f"{code}:{code}/@project:/my/modules")
    program = tmp_path / "tells"
    program.write_text("#!/bin/sh\nread -r line\necho $PYTHONPATH >&2\nexit 3\n", encoding="utf-8")
    program.chmod(0o755)
    with pytest.raises(ProgramError, match=r"\(its last output: /my/modules\)"):
        ProgramFactory(f"exec:{program}").declared_signature()


@pytest.mark.parametrize("is_binary", [False, True])
def test_a_fork_continues_with_a_program_that_has_answered_all_earlier_observations(tmp_path, planner, is_binary):
    agent = agent_of(f"exec:{write_binary_program(tmp_path) if is_binary else planner}", tmp_path, is_forked=True)
    known = replace(forks.held(), threads=forks.threads())
    agent.reset(1)
    seen = observations()
    before = [agent.act(each) for each in seen[:8]]
    twice = [forks.Copy(lambda: {"actions": [agent.act(each) for each in seen[8:]]}, known) for _ in range(2)]
    answers = [one.answer(20)["actions"] for one in twice]
    actions = [agent.act(each) for each in seen[8:]]
    agent.close()
    assert answers == [actions, actions]
    assert len({tuple(action) for action in before + actions}) > 1
    assert not list(tmp_path.glob("agent-ego*/*"))
    forks.Copy(dict, known).end()  # nothing is left that cannot be forked


MOODY = """\
#!/bin/sh
read -r hello; echo '{"type": "ready"}'
read -r reset; echo '{"type": "ok"}'
while read -r line && [ "$line" != '{"type":"close"}' ]; do echo "{\\"type\\": \\"act\\", \\"action\\": [$$, 0]}"; done
"""


def test_a_fork_whose_program_answers_otherwise_ends_without_an_answer(tmp_path):
    program = tmp_path / "moody"
    program.write_text(MOODY, encoding="utf-8")
    program.chmod(0o755)
    agent = agent_of(f"exec:{program}", tmp_path, is_forked=True)
    known = replace(forks.held(), threads=forks.threads())
    agent.reset(1)
    seen = observations(3)
    first = agent.act(seen[0])
    copy = forks.Copy(lambda: {"action": agent.act(seen[1])}, known)
    assert copy.answer(20) is None
    assert re.fullmatch(
        rf"could not repeat the program of ego: it answered observe of step 0 with \[\d+,0\], and before with "
        rf"\[{first[0]},0\]",
        copy.no_answer.why,
    )
    assert agent.act(seen[2]) == first
    agent.close()


def test_a_process_cannot_be_forked_if_its_program_has_seen_too_much(tmp_path, planner, monkeypatch):
    monkeypatch.setattr("crashhunt.agents._program_exchange._MAX_REPEATED_BYTES", 2_000)
    agent = agent_of(f"exec:{planner}", tmp_path, is_forked=True)
    known = replace(forks.held(), threads=forks.threads())
    agent.reset(1)
    for each in observations(9):
        agent.act(each)
    with pytest.raises(forks.CannotForkError, match="a process with child processes cannot be forked"):
        forks.Copy(dict, known)
    agent.close()


WITH_MAP = """\
#!/bin/sh
read -r hello; echo '{"type": "ready", "map": true}'
while read -r line && [ "$line" != '{"type":"close"}' ]; do case $line in
  *reset*) map=${line#*'"map":"'} lanes=$(grep -o '"is_internal":' "${map%%'"'*}" | wc -l); echo '{"type": "ok"}' ;;
  *) echo "{\\"type\\": \\"act\\", \\"action\\": [$lanes, 0]}" ;;
esac; done
"""


def test_a_program_that_asks_for_the_map_receives_its_path_with_each_reset_and_in_forks(tmp_path):
    program = tmp_path / "a program"
    program.write_text(WITH_MAP, encoding="utf-8")
    program.chmod(0o755)
    simulator = WithRoads(SpeedAndLaneChange())
    agent = ProgramFactory(f"exec:'{program}'").agent("ego", simulator, {}, folder=tmp_path, files={}, is_forked=True)
    known = replace(forks.held(), threads=forks.threads())
    seen = observations(2)
    simulator.lanes = 3
    agent.reset(1)
    assert agent.act(seen[0]) == [3, 0]
    simulator.lanes = 2  # a fork must receive the map of the beginning
    assert forks.Copy(lambda: {"action": agent.act(seen[1])}, known).answer(20) == {"action": [3, 0]}
    agent.reset(2)
    assert agent.act(seen[0]) == [2, 0]
    agent.close()
    data = json.loads((tmp_path / "map-ego.json").read_text())
    validator("messages/road-map").validate(data)
    assert (data["lanes"]["1"]["center"][1], data["lanes"]["1"]["allowed"]) == ([2.0, 1.0], ["bus", "passenger"])
    assert (data["route"], data["vehicle"]["wheelbase"]) == (["0"], 2.8)


def test_a_simulator_without_a_map_sends_none_and_other_programs_receive_no_key(tmp_path):
    for wanted, expected in (("", ""), (', "map": true', ',"map":null')):
        program = tmp_path / "tells"
        program.write_text(
            f'#!/bin/sh\nread -r line; echo \'{{"type": "ready"{wanted}}}\'; read -r line; echo $line >&2\n'
        )
        program.chmod(0o755)
        agent = agent_of(f"exec:{program}", tmp_path)
        agent.reset(1)
        with (tmp_path / "log").open("w+b") as log:
            agent._process._log = log.fileno()
            with pytest.raises(ProgramError, match="exited with 0 instead of answering reset"):
                agent.act(observations(1)[0])
        agent.close()
        assert (tmp_path / "log").read_text() == f'{{"type":"reset","seed":1{expected}}}\n'


@pytest.mark.parametrize("kind", ["NaN", "shape"])
def test_an_action_outside_of_the_space_is_left_to_the_check_of_all_agents(planner, tmp_path, kind):
    agent = agent_of(f"exec:{planner} {kind} observe", tmp_path)
    agent.reset(1)
    actions = [agent.act(seen) for seen in observations(4)]
    agent.close()
    with pytest.raises(ActionError):
        SpeedAndLaneChange().encode(actions[3])


@pytest.mark.parametrize("kind", ["children", "stays"])
def test_a_program_and_its_children_end_with_the_trial(planner, tmp_path, kind):
    agent = agent_of(f"exec:{planner} {kind} observe", tmp_path)
    agent.reset(1)
    for seen in observations(4):
        agent.act(seen)
    pids = [agent._process._process.pid]
    if kind == "children":
        pids.append(int((tmp_path / "agent-ego" / "child").read_text()))
    agent.close()
    until = time.monotonic() + 300
    while any(map(is_running, pids)) and time.monotonic() < until:
        time.sleep(0.01)
    assert not any(map(is_running, pids))


def is_running(pid):
    try:
        with open(f"/proc/{pid}/stat", "rb") as file:
            return file.read().rpartition(b")")[2].split()[0] != b"Z"
    except OSError:
        return False


def test_the_arguments_that_a_program_declares_are_its_signature(planner):
    signature = signature_of(ProgramFactory(f"exec:{planner}"))
    speed, kind = signature.arguments.values()
    assert (speed.name, speed.default, speed.unit, speed.distribution) == ("speed", 12.0, "m/s", Range(8.0, 20.0))
    assert (kind.name, kind.default, kind.kind) == ("kind", "", "str")
    assert not signature.open
    assert takes_of(f"exec:{planner}").defaults == {"speed": 12.0, "kind": ""}
    assert takes_of("exec:/nowhere/planner").open


def declaring(folder, text):
    program = folder / "declares"
    program.write_text(f"#!/bin/sh\nread -r line\necho '{text}'\nread -r line\n", encoding="utf-8")
    program.chmod(0o755)
    return ProgramFactory(f"exec:{program}")


def test_a_program_that_declares_nothing_takes_any_argument(tmp_path):
    assert signature_of(declaring(tmp_path, '{"type": "ready", "format": "json"}')).open


def test_whole_numbers_of_a_declaration_leave_the_type_to_the_values(tmp_path):
    text = '{"type": "ready", "arguments": {"speed": {"range": "5:25", "default": 12}, "path": {"default": "a.yaml"}}}'
    arguments = signature_of(declaring(tmp_path, text)).arguments
    assert [arguments[name].kind for name in ("speed", "path")] == [None, "str"]


def test_the_first_hello_has_the_chosen_parts_and_ready_may_choose_them(tmp_path):
    program = tmp_path / "chooses"
    program.write_text(CHOOSES, encoding="utf-8")
    program.chmod(0o755)
    request = Request(scenario="loop", agents={"": f"exec:{program}"}, trials=1, max_steps=9)
    _, chosen, code = plan_with_code(request)
    assert (chosen.agents["ego"].observation, code.notes) == (("ego",), ())
    assert chosen.agents["ego"].arguments["observed"].spec == "kinematics"
    _, asked, code = plan_with_code(replace(request, observe=("actors", "ego")))
    assert (asked.agents["ego"].observation, code.notes) == (("actors", "ego"), ())
    assert asked.agents["ego"].arguments["observed"].spec == "actors,ego"


CHOOSES = f"""{PYTHON}\
import json
parts = json.loads(input())["observation"]
observed = {{"default": ",".join(sorted(parts))}}
print(json.dumps({{"type": "ready", "observation": ["ego"], "arguments": {{"observed": observed}}}}))
"""


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"type": "ready", "arguments": {"speed": {"range": "25:5"}}}', "begins above its end"),
        (
            '{"type": "ready", "arguments": {"speed": {"range": "a:b"}}}',
            'its argument speed: "a:b" is not a range; write',
        ),
        (
            '{"type": "ready", "arguments": {"speed": {"range": [5, 25]}}}',
            "its argument speed has the range [5,25]; write",
        ),
        ('{"type": "ready", "arguments": {"speed": {"unit": 5}}}', "its argument speed has the default null and the"),
        ('{"type": "ready", "arguments": {"speed": {"low": 5}}}', "speed has low (allowed: range, unit, default)"),
        ('{"type": "ready", "arguments": {"speed": 5}}', "its argument speed has 5 (allowed: range, unit, default)"),
        (
            '{"type": "ready", "observation": "ego"}',
            'its observation is "ego", not a list of names; see',
        ),
        ('{"type": "ready", "action": 5}', "its action is 5, not a name; see crashhunt list actions"),
        ('{"type": "ready", "arguments": [1]}', "its arguments are [1], not an object"),
        ("ready", "its answer to hello is not JSON: ready"),
    ],
)
def test_a_declaration_that_cannot_be_used_is_refused(tmp_path, text, message):
    with pytest.raises(ProgramError, match=re.escape(message)):
        declaring(tmp_path, text).declared_signature()


def test_the_error_of_a_program_that_does_not_answer_shows_its_last_output(tmp_path):
    program = tmp_path / "fails"
    program.write_text("#!/bin/sh\necho 'no planner.yaml here' >&2\nexit 4\n", encoding="utf-8")
    program.chmod(0o755)
    with pytest.raises(ProgramError, match=r"exited with 4 instead of .*\(its last output: no planner.yaml here\)"):
        ProgramFactory(f"exec:{program}").declared_signature()


@pytest.mark.parametrize("limit_s", [0.0, 60.0])
def test_a_slow_program_may_declare_its_arguments_for_as_long_as_a_trial_may_take(tmp_path, monkeypatch, limit_s):
    program = tmp_path / "imports"
    ready = '{"type": "ready", "arguments": {"gap": {"range": "1:2"}}}'
    program.write_text(f"#!/bin/sh\nread hello\nsleep 0.5\necho '{ready}'\nread close\n", encoding="utf-8")
    program.chmod(0o755)
    monkeypatch.setattr("crashhunt.agents._programs._DESCRIPTION_S", 0.1)
    with nullcontext() if limit_s else pytest.raises(ProgramError, match="not answered hello"):
        assert "gap" in ProgramFactory(f"exec:{program}").declared_signature(limit_s=limit_s).arguments


def test_what_is_no_program_is_refused_with_the_fix(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "planner").write_text("", encoding="utf-8")
    for locator, message in {
        "exec:": "names no program",
        "exec:'a": "is not a command line",
        "exec:planner": "write exec:./planner",
        "exec:./planner": r"chmod \+x ./planner",
        "exec:./no": "'./no' is not a file",
    }.items():
        with pytest.raises(PluginError, match=message):
            command_of(locator)


def test_files_of_the_command_line_travel_and_programs_of_the_system_do_not(tmp_path, monkeypatch, planner):
    monkeypatch.chdir(tmp_path)
    for name in ("config.yaml", "test"):
        (tmp_path / name).write_text("", encoding="utf-8")
    locator = "exec:./planner --mode test --config=config.yaml --rate 0.5"
    assert files_of(locator) == {"./planner": planner, "config.yaml": tmp_path / "config.yaml"}
    copies = {"./planner": "/copy/planner", "config.yaml": "/copy/config.yaml"}
    words = ("--mode", "test", "--config=/copy/config.yaml", "--rate", "0.5")
    assert command_of(locator, copies) == ("/copy/planner", *words)
    assert list(files_of("exec:python3 ./planner")) == ["./planner"]
    given = agent_of("exec:./planner", tmp_path, mode="test", config="config.yaml")._hello["arguments"]
    assert given == {"mode": "test", "config": str(tmp_path / "config.yaml")}
    assert command_of("exec:/bin/sh ./planner") == ("/bin/sh", str(planner))
