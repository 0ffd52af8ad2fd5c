"""Agents that are shared libraries: what they receive, what they may return, and the harm that they do."""

from __future__ import annotations

import inspect
import json
import os
import platform
import re
import shutil
import sqlite3
import subprocess
from contextlib import closing
from importlib.util import find_spec

import numpy as np
import pytest
from built_fmus import build_fmu
from compiled_libraries import IN_C, compile_library
from gymnasium import spaces
from programs import COMPILER, DRIVER
from simulated import SPACE, Simulated, answers_in_python, observations

from crashhunt.agents import FmuFactory, LibraryFactory, ProgramFactory
from crashhunt.base.agent_locators import files_of
from crashhunt.base.errors import ActionError, CrashhuntError, PluginError, ProgramError
from crashhunt.simulators import MetaAction, SpaceAction, SpeedAndLaneChange
from crashhunt.trial import Range, signature_of

pytestmark = pytest.mark.skipif(COMPILER is None, reason="there is no C compiler")

# Returns what it has received as its action.
ECHO = r"""
#include <stdlib.h>
#include "crashhunt_agent.h"
CRASHHUNT_AGENT()
static const struct crashhunt_setup *kept;
CRASHHUNT_EXPORT const char *crashhunt_create(const struct crashhunt_setup *setup, void **agent) {
    kept = setup; *agent = NULL; return NULL;
}
CRASHHUNT_EXPORT const char *crashhunt_reset(void *agent, uint64_t seed) {
    (void)agent; return seed == UINT64_MAX ? NULL : "another seed";
}
CRASHHUNT_EXPORT const char *crashhunt_act(void *agent, const struct crashhunt_observation *seen, double *action) {
    int64_t i, k, n = 0;
    (void)agent;
    for (i = 0; i < seen->part_count; i++)
        for (k = 0; k < seen->parts[i].size && n < kept->action->size; k++)
            action[n++] = seen->parts[i].bytes ? seen->parts[i].bytes[k] : seen->parts[i].values[k];
    if (n < kept->action->size) action[n++] = (double)crashhunt_part(kept, "camera/image");
    if (n < kept->action->size) action[n++] = (double)seen->step;
    if (n < kept->action->size) action[n++] = seen->time_s;
    if (n < kept->action->size) action[n++] = crashhunt_number(kept, "flag", 7.0);
    if (n < kept->action->size) action[n++] = (double)strlen(crashhunt_text(kept, "word", ""));
    if (n < kept->action->size) action[n++] = crashhunt_number(kept, "none", 3.0);
    if (n < kept->action->size) action[n++] = kept->map ? (double)strlen(kept->map) : -1.0;
    return NULL;
}
CRASHHUNT_EXPORT void crashhunt_destroy(void *agent) { (void)agent; }
"""


def agent_of(library, *, form=None, space=SPACE, seed=2**64 - 1, limit_s=None, **arguments):
    simulator = Simulated(form, space, 0.25)
    factory = LibraryFactory(f"lib:{library}")
    agent = factory.agent("ego", simulator, arguments, folder=library.parent, files={}, limit_s=limit_s)
    agent.reset(seed)
    return agent


@pytest.fixture(scope="module")
def planner(tmp_path_factory):
    return compile_library(tmp_path_factory.mktemp("planner"))


@pytest.fixture(scope="module")
def echo(tmp_path_factory):
    return compile_library(tmp_path_factory.mktemp("echo"), "libecho.so", ECHO)


def test_a_library_acts_like_the_agent_in_python(planner):
    agent = agent_of(planner, speed=9.125)
    answers = [agent.act(seen) for seen in observations()]
    assert answers == answers_in_python(speed=9.125)
    assert {speed for speed, _ in answers} == {0.0, 9.125}
    assert [type(part) for part in answers[0]] == [float, int]
    agent.close()
    agent.close()


def test_a_call_that_takes_too_long_is_an_error_of_the_agent_that_names_the_step(planner):
    agent = agent_of(planner, harm="slow", at=1, limit_s=0.05)
    seen = observations(2)
    agent._limit_s = 1000  # of the first step, which a busy machine may delay
    agent.act(seen[0])
    agent._limit_s = 0.05
    with pytest.raises(ProgramError, match=r"^ego: crashhunt_act has not returned within 0\.05 s in step 2$"):
        agent.act(seen[1])
    agent.close()


def test_two_agents_of_a_library_do_not_share_their_arguments(planner):
    slow, fast = (agent_of(planner, speed=speed) for speed in (9.0, 19.0))
    seen = np.zeros((8, 7), np.float32)
    assert [agent.act(seen)[0] for agent in (slow, fast, slow)] == [9.0, 19.0, 9.0]


def test_the_arguments_that_a_library_declares_are_its_signature_and_its_defaults(planner):
    arguments = signature_of(LibraryFactory(f"lib:{planner}")).arguments
    speed = arguments["speed"]
    assert (speed.default, speed.unit, speed.distribution) == (12.0, "m/s", Range(8.0, 20.0))
    assert (arguments["harm"].default, arguments["harm"].distribution, arguments["harm"].unit) == ("none", None, "")
    assert agent_of(planner).act(np.zeros((8, 7), np.float32)) == (12.0, 0)


def test_a_library_may_choose_its_parts_and_the_form_of_its_actions(tmp_path):
    chosen = 'CRASHHUNT_AGENT(CRASHHUNT_OBSERVES("ego,actors:rows=8") CRASHHUNT_ACTS("acceleration"))'
    library = compile_library(tmp_path, "libchooses.so", ECHO.replace("CRASHHUNT_AGENT()", chosen))
    signature = signature_of(LibraryFactory(f"lib:{library}"))
    assert (signature.observation, signature.action) == (("ego", "actors:rows=8"), "acceleration")
    assert signature.open


def test_nested_observations_step_time_and_arguments_arrive_in_order(echo):
    image = spaces.Box(0, 255, (2, 2), np.uint8)
    camera = spaces.Dict({"gain": spaces.Discrete(5), "image": image})
    space = spaces.Dict({"bits": spaces.MultiBinary(2), "camera": camera, "xy": spaces.Tuple((SPACE, SPACE))})
    form = SpaceAction(spaces.Box(-np.inf, np.inf, (2 + 1 + 4 + 56 + 56 + 7,), np.float64))
    agent = agent_of(echo, form=form, space=space, flag=True, word="é")
    rows = observations(2)
    seen = {
        "bits": np.array([1, 0], np.int8),
        "camera": {"gain": 3, "image": np.array([[1, 2], [3, 255]], np.uint8)},
        "xy": (rows[0], rows[1]),
    }
    flat = [1, 0, 3, 1, 2, 3, 255, *rows[0].ravel(), *rows[1].ravel()]
    assert form.encode(agent.act(seen)).tolist() == [*flat, 2, 0, 0.0, 1.0, 2, 3.0, -1.0]
    assert form.encode(agent.act(seen)).tolist() == [*flat, 2, 1, 0.25, 1.0, 2, 3.0, -1.0]


def test_the_parts_that_an_agent_observes_have_their_columns(tmp_path):
    source = ECHO.replace('(double)crashhunt_part(kept, "camera/image")', 'crashhunt_column(&kept->parts[1], "speed")')
    simulator = Simulated(SpaceAction(spaces.Box(-np.inf, np.inf, (5,), np.float64)))
    space = spaces.Dict({"actors": spaces.Box(-9, 9, (2, 1)), "ego": spaces.Box(-9, 9, (2,))})
    columns = {"actors": {"x": 0}, "ego": {"x": 0, "speed": 1}}
    simulator.observation_layouts = {"ego": type("Layout", (), {"space": space, "columns": columns})}
    seen = {"actors": np.array([[1], [2]], np.float32), "ego": np.array([3, 4], np.float32)}
    library = compile_library(tmp_path, "libcolumns.so", source)
    agent = LibraryFactory(f"lib:{library}").agent("ego", simulator, {}, folder=tmp_path, files={})
    agent.reset(2**64 - 1)
    assert agent.act(seen).tolist() == [1, 2, 3, 4, 1]


@pytest.mark.parametrize(
    ("space", "value"),
    [
        (spaces.Discrete(9), 4),
        (spaces.MultiDiscrete([3, 9]), [2, 7]),
        (spaces.Box(0, 9, (1, 2), np.float32), [[2.5, 7.0]]),
        (spaces.Box(0, 9, (), np.float64), 2.5),
        (spaces.MultiBinary(2), [1, 0]),
    ],
)
def test_actions_have_the_type_and_the_shape_of_their_space(echo, space, value):
    form = SpaceAction(space)
    seen = spaces.Box(-np.inf, np.inf, np.shape(value), np.float64)
    agent = agent_of(echo, form=form, space=seen)
    assert form.encode(agent.act(np.array(value, np.float64))).tolist() == value
    assert agent.act(np.full(np.shape(value), np.nan)) is not None
    with pytest.raises(ActionError):
        form.encode(agent.act(np.full(np.shape(value), np.nan)))


def test_a_meta_action_that_is_no_whole_number_is_refused(echo):
    agent = agent_of(echo, form=MetaAction(), space=spaces.Box(0, 9, (1,), np.float64))
    with pytest.raises(ActionError):
        MetaAction().encode(agent.act(np.array([1.5])))
    assert MetaAction().encode(agent.act(np.array([3.0]))).tolist() == [3]


def test_an_observation_cannot_be_changed_by_the_library(echo):
    agent = agent_of(echo, form=SpaceAction(spaces.Box(-9, 9, (2,), np.float64)), space=spaces.Box(-9, 9, (2,)))
    seen = np.array([1, 2], np.float32)
    first = agent.act(seen)
    agent.act(seen * 2)
    assert (seen.tolist(), first.tolist()) == ([1, 2], [1, 2])


@pytest.mark.parametrize(
    ("harm", "message"),
    [
        ("fails", "ego: crashhunt_act failed in step 4: no path €"),
        ("shape", "ego: crashhunt_act has written more than the 2 values of an action in step 4"),
        ("create", "ego: crashhunt_create failed: (no reason given)"),
        ("reset", "ego: crashhunt_reset failed: no map"),
    ],
)
def test_a_failure_is_an_error_that_names_the_agent(planner, harm, message):
    agent = agent_of(planner, harm=harm)
    with pytest.raises(ProgramError, match=f"^{re.escape(message)}"):
        [agent.act(seen) for seen in observations()]
    agent.close()


@pytest.mark.parametrize("harm", ["NaN", "unset", "part"])
def test_an_action_outside_of_the_space_is_left_to_the_check_of_all_agents(planner, harm):
    agent = agent_of(planner, harm=harm)
    actions = [agent.act(seen) for seen in observations(4)]
    with pytest.raises(ActionError):
        SpeedAndLaneChange().encode(actions[3])


@pytest.mark.parametrize("space", [spaces.Text(5), spaces.Dict({"a": spaces.Sequence(SPACE)})])
def test_spaces_without_a_fixed_shape_are_refused(echo, space):
    with pytest.raises(PluginError, match="cannot receive observations"):
        agent_of(echo, space=space)
    with pytest.raises(PluginError, match="cannot return actions"):
        agent_of(echo, form=type("Form", (), {"space": space, "names": ()}))


def test_a_needed_library_comes_from_the_snapshot_or_is_refused(tmp_path):
    for folder, value in (("built", "0.5"), ("saved", "1.5")):
        (tmp_path / folder).mkdir()
        for words, name in ((("-Wl,-soname,libneeded.so.1",), "libneeded.so.1"), ((), "libnameless.so")):
            source = f"double needed(void) {{ return {value}; }}"
            compile_library(
                tmp_path / folder, name, f'__attribute__((visibility("default"))) double needed(void);{source}', words
            )
    built = tmp_path / "built"
    search = (f"-L{built}", f"-Wl,-rpath,{built}", "-DNEEDED")
    named = compile_library(built, "libnamed.so", words=(*search, "-l:libneeded.so.1"))
    nameless = compile_library(built, "libfirst.so", words=(*search, "-l:libnameless.so"))
    assert files_of(f"lib:{named}") == {f"lib:{built}/libneeded.so.1": built / "libneeded.so.1", str(named): named}
    simulator = Simulated()
    files = {f"lib:{built}/libneeded.so.1": str(tmp_path / "saved" / "libneeded.so.1"), str(named): str(named)}
    agent = LibraryFactory(f"lib:{named}").agent("ego", simulator, {}, folder=tmp_path, files=files)
    agent.reset(1)
    assert agent.act(np.zeros((8, 7), np.float32)) == (13.5, 0)
    files = {f"lib:{built}/libnameless.so": str(tmp_path / "saved" / "libnameless.so"), str(nameless): str(nameless)}
    with pytest.raises(CrashhuntError, match=r"libnameless.so, which was not loaded from the snapshot"):
        LibraryFactory(f"lib:{nameless}").load(files, tmp_path)


def test_trials_create_agents_of_every_kind_in_the_same_way():
    kinds = [inspect.signature(kind.agent).parameters for kind in (ProgramFactory, LibraryFactory, FmuFactory)]
    assert [list(parameters) for parameters in kinds] == [list(kinds[0])] * 3


TOY = ("--scenario", "toy", "--seed", "5", "--set", "gap_m=5.0:25.0")


def results(folder):
    with closing(sqlite3.connect(f"file:{folder / 'ledger.sqlite'}?mode=ro", uri=True)) as database:
        return [json.loads(row[0]) for row in database.execute("SELECT result FROM trials ORDER BY number")]


@pytest.mark.parametrize(
    ("scenario", "steps"),
    [
        ("toy", "60"),
        pytest.param("merge", "200", marks=pytest.mark.nightly),
        pytest.param("intersection", "60", marks=pytest.mark.nightly),
    ],
)
def test_a_hunt_with_a_library_or_an_fmu_has_the_digests_of_one_with_the_same_driver_in_python(toy, scenario, steps):
    compile_library(toy.folder, words=("-DHARMLESS",))
    (toy.folder / "driver.py").write_text(DRIVER, encoding="utf-8")
    drivers = {"in_python": "driver:Driver", "in_c": "lib:./libplanner.so"}
    if scenario == "toy" and find_spec("fmpy"):
        build_fmu(toy.folder, 3)
        drivers["by_fmi"] = "fmu:./planner.fmu"
    for name, agent in drivers.items():
        words = ("--agent", agent, "--arg", "speed=8.0:20.0", "--keep-going")
        toy.crashhunt("run", name, "1", "4", steps, "--scenario", scenario, "--seed", "5", *words)
    in_python, *others = ([one["digest"] for one in results(toy.folder / name)] for name in drivers)
    assert all(one["steps"] > 3 for one in results(toy.folder / "in_c"))
    assert others == [in_python] * len(others)
    assert len(set(in_python)) == 4


def hunted(toy, harm, *words):
    words = ("--agent", "lib:./libplanner.so", "--arg", f"harm={harm}", *words)
    toy.crashhunt("run", "h", "1", "1", "20", *TOY, *words)
    (result,) = results(toy.folder / "h")
    return result


def check_failure(result, harm, outcome, message):
    assert (result["outcome"], result["failure"]["agent"]) == (outcome, "ego")
    assert result["failure"]["message"].startswith(message)
    if harm in ("SIGSEGV", "deadlock") and find_spec("_crashhunt_native_stack") and shutil.which("addr2line"):
        assert re.search(
            r'libplanner.so.c", line \d+ in harm\n.*line \d+ in crashhunt_act\n', result["failure"]["traceback"]
        )


@pytest.mark.nightly  # by day, the library of the next test dies
@pytest.mark.parametrize(
    ("harm", "words", "outcome", "message"),
    [
        ("abort", (), "process_died", "the process died of SIGABRT in ego's act() of step 4"),
        ("exit", (), "process_died", "the process exited with 0 in ego's act() of step 4"),
        ("deadlock", ("--timeout", "1"), "hang", "still running after 1 s in ego's act() of step 4"),
        ("shape", (), "agent_error", "ego: crashhunt_act has written more"),
    ],
)
def test_harm_has_the_right_outcome_and_names_the_agent(toy, harm, words, outcome, message):
    compile_library(toy.folder)
    check_failure(hunted(toy, harm, *words), harm, outcome, message)


def test_a_library_that_dies_is_a_crash_and_a_replay_runs_the_saved_one_and_reports_that_the_current_one_differs(toy):
    compile_library(toy.folder)
    message = "the process died of SIGSEGV in ego's act() of step 4"
    check_failure(hunted(toy, "SIGSEGV"), "SIGSEGV", "process_died", message)
    compile_library(toy.folder, source=IN_C.replace('kind, "SIGSEGV"', 'kind, "never"'))
    facts = toy.crashhunt("show", "h", "--json").json["programs"]["./libplanner.so"]
    assert facts["machine"] == platform.machine()
    assert any(name.startswith("libm.so") for name in facts["system"])
    replayed = toy.crashhunt("replay", "h", "--json").json
    assert (replayed["verdict"], replayed["programs"]) == ("reproduced", {"./libplanner.so": facts})
    assert (
        "differs from the snapshot: ./libplanner.so has changed"
        in toy.crashhunt("replay", "h", "--code", "current", "--expect", "fixed").out
    )


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda file: None, "'./libplanner.so' is not a file"),
        (lambda file: file.write_bytes(b""), "it is not a shared library (an ELF file)"),
        (
            lambda file: file.write_bytes(b"\x7fELF\2\1\1" + bytes(11) + b"\xb7\0" + bytes(99)),
            "it is built for aarch64",
        ),
        (lambda file: os.truncate(compile_library(file.parent), 5000), "it is cut: it has 5000 bytes, and its headers"),
        (
            lambda file: compile_library(file.parent, source=IN_C.replace("crashhunt_reset", "crashhunt_rest")),
            "it does not export crashhunt_reset; include crashhunt_agent.h",
        ),
        (
            lambda file: compile_library(file.parent, source=f'#define CRASHHUNT_PROTOCOL "2"\n{IN_C}'),
            "its protocol is 2 (allowed: 1)",
        ),
    ],
)
def test_what_cannot_be_used_is_refused_in_one_line_before_the_hunt(toy, make, message):
    make(toy.folder / "libplanner.so")
    done = toy.crashhunt("run", "h", "1", "1", "20", *TOY, "--agent", "lib:./libplanner.so", expect=2)
    assert message in done.err
    assert len(done.err.strip().splitlines()) == 1
    assert not (toy.folder / "h").exists()


def test_a_scenario_names_a_library(toy):
    file = toy.folder / "toy" / "scenario.toml"
    text = file.read_text(encoding="utf-8")
    assert text.count("\nagent = ") == 1
    for agent, message in {
        '{ lib = "./my libplanner.so" }': "/toy/my libplanner.so' is not a file",
        "{ lib = 5 }": "is neither a command nor a library",
        '{ lib = "a", exec = ["b"] }': "is neither a command nor a library",
    }.items():
        file.write_text(re.sub(r"(?m)^agent = .*$", f"agent = {agent}", text), encoding="utf-8")
        assert message in toy.crashhunt("run", "h", "1", "1", "20", "--scenario", "toy", expect=2).err


@pytest.mark.parametrize("standard", ["c++ -std=c++11", "c++ -std=c++17", "cc -std=c99"])
def test_the_header_that_is_printed_compiles_without_warnings(toy, standard):
    words = standard.split()
    compiler = shutil.which(words[0])
    if compiler is None:
        pytest.skip(f"there is no {words[0]}")
    (toy.folder / "crashhunt_agent.h").write_text(toy.crashhunt("agent-header").out, encoding="utf-8")
    file = toy.folder / ("planner.c" if words[0] == "cc" else "planner.cpp")
    file.write_text('#include "crashhunt_agent.h"\nCRASHHUNT_AGENT(CRASHHUNT_ARGUMENT("a", "1:2", "", "b"))\n', "utf-8")
    subprocess.run([compiler, words[1], "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-fsyntax-only", file], check=True)
