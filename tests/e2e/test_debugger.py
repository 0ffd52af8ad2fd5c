"""Looking into a replay: stopping, tables, and a debugger inside the agent."""

from __future__ import annotations

import subprocess

import pytest
from conftest import CRASHHUNT, Done


def hunted(shell):
    words = ("--agent", "faulty:Raises", "--arg", "at=30", "--arg", "speed=8", "--scenario", "toy", "--set", "gap_m=60")
    shell.crashhunt("run", "h", "1", "1", "60", *words)


@pytest.fixture
def crash(toy, made_once):
    return made_once(hunted, toy)


def typed(shell, text: str, *words: str, fork: bool = False, expect: int | None = None) -> str:
    """What a replay prints to whom that is typed; one starts as a shell does it, and those do not that fork.

    Coverage is not measured, which needs what a debugger needs.
    """
    if fork and shell.environment == shell.unmeasured:
        begun = shell.begin("replay", "h", *words, typed=text)
        out, err = begun.communicate(timeout=300)
        done = Done(begun.returncode, out, err)
    else:
        process = subprocess.run(
            [CRASHHUNT, "replay", "h", *words], cwd=shell.folder, env=shell.unmeasured, input=text,
            capture_output=True, text=True, timeout=300, check=False,
        )  # fmt: skip
        done = Done(process.returncode, process.stdout, process.stderr)
    assert "Traceback" not in done.err, done.err
    assert expect in (None, done.code)
    return done.out


def test_backwards_and_on_from_there_to_the_same_bits(crash):
    asked = "p 'at', step, self.step, scene.time_s\n"
    out = typed(crash, f"{asked}back 5\n{asked}back\n{asked}back 99\nc\n", "--pdb", fork=True)
    (first, self_first, time_s), *others = [
        eval(line.removeprefix("(Pdb) "))[1:] for line in out.splitlines() if line.startswith("(Pdb) ('at'")
    ]
    assert (first, self_first) == (30, 29)
    assert [one[:2] for one in others] == [(25, 24), (24, 23)]
    assert others[1][2] == pytest.approx(time_s - 0.6)
    assert "*** it goes back to step 1 at most" in out
    assert "reproduced: 29 of 29 steps" in out


@pytest.mark.nightly
def test_quitting_the_debugger_is_no_crash_of_ours(crash):
    assert "reproduced" not in typed(crash, "q\n", "--pdb", fork=True, expect=130)


@pytest.mark.nightly
def test_a_breakpoint_in_the_users_code_works(crash):
    faulty = crash.folder / "faulty.py"
    faulty.write_text(
        faulty.read_text().replace("self.step += 1\n", "self.step += 1\n        if self.step == 7: breakpoint()\n", 1)
    )
    out = typed(crash, "p 'mine', self.step\nc\n", "--code", "current", "--until", "9")
    assert "('mine', 7)" in out
    assert "reproduced: 9 of 29 steps" in out


def test_mistakes_are_one_line(crash):
    for words, says in (
        (("--until", "3", "--before", "3"), "--before"),
        (("--print", "sped"), "did you mean 'speed'"),
        (("--pdb", "--json"), "--json"),
    ):
        refused = crash.crashhunt("replay", "h", *words, expect=2)
        assert says in refused.err
        assert len(refused.err.strip().splitlines()) == 1
