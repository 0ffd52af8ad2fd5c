"""Programs that drive in one trial after another (``reuse``), and the audit that compares them with new ones."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from programs import write_binary_program, write_program
from simulated import answers_in_python, observations
from test_programs import agent_of, is_running

from crashhunt.agents import ProgramFactory, offer_reused
from crashhunt.base import forks
from crashhunt.base.errors import ProgramError


@pytest.fixture
def reused(tmp_path):
    """Offers the program of a command line to the agents of this process, as a zygote does."""
    made = []

    def offer(locator):
        made.append(ProgramFactory(locator).reused(tmp_path / "reused", {}))
        offer_reused({"ego": made[0]})
        return made[0]

    yield offer
    offer_reused({})
    for program in made:
        program.end()


def trial(program, locator, folder, *, steps=20, **arguments):
    """The actions of a trial in a reused program."""
    program.prepare()
    agent = agent_of(locator, folder, **arguments)
    agent.reset(1)
    try:
        return [tuple(agent.act(seen)) for seen in observations(steps)]
    finally:
        agent.close()


def test_a_program_drives_in_one_trial_after_another_with_the_arguments_of_each(tmp_path, reused):
    locator = f"exec:{write_program(tmp_path)}"
    program = reused(locator)
    pids = []
    for speed in (9.125, 17.0):
        assert trial(program, locator, tmp_path, speed=speed) == answers_in_python(speed=speed)
        pids.append(program.pid)
        program.move_log(tmp_path / f"log-{speed}")
    assert pids[0] == pids[1]
    assert [(tmp_path / f"log-{speed}").read_text().count("hello ego") for speed in (9.125, 17.0)] == [1, 1]
    program.end()
    assert not is_running(pids[0])
    assert not (tmp_path / "reused").exists()


def test_a_program_with_binary_messages_receives_hello_in_them(tmp_path, reused):
    file = write_binary_program(tmp_path)
    text = file.read_text()
    assert text.count('answer = {"type": "ok"}') == 1
    greets = 'answer = {"type": "ready" if message["type"] == "hello" else "ok"}'
    file.write_text(text.replace('answer = {"type": "ok"}', greets))
    locator = f"exec:{file}"
    program = reused(locator)
    first = trial(program, locator, tmp_path, speed=9.125)
    pid = program.pid
    assert first == trial(program, locator, tmp_path, speed=9.125) == answers_in_python(speed=9.125)
    assert program.pid == pid


def test_a_program_that_does_not_answer_a_second_hello_is_refused_with_the_fix(tmp_path, reused):
    locator = f"exec:{write_binary_program(tmp_path)}"
    program = reused(locator)
    trial(program, locator, tmp_path)
    with pytest.raises(ProgramError, match=r"not of type 'ready'.*; answer hello before each reset, or omit reuse"):
        trial(program, locator, tmp_path)


def test_reuse_is_no_reason_for_a_program_that_fails_at_its_first_hello(tmp_path, reused):
    locator = f"exec:{write_program(tmp_path)} exits hello"
    program = reused(locator)
    with pytest.raises(ProgramError, match="exited with 3 instead of answering hello") as failed:
        trial(program, locator, tmp_path, kind="exits")
    assert "reuse" not in failed.value.fix


@pytest.mark.parametrize(
    ("harm", "message"),
    [
        ("SIGSEGV", "ego: the program died of SIGSEGV instead of answering observe of step 3"),
        ("exits", "ego: the program exited with 3 instead of answering observe of step 3"),
        ("twice", "ego: it has sent something before observe of step 4"),
        ("garbage", "ego: its answer to observe of step 3 is not JSON: thinking"),
    ],
)
def test_a_program_that_fails_is_started_again_for_the_next_trial(tmp_path, reused, harm, message):
    locator = f"exec:{write_program(tmp_path)} {harm} observe"
    program = reused(locator)
    before = trial(program, locator, tmp_path, kind="none")
    pid = program.pid
    with pytest.raises(ProgramError, match=f"^{message}"):
        trial(program, locator, tmp_path, kind=harm)
    assert trial(program, locator, tmp_path, kind="none") == before
    assert program.pid != pid
    assert not is_running(pid)


def test_a_trial_that_ends_without_close_leaves_a_new_program_to_the_next(tmp_path, reused):
    locator = f"exec:{write_program(tmp_path)}"
    program = reused(locator)
    program.prepare()
    agent = agent_of(locator, tmp_path)
    agent.reset(1)
    agent.act(observations(1)[0])
    agent._process._attached.detach(is_idle=False)  # as the end of its process would
    pid = program.pid
    program.prepare()
    assert program.pid != pid


def test_a_fork_of_a_trial_starts_a_program_of_its_own(tmp_path, reused):
    locator = f"exec:{write_program(tmp_path)}"
    program = reused(locator)
    program.prepare()
    known = replace(forks.held(), threads=forks.threads())
    agent = agent_of(locator, tmp_path, is_forked=True, speed=9.0)
    agent.reset(1)
    seen = observations()
    for each in seen[:8]:
        agent.act(each)
    copy = forks.Copy(lambda: {"actions": [agent.act(each) for each in seen[8:]]}, known)
    assert copy.answer(20)["actions"] == [agent.act(each) for each in seen[8:]]
    agent.close()
    pid = program.pid
    program.prepare()
    assert program.pid == pid


def test_a_program_that_cannot_be_started_is_an_error_of_the_trial(tmp_path, reused):
    file = tmp_path / "planner"
    file.write_text("no program")
    file.chmod(0o755)
    with pytest.raises(ProgramError, match="ego: the program does not start: Exec format error"):
        trial(reused(f"exec:{file}"), f"exec:{file}", tmp_path)


def test_a_hunt_reuses_a_program_and_its_audit_finds_what_it_remembers(toy):
    file = write_program(toy.folder)
    text = file.read_text().replace("speed, in_trial = 12.0, False", "speed, in_trial, trials = 12.0, False, 0")
    remembers = 'answer(type="ok"); trials += kind == "remembers"; speed += trials'
    file.write_text(text.replace('answer(type="ok")', remembers))
    scenario = Path(toy.folder, "toy", "scenario.toml")
    agent = 'agent = { exec = ["../planner"], reuse = true }'
    scenario.write_text(scenario.read_text().replace('agent = "crashhunt.agents:KeepLaneWithSpeed"', agent))
    words = ("1", "2", "20", "--scenario", "toy", "--set", "gap_m=60.0", "--arg", "speed=8.0", "--seed", "3", "--json")
    done = toy.crashhunt("run", "same", *words, "--audit", "0.5", "--keep-trials")
    assert (done.json["audit"]["trials"] > 0, done.json["audit"]["differences"]) == (True, [])
    assert "the program of ego drives in one trial after another; 50% of the trials without a crash" in done.err
    logs = [file.read_text() for file in sorted((toy.folder / "same" / "trials").glob("*/run.log"))]
    assert [log.count("hello ego") for log in logs] == [1] * 2
    done = toy.crashhunt("run", "other", *words, "--arg", "kind=remembers", "--audit", "0.5", "--keep-going")
    assert {one["field"] for one in done.json["audit"]["differences"]} == {"action[target_speed]"}
    assert "may remember earlier trials; have it forget them at reset, or omit reuse" in done.err
