"""`crashhunt whatif` against runs of other commands, on the toy, SUMO and highway-env."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace

import pytest
from conftest import mostly_nightly, one_in

from crashhunt.analysis import _whatif_runs as _engine
from crashhunt.crashes import find_bundle
from crashhunt.recording import first_divergence
from crashhunt.replays import ReplayOptions, prepare, reruns_of, up_to
from crashhunt.trial import Reseeding

SPEED = ("--agent", "crashhunt.agents:KeepLaneWithSpeed", "--arg")


def hunted(toy):
    """One crash, for `made_once`: ego drives into the leader at step 53."""
    words = ("--scenario", "toy", "--arg", "speed=14", "--seed", "1", "--no-snapshot")
    toy.crashhunt("run", "h", "1", "20", "300", *words)


def hunted_on_sumo(shell):
    """One crash on SUMO, for `made_once`."""
    words = ("--scenario", "loop", "--arg", "speed=20:25", "--seed", "1")
    shell.crashhunt("run", "h", "2", "60", "400", *words)


@pytest.fixture
def crash(toy, made_once):
    return made_once(hunted, toy)


@pytest.mark.parametrize("step", mostly_nightly([0, 1, 30, 52], [30]))
def test_same_agent_from_any_step_on_crashes_as_it_was_recorded(crash, step):
    was = find_bundle(crash.folder / "h").result
    found = crash.crashhunt("whatif", "h", "--from-step", str(step), "--code", "current", "--times", "3", "--json").json
    assert [(each["outcome"], each["steps"], each["digest"]) for each in found["each"]] == [
        (str(was.outcome), was.steps, was.digest)
    ] * 3
    assert (found["runs"], found["crashed"], found["different"], found["interval"]) == (3, 3, 1, None)
    assert (found["from_step"], found["excluded"]) == (step, {})


@pytest.mark.nightly
def test_another_agent_takes_over_after_the_recorded_actions(crash):
    slow = crash.crashhunt("whatif", "h", "--before", "2", *SPEED, "speed=8", "--json").json
    late = crash.crashhunt("whatif", "h", "--before", "0.1", *SPEED, "speed=8", "--json").json
    assert (slow["crashed"], slow["survived"], slow["from_step"]) == (0, 1, 33)
    assert (late["crashed"], late["from_step"]) == (1, 52)
    same = crash.crashhunt("whatif", "h", "--before", "2", "--set", "speed=8", "--json").json
    assert same["each"][0]["digest"] == slow["each"][0]["digest"]
    braking = crash.crashhunt("whatif", "h", "--before", "2", "--overrule", "brake").out
    assert braking.startswith("000000-collision: 0 of 1 runs crashed\n  recorded: collision at step 53\n")
    assert "matched the recording up to step 33" in braking


def test_each_change_is_a_line_of_its_own(crash):
    said = crash.crashhunt("whatif", "h", "--set", "speed=8", "--set", "gap_m=50").out.splitlines()
    changed = [line for line in said if line.startswith("  changed: ")]
    assert [line.split(" was ")[0] for line in changed] == ["  changed: ego.speed", "  changed: gap_m"]


def test_agent_of_today_is_found_in_the_working_directory(crash):
    (crash.folder / "newcomer.py").write_text(
        "class Late:\n"
        "    def __init__(self, speed=3.0):\n        self.speed, self.seen = speed, None\n"
        "    def reset(self, seed):\n        self.seen = 0\n"
        "    def act(self, observation):\n"
        "        self.seen += 1\n"
        "        if self.seen == 4:\n            raise ValueError('the fourth observation')\n"
        "        return self.speed, 0\n"
    )
    found = crash.crashhunt("whatif", "h", "--from-step", "10", "--agent", "newcomer:Late", "--json").json
    (each,) = found["each"]
    assert (each["outcome"], each["steps"], each["crashed"]) == ("agent_error", 13, True)
    err = crash.crashhunt("whatif", "h", "--agent", "newcomer:Late", "--arg", "sped=1", expect=2).err
    assert "--arg: newcomer:Late has no argument 'sped'" in err
    assert "speed" in err


def by_hand(folder, after, number):
    """Run one future as a trial of its own; return its result and how its first steps differ from the recording."""
    rerun = prepare(find_bundle(folder), ReplayOptions())
    spec = replace(rerun.spec, reseeding=Reseeding(after, _engine.future_seed(rerun.spec.seed, number)))
    with closing(reruns_of(rerun, parallel=1, stopped=lambda: False)) as reruns:
        (ended,) = reruns.run([spec])
    return ended.result, first_divergence(up_to(rerun.recorded, after), up_to(ended.recording, after))


@pytest.mark.nightly  # by day, futures on the toy
@pytest.mark.parametrize("make", [hunted_on_sumo])
def test_futures_on_sumo_are_real_and_agents_take_over(shell, made_once, make):
    made_once(make, shell)
    was = find_bundle(shell.folder / "h").result
    same = shell.crashhunt("whatif", "h", "--before", "5", "--code", "current", "--json").json
    assert [each["digest"] for each in same["each"]] == [was.digest]
    words = ("whatif", "h", "--before", "5", "--futures", "--times", "4", "--json")
    one = shell.crashhunt(*words).json
    assert (one["runs"], one["excluded"], one["different"]) == (4, {}, 4)
    assert was.digest not in {each["digest"] for each in one["each"]}
    result, difference = by_hand(shell.folder / "h", one["from_step"], 3)
    assert (result.digest, difference) == (one["each"][3]["digest"], None)
    slow = shell.crashhunt("whatif", "h", "--before", "5", *SPEED, "speed=5", "--json").json
    assert (slow["crashed"], slow["survived"]) == (0, 1)
    other = find_bundle(shell.folder / "h").result.collision.other
    without = shell.crashhunt("whatif", "h", "--leave-out", other, "--json").json
    assert without["runs"] == 1
    assert without["each"][0]["digest"] != was.digest
    err = shell.crashhunt("whatif", "h", "--leave-out", "unicorn", expect=2).err
    assert "--leave-out 'unicorn': there is no such actor" in err


@pytest.mark.parametrize(
    ("words", "said"),
    one_in(
        3,
        [
            (("--before", "nan", "--futures"), "--before is nan"),
            (("--from-step", "3", "--before", "1"), "not allowed with"),
            (("--overrule", "fly", "--before", "1"), "fly"),
            (("--agent", "nowhere:Missing"), "nowhere"),
            (("--set", "sped=1"), "'sped'"),
            (("--set", "speed=1:3", "--before", "1"), "is not a single value"),
            (("--set", "gap_m=20", "--before", "1"), "cannot change during the trial"),
        ],
    ),
)
def test_bad_input_is_refused_in_one_line(crash, words, said):
    done = crash.crashhunt("whatif", "h", *words, expect=2)
    assert said in done.err
    assert (done.err.count("\n"), done.out) == (1, "")
