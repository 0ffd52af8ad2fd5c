"""Whole hunts in which a program drives (``exec:``): what it declares, what travels, and what its harm costs."""

from __future__ import annotations

import csv
import io
import json
import shutil
import subprocess
from collections import Counter
from importlib.util import find_spec

import pytest
from built_fmus import build_fmu
from compiled_libraries import compile_library
from json_schemas import validator
from pages import Page
from programs import COMPILER, COMPILER_CXX, DRIVER, compile_program, write_binary_program, write_program

RUN = ("--scenario", "toy", "--seed", "3")
NEAR = ("--set", "gap_m=12")  # where a crash comes soon


def rows_of(shell, hunt):
    return list(csv.DictReader(io.StringIO(shell.crashhunt("trials", hunt, "--format", "csv").out)))


def test_a_hunt_varies_what_a_program_declares_and_its_crash_replays_where_the_program_is_gone(toy):
    planner = write_program(toy.folder)
    done = toy.crashhunt("run", "h", "1", "6", "60", "--agent", "exec:./planner blind", *RUN, *NEAR, "--json")
    (crash,) = done.json["crashes"]
    assert crash["outcome"] == "collision"
    assert crash["confirmed"]
    speeds = [float(row["ego.speed"]) for row in rows_of(toy, "h")]
    assert all(8.0 <= speed <= 20.0 for speed in speeds)
    (shown,) = [toy.crashhunt("show", "h", "--json").json]
    assert shown["summary"].startswith("ego drove into")
    assert shown["programs"]["./planner"]["revision"] == "1.4-3-gabc"
    assert "\n  program ./planner: revision 1.4-3-gabc\n" in toy.crashhunt("show", "h").out
    planner.write_text(planner.read_text().replace("else speed", "else speed / 2"))
    changed = toy.crashhunt("replay", "h", "--code", "current", "--json", expect=None).json
    assert changed["verdict"] != "reproduced"
    assert changed["code_differences"] == ["./planner has changed"]
    assert changed["programs"] == shown["programs"]
    planner.unlink()
    shutil.move(toy.folder / "h", toy.folder / "elsewhere")
    assert toy.crashhunt("replay", "elsewhere", "--json").json["verdict"] == "reproduced"


def test_a_program_that_fails_at_once_is_an_error_of_the_agent_and_one_that_is_missing_is_refused(toy):
    program = toy.folder / "fails"
    program.write_text("#!/bin/sh\necho 'no planner.yaml' >&2\nexit 4\n")
    program.chmod(0o755)
    done = toy.crashhunt("run", "h", "1", "1", "20", "--agent", "exec:./fails", *RUN, "--no-snapshot", "--json")
    assert done.json["outcomes"] == {"agent_error": 1}
    failed = "the program exited with 4 instead of answering hello"
    assert f"exec:./fails has not declared its arguments: {failed} (its last output: no planner.yaml)" in done.err
    assert f"ego: {failed}" in done.err
    assert "last output: no planner.yaml" in done.err
    declared = '{"type": "ready", "arguments": {"v": {"default": 30, "range": "5:25"}}}'
    program.write_text(f"#!/bin/sh\nread -r line\necho '{declared}'\n")
    assert toy.crashhunt("run", "g", "1", "1", "20", "--agent", "exec:./fails", *RUN, expect=2).err == (
        "crashhunt: 'exec:./fails': the default of its argument v, 30, is outside its range '5:25'; declare a default "
        "within it, or widen the range\n"
    )
    program.write_text('#!/bin/sh\nread -r line\necho \'{"type": "ready", "arguments": {"speed": {"default": 12}}}\'\n')
    words = ("run", "g", "1", "1", "20", "--agent", "exec:./fails", *RUN, "--arg", "speed=fast")
    assert (
        toy.crashhunt(*words, expect=2).err == "crashhunt: --arg speed: 'fast' is not a number; give one, such as 12\n"
    )
    refused = toy.crashhunt("run", "g", "1", "1", "20", "--agent", "exec:./nothing", *RUN, expect=2)
    assert refused.err == (
        "crashhunt: 'exec:./nothing': the program './nothing' is not a file; give the path of an executable file, "
        "such as exec:./planner\n"
    )


@pytest.mark.parametrize(
    ("option", "part"),
    [
        pytest.param(("--probe", "1"), "probes", marks=pytest.mark.nightly),
        pytest.param(("--branch",), "branches", marks=pytest.mark.nightly),
        pytest.param(("--rare",), "rare", marks=pytest.mark.nightly),
    ],
)
def test_forks_of_trials_give_equal_results_with_a_program_and_the_same_agent_in_python(toy, option, part):
    (toy.folder / "driver.py").write_text(DRIVER)
    write_program(toy.folder)
    found = []
    for name, agent in (("python", "driver:Driver"), ("program", "exec:./planner")):
        done = toy.crashhunt(
            "run", name, "1", "4", "40", "--agent", agent, "--arg", "speed=8.0:9.0", "--set", "gap_m=30.0", *RUN,
            "--disturb", "brake=0.02,late_observation=0.02", *option, "--keep-going", "--json",
        )  # fmt: skip
        assert (f"each fork of {option[0]} starts the program of ego again" in done.err) == (name == "program")
        crashes = [crash["digest"] for crash in done.json[part]["crashes"]]
        found.append({**done.json[part], "crashes": crashes})
    assert found[0] == found[1]


@pytest.mark.nightly
def test_modules_next_to_a_program_in_python_travel_with_it(toy):
    planner = toy.folder / "planner"
    write_program(toy.folder)
    planner.write_text(planner.read_text().replace("import json", "import helper\nimport json", 1))
    (toy.folder / "helper.py").write_text("import package\n")
    (toy.folder / "package").mkdir()
    (toy.folder / "package" / "__init__.py").write_text("")
    toy.crashhunt("run", "h", "1", "1", "200", "--agent", "exec:./planner blind", "--arg", "speed=18.0", *RUN)
    (toy.folder / "helper.py").write_text("import missing\n")
    done = toy.crashhunt("replay", "h", "--json").json
    assert (done["verdict"], done["warnings"]) == ("reproduced", [])
    (differing,) = toy.crashhunt("replay", "h", "--code", "current", "--json", expect=None).json["code_differences"]
    assert differing.endswith("helper.py has changed")


@pytest.mark.nightly
@pytest.mark.skipif(COMPILER is None, reason="no compiler for C")
def test_libraries_that_are_not_the_systems_travel_with_a_program(toy):
    source = toy.folder / "build"
    source.mkdir()
    compiled = ["-L.", "-lchoice", f"-Wl,-rpath,{source}"]

    def build(speed):
        (source / "choice.c").write_text(f"double choice(void) {{ return {speed}; }}\n")
        subprocess.run(["cc", "-shared", "-fPIC", "-o", "libchoice.so", "choice.c"], cwd=source, check=True)

    build(18.0)
    compile_program(source, "planner")
    text = (source / "planner.c").read_text().replace("int main", "double choice(void);\nint main")
    (source / "planner.c").write_text(text.replace("nearest < 12.0 ? 0.0 : speed", "choice()"))
    subprocess.run(["cc", "-o", "planner", "planner.c", *compiled, "-lm"], cwd=source, check=True)
    toy.crashhunt("run", "h", "1", "3", "200", "--agent", "exec:build/planner", *RUN)
    build(2.0)
    assert toy.crashhunt("replay", "h", "--json").json["verdict"] == "reproduced"
    current = toy.crashhunt("replay", "h", "--code", "current", "--json", expect=None).json
    assert current["verdict"] != "reproduced"
    assert [line.rpartition("/")[2] for line in current["code_differences"]] == ["libchoice.so has changed"]
    shutil.rmtree(source)
    assert toy.crashhunt("replay", "h", "--json").json["verdict"] == "reproduced"


def same_driver(shell, trials, scenario, *words, max_steps=200):
    """The trials that one driver drives: in Python, and in each way in which an agent need not be Python."""
    (shell.folder / "driver.py").write_text(DRIVER)
    write_program(shell.folder)
    write_binary_program(shell.folder)
    agents = ["driver:Driver", "exec:./planner", "exec:./binary"]
    for compiler, in_cpp in ((COMPILER, False), (COMPILER_CXX, True)):
        if compiler:
            language = "cpp" if in_cpp else "c"
            compile_program(shell.folder, f"program_in_{language}", in_cpp=in_cpp)
            compile_library(shell.folder, f"lib_in_{language}.so", words=("-DHARMLESS",), in_cpp=in_cpp)
            agents += [f"exec:./program_in_{language}", f"lib:./lib_in_{language}.so"]
    if COMPILER and find_spec("fmpy"):
        for version in (2, 3):
            (shell.folder / f"fmi{version}").mkdir()
            agents.append(f"fmu:{build_fmu(shell.folder / f'fmi{version}', version).relative_to(shell.folder)}")
    found = {}
    for number, agent in enumerate(agents):
        shell.crashhunt(
            "run", f"h{number}", "2", str(trials), str(max_steps), "--scenario", scenario, "--agent", agent, "--arg",
            "speed=8.0:20.0", "--seed", "5", "--keep-going", "--keep", "1", *words,
        )  # fmt: skip
        found[agent] = [(row["outcome"], row["steps"], row["digest"]) for row in rows_of(shell, f"h{number}")]
        shutil.rmtree(shell.folder / f"h{number}")
    return found


@pytest.mark.nightly
@pytest.mark.timeout(7200)
@pytest.mark.parametrize(
    ("scenario", "words"),
    [("motorway", ("--action", "speed_and_lane")), ("merge", ()), ("intersection", ())],
)
def test_one_driver_has_equal_digests_over_200_trials_in_every_language_and_form(toy, scenario, words):
    found = same_driver(toy, 200, scenario, *words)
    first = found.pop("driver:Driver")
    assert (len(first), len(set(first)) > 190) == (200, True)
    assert {outcome for outcome, _, _ in first} <= {"survived", "collision", "off_road"}
    assert found == dict.fromkeys(found, first)
    print(f"{scenario}: {dict(Counter(outcome for outcome, _, _ in first))}, {len(found)} other forms: {[*found]}")


@pytest.mark.skipif(COMPILER_CXX is None, reason="no compiler for C++")
def test_the_session_of_the_protocol_page_is_what_the_example_in_cpp_does(shell, tmp_path):
    session = Page("exec-protocol").text.partition("```text\n")[2].partition("```")[0].splitlines()
    asked = [line[2:] for line in session if line.startswith("> ")]
    answered = [line[2:] for line in session if line.startswith("< ")]
    (tmp_path / "planner.cpp").write_text(Page("exec").files["planner.cpp"])
    subprocess.run([str(COMPILER_CXX), "-std=c++17", "-o", "planner", "planner.cpp"], cwd=tmp_path, check=True)
    done = subprocess.run(
        [tmp_path / "planner"], input="".join(f"{line}\n" for line in asked), capture_output=True, text=True, check=True
    )
    assert done.stdout.splitlines() == answered
    for name, lines in (("request", asked), ("answer", answered)):
        for line in lines:
            validator(f"messages/exec-{name}").validate(json.loads(line))
