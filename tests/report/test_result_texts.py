"""What is printed at the end of a hunt and of a replay, and of the agents and scenarios that there are."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from rich.console import Console

from crashhunt.crashes import Group, Signature
from crashhunt.hunts import AuditReport, HuntReport
from crashhunt.plans import HuntSettings, RunSettings
from crashhunt.recording import Phase
from crashhunt.report import describe_hunt, describe_replay, describe_versions
from crashhunt.report._disturbance_words import about_disturbances
from crashhunt.report._encounter_words import about_events
from crashhunt.report._judgement_words import fault_words
from crashhunt.report._listing import describe
from crashhunt.report._live_screen import _workers
from crashhunt.trial import Collision, Disturbance, Outcome, TrialResult, TrialSpec
from crashhunt.world import Event

SETTINGS = HuntSettings(scenario="loop", scenario_digest="0", trials=30, max_steps=90, seed=7, run=RunSettings())
REPORT = HuntReport(
    directory=Path("my hunt"), settings=SETTINGS, stopped_because="all_trials", outcomes={"survived": 28, "invalid": 2},
    trial_steps=1200, steps_total=1200, wall_s=12.0, crashes=(),
)  # fmt: skip


def lines(report, **more):
    return describe_hunt(replace(report, **more)).splitlines()


@pytest.mark.parametrize(
    ("because", "says"),
    [
        ("all_trials", "No crash was found."), ("time", "No crash was found within the time limit."),
        ("interrupted", "Interrupted. Run the same command to resume."),
        ("no_valid_trial", "No trial was valid: it does not fit"),
    ],
)  # fmt: skip
def test_a_hunt_without_a_crash_states_why_it_ended(because, says):
    found = lines(REPORT, stopped_because=because, reason="it does not fit")
    assert found[0].startswith("30 of 30 trials, 1200 steps, 0:12 ")
    assert found[0].endswith(" (survived 28, invalid 2); hunt seed 7")
    assert says in found
    others = {"No crash was found.", "Interrupted. Run the same command to resume."} - {says}
    assert others.isdisjoint(found)
    assert not any("Replay it" in line for line in found)


def test_versions_of_the_code_have_their_crashes_and_the_newest_comes_first():
    earlier = {"version": 1, "is_newest": False, "first": None, "trials": 1, "crashes": 0}
    assert describe_versions([earlier, {"version": 2, "is_newest": True, "first": 8, "trials": 7, "crashes": 3}]) == (
        "the code has changed: newest version 2: 3 of 7 trials crashed; version 1: 0 of 1 trial crashed; "
        "crash types are of version 2, and its rate is of the trials from 8 on"
    )


def test_last_events_and_disturbances_before_a_crash_are_reported():
    events = [Event("red_light", "ego", f"event {number}") for number in range(9)]
    steps = [SimpleNamespace(step=number, scene=SimpleNamespace(events=(one,))) for number, one in enumerate(events)]
    steps.append(SimpleNamespace(step=9, scene=None))
    prologue = SimpleNamespace(step_length_s=0.5)
    recording = SimpleNamespace(all_steps=steps, steps=9, prologue=prologue, ago=lambda step: f"{9 - step} before")
    assert about_events(recording, 2, besides=events[8]) == [
        f"{9 - number} before, at step {number}: event {number}." for number in range(3, 8)
    ]
    assert about_events(recording, 6, besides=None)[0] == "3 before, at step 6: event 6."
    over, lasting = (Disturbance(step, "front", "brake", 2.0, 1.0, agent="ego", vehicle="x") for step in (3, 5))
    found = about_disturbances(recording, replace(CRASH, disturbances=(over, lasting)), 6)
    assert found[0] == "1 disturbance was over earlier."
    assert len(found) == 2
    assert found[1].startswith("5 before, from step 5 on: ")


def test_more_trials_than_are_planned_have_no_share():
    found = lines(REPORT, outcomes={"survived": 6}, settings=replace(SETTINGS, trials=2))
    assert found[0].startswith("6 trials, ")
    assert not any("of 2" in line for line in found)


def test_an_audit_counts_what_it_replayed_and_names_what_differs():
    audit = AuditReport(trials=10, not_finished=3, differences=("trial 4: a", "trial 5: b"))
    found = lines(REPORT, audit=audit)
    assert "Audit: 10 replayed in new processes, 8 bit-identical." in found
    assert [line for line in found if "trial 4: a" in line or "trial 5: b" in line] == ["  trial 4: a", "  trial 5: b"]
    assert any(line.startswith("  3 more did not finish") for line in found)
    none = lines(REPORT, audit=AuditReport(trials=0, not_finished=0, differences=()))
    assert "Audit: no trial without a crash belonged to the sample." in none


def test_events_that_are_no_crashes_come_with_the_option_that_makes_them_crashes():
    found = lines(REPORT, events={"red_light": (5, 1), "collision": (9, 9)}, steps_total=3000)
    (line,) = [line for line in found if line.startswith("Traffic events:")]
    assert line.endswith("in 1 trial. To hunt for them: --crash-on red_light")
    assert "(3000 simulated in all)" in found[0]
    incomplete = lines(REPORT, unanswered=1, stopped_because="interrupted")
    assert any(
        line.startswith("1 trial has incomplete answers") and line.endswith("run it again.") for line in incomplete
    )
    assert any(line.startswith("2 trials have") for line in lines(REPORT, unanswered=2))


@pytest.mark.parametrize(
    ("more", "says"),
    [
        ({}, "Found 2 crash types (--distinct 1)."),
        ({"types_by_cause": 3}, "Found 2 crash types, 3 by cause (--distinct 1)."),
        ({"at_fault": (7,)}, "Found 1 crash type of the agent's own fault (--distinct 1)."),
    ],
)
def test_types_that_were_hunted_for_are_counted(monkeypatch, more, says):
    rear_end, swipe = (Signature(outcome="collision", role="collider", manner=each) for each in ("rear end", "swipe"))
    bundles = [SimpleNamespace(id=f"{number}", result=SimpleNamespace(spec=SimpleNamespace(number=number), steps=9))
               for number in (4, 7)]  # fmt: skip
    kinds = tuple(Group(signature, (bundle,)) for signature, bundle in zip((rear_end, swipe), bundles, strict=True))
    settings = replace(SETTINGS, run=RunSettings(keep_going=True, distinct=1))
    report = replace(REPORT, settings=settings, stopped_because="distinct", kinds=kinds, **more)
    monkeypatch.setattr("crashhunt.report._hunt_text._describe_types", lambda *_, **__: [])
    assert says in describe_hunt(report).splitlines()


def found_types(types, each):
    """A report of a hunt with some crashes of each of some types."""
    kinds = []
    for number in range(types):
        bundles = tuple(
            SimpleNamespace(
                id=f"{100 * number + one:06d}-collision", path=Path(f"my hunt/{number}"), hunt=Path("my hunt"),
                result=replace(CRASH, steps=30 + one), confirmed=True, why_unconfirmed="",
            )
            for one in range(each)
        )  # fmt: skip
        kinds.append(Group(Signature(outcome="collision", role="collider", manner=f"manner {number}"), bundles))
    crashes = tuple(bundle for group in kinds for bundle in group.bundles)
    return replace(
        REPORT, kinds=tuple(kinds), crashes=crashes, tally=SimpleNamespace(found=len(crashes), likeliest=None)
    )


@pytest.mark.parametrize(("types", "each"), [(1, 2), (1, 40), (5, 9), (6, 3), (30, 3)])
def test_end_of_a_hunt_fits_a_screen_with_the_counts_and_the_next_commands_last(types, each):
    near = tuple(SimpleNamespace(id=f"{one}-survived", result=replace(FINE, danger=0.5)) for one in range(9))
    report = replace(found_types(types, each), near_misses=near, notes=("SUMO omits x",))
    found = describe_hunt(report).splitlines()
    assert len(found) <= 22
    assert "9 near misses saved in 'my hunt/near-misses'" in found
    assert max(map(len, found)) <= 120
    assert [line.strip() for line in found].count("shortest 000000-collision: ego drove into x at step 30") == 1
    assert sum("shortest " in line for line in found) == min(types, 5)
    assert [line for line in found if line.startswith("  and ")] == {
        6: ["  and 1 more type"], 30: ["  and 25 more types"],
    }.get(types, [])  # fmt: skip
    assert f"{types * each} of {types * each} bundles confirmed: bit-identical when replayed in a new process" in found
    assert found[-4].startswith("30 of 30 trials, 1200 steps, 0:12 ")
    assert found[-3:] == [
        "Replay one:  crashhunt replay 'my hunt' --crash 000000-collision",
        "Show one:    crashhunt show 'my hunt' --crash 000000-collision",
        "Show types:  crashhunt crashes 'my hunt'",
    ]
    with_page = describe_hunt(report, has_dashboard=True).splitlines()
    assert with_page == [*found, "Look at it:  crashhunt dashboard 'my hunt'"]


def test_crash_has_the_time_at_which_its_step_ended():
    """A step of 0.05 s ends between two tenths."""
    report = found_types(1, 1)
    report.crashes[0].result, report.crashes[0].divergence = replace(CRASH, sim_time_s=19.45), None
    assert any(line.endswith(", simulation time 19.45 s") for line in describe_hunt(report).splitlines())


def test_crashes_that_are_flaky_or_not_confirmed_are_named_among_many():
    report = found_types(1, 9)
    for number, bundle in enumerate(report.crashes):
        bundle.confirmed = False if number < 4 else None if number == 5 else True
        bundle.why_unconfirmed = "the processor is another" if number == 5 else ""
    found = describe_hunt(report).splitlines()
    assert "4 of 9 bundles confirmed: bit-identical when replayed in a new process" in found
    assert "flaky, the replay deviates: 000000-collision, 000001-collision, 000002-collision and 1 more" in found
    assert "not confirmed: the processor is another: 000005-collision" in found
    assert "Run the same command to try again." in found


def test_printed_paths_can_be_copied_into_a_shell():
    near = SimpleNamespace(id="7-near-miss", result=replace(FINE, danger=0.5))
    crash = SimpleNamespace(id="4", path=Path("my\nhunt/4"), result=CRASH, confirmed=None, why_unconfirmed="")
    report = replace(REPORT, directory=Path("my\nhunt"), near_misses=(near,), crashes=(crash,))
    assert "1 near miss saved in $'my\\x0ahunt/near-misses'" in describe_hunt(report).splitlines()
    text = f"{describe_hunt(report)}\n{describe_hunt(replace(report, crashes=()))}"
    assert "  saved in $'my\\x0ahunt/4'" in text.splitlines()
    assert "Near misses, saved in $'my\\x0ahunt/near-misses':" in text.splitlines()
    crash.confirmed, crash.divergence = False, {"step": 19, "agent": "", "field": "outcome"}
    assert "deviates (first difference at step 19, outcome)" in describe_hunt(report)
    spaced = describe_hunt(replace(report, directory=Path("my hunt"), crashes=()))
    assert "Near misses, saved in 'my hunt/near-misses':" in spaced.splitlines()


HIT = Collision("ego", "collider", "ego", "x", ("overlap",), "overlap", 1.0, 2.0, "a_0", 9.0, 3.0)
CRASH = TrialResult(
    TrialSpec(4, 1, {"ego": {"speed": 8.5}}, {"gap": 3}, 90), Outcome.COLLISION, steps=30, collision=HIT
)
FINE = replace(CRASH, outcome=Outcome.SURVIVED, steps=90, collision=None)


def replayed(verdict, now, *, code="current", **more):
    rerun = SimpleNamespace(
        code=code, snapshot=SimpleNamespace(path="here"), warnings=["numpy differs"], edits=["speed 9"],
        code_differences=more.pop("code_differences", None), elsewhere=False, recorded=SimpleNamespace(steps=30),
        other_traffic=more.pop("other_traffic", False),
    )  # fmt: skip
    bundle = SimpleNamespace(id="000004-collision", result=CRASH, is_near_miss=False)
    given = {
        "divergence": None,
        "verdicts": {verdict: 1},
        "reason": "other traffic",
        "around": [],
        "steps_replayed": 29,
    }
    return describe_replay(SimpleNamespace(bundle=bundle, rerun=rerun, verdict=verdict, replayed=now, **given | more))


@pytest.mark.parametrize(
    ("verdict", "now", "says"),
    [
        ("reproduced", CRASH, ["reproduced: 29 of 30 steps", "is bit-identical"]),
        ("fixed", FINE, ["fixed: no crash; ", f"it was: {CRASH.summary}"]),
        ("changed", CRASH, ["changed: it still crashes", f"it is:  {CRASH.summary}"]),
        ("diverged", FINE, ["diverged: 29 of 30", f"now: {FINE.summary}"]),
        ("not_comparable", FINE, ["not comparable: other traffic"]),
    ],
)
def test_a_replay_states_its_verdict_with_what_was_and_what_is(verdict, now, says):
    text = replayed(verdict, now)
    assert text.startswith(f"000004-collision: {CRASH.summary}\n")
    assert "speed=8.5 gap=3" in text
    assert "driven by today's code" in text
    assert "warning: numpy differs" in text
    assert "no longer the recorded trial: speed 9" in text
    assert [one for one in says if one not in text] == []
    assert "runs:" not in text
    several = replayed(verdict, now, verdicts={verdict: 2, "cannot_run": 1})
    assert f"of 3 runs: 2 {verdict.replace('_', ' ')}, 1 cannot run" in several


def test_files_that_differ_from_the_snapshot_are_named():
    assert "differ" not in replayed("reproduced", CRASH).replace("numpy differs", "")
    assert "no file of the code differs from the snapshot" in replayed("reproduced", CRASH, code_differences=[])
    text = replayed("fixed", FINE, code_differences=[f"{name}.py has changed" for name in "abcdefghijkl"])
    assert "differs from the snapshot: a.py has changed, b.py has changed" in text
    assert "j.py has changed and 2 more" in text


def test_where_a_replay_first_differs_the_steps_around_are_shown():
    text = replayed(
        "diverged", FINE, divergence=SimpleNamespace(step=5), around=[(4, 1.0, 1.0), (5, 2.0, 2.5), (6, None, 3.0)]
    )
    table = [line.strip() for line in text.splitlines()[-4:]]
    assert [row.split() for row in table] == [
        ["step", "recorded", "replayed"], ["4", "1.0", "1.0"], ["5", "2.0", "2.5", "<-", "first", "difference"],
        ["6", "-", "3.0"],
    ]  # fmt: skip
    comparable = replayed("not_comparable", FINE, divergence=SimpleNamespace(step=5), around=[(5, 1, 2)])
    assert "first difference" not in comparable


def test_a_list_has_the_arguments_of_a_scenario_and_of_its_agents():
    argument = {"name": "speed", "default": 3, "range": "1:9", "unit": "m/s", "help": "held"}
    entry = {
        "name": "loop", "locator": "ego driven by m:A", "title": "A ring", "arguments": [argument | {"name": "gap"}],
        "agents": {"ego": [argument], "second": []},
    }  # fmt: skip
    text = describe([entry, {"name": "m:A", "locator": "here", "title": "An agent", "arguments": []}])
    assert text.startswith("loop  (ego driven by m:A)\n    A ring\n")
    assert re.search(r"^    \S*gap\b", text, re.MULTILINE)
    assert "    arguments of ego, as they are hunted here:\n" in text
    assert "arguments of second" not in text
    assert text.endswith("m:A  (here)\n    An agent")


@pytest.mark.parametrize(("count", "width", "rows"), [(3, 80, 3), (9, 80, 3), (60, 80, 4)])
def test_states_of_workers_fit_into_the_lines_that_there_are(count, width, rows):
    workers = {
        number: SimpleNamespace(pid=1000 + number, step=number * 7, phase=Phase.SETUP if number == 2 else Phase.ACT)
        for number in range(count)
    }
    console = Console(width=width, record=True, file=None, force_terminal=False)
    with console.capture() as captured:
        console.print(_workers(SimpleNamespace(workers=workers), width, rows))
    shown = captured.get().splitlines()
    assert len(shown) <= 4
    assert all(len(line) <= width for line in shown)
    text = " ".join(captured.get().split())
    if count == 3:
        assert text == "trial 0 step 0 trial 1 step 7 trial 2 setting up"
    else:
        there = [number for number in range(count) if f"{number}: " in text]
        hidden = re.search(r"and (\d+) more", text)
        assert len(there) + (int(hidden[1]) if hidden else 0) == count
        assert bool(hidden) == (count == 60)


def test_verdict_on_the_vehicle_at_fault_names_no_agent_because_a_hunt_may_have_several():
    verdicts = ("ego", "the other", "both", "nobody can tell", "mixed")
    assert [fault_words(one) for one in verdicts] == ["the agent", "the other", "both", "not decided", "mixed"]
