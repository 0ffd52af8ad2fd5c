"""Which interventions the options of `whatif` request, and which steps stay as recorded."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from crashhunt.analysis import (
    Disturb,
    HandOver,
    LeaveOut,
    Overrule,
    Reseed,
    SetArguments,
    WhatIfOptions,
    _whatif_runs as _engine,
    what_if,
)
from crashhunt.analysis._interventions import interventions_of, step_before
from crashhunt.base.errors import UsageError
from crashhunt.trial import Disturbance, Handover, Outcome, TrialResult, TrialSpec


def crash(steps=53, dt=0.1, agents=("ego",)):
    spec = TrialSpec(0, 1, {name: {"speed": 3.0} for name in agents}, {"gap_m": 20.0}, 99)
    return SimpleNamespace(
        id="c",
        result=TrialResult(spec, Outcome.COLLISION, steps=steps),
        recording=lambda: SimpleNamespace(prologue=SimpleNamespace(step_length_s=dt)),
    )


@pytest.mark.parametrize(
    ("dt", "seconds", "step"),
    [
        (0.1, 0.1, 52), (0.1, 1.1, 42), (0.1, 0.7, 46), (0.1, 5.3, 0), (0.1, 0.15, 51),
        (0.5, 1.0, 51), (0.5, 1.01, 50), (0.5, 0.2, 52), (1.0, 2.0, 51), (1 / 15, 1.0, 38),
    ],
)  # fmt: skip
def test_last_step_at_least_so_long_before_a_crash(dt, seconds, step):
    assert step_before(crash(dt=dt), seconds) == step


@pytest.mark.parametrize("seconds", [0.0, -1.0, 5.31, 1e9, float("nan"), float("inf")])
def test_time_outside_the_trial_is_refused_with_the_times_inside(seconds):
    with pytest.raises(UsageError, match=r"but the trial lasts only 5\.3 s") as refused:
        step_before(crash(), seconds)
    assert refused.value.fix == "give 0.1 to 5.3"


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({}, []),
        ({"changes": {"speed": "5"}}, [SetArguments(changes={"speed": "5"})]),
        (
            {"changes": {"ego.speed": "5"}, "from_step": 4},
            [HandOver(from_step=4, arguments={"speed": "5"}, agent="ego", option="--set")],
        ),
        (
            {"changes": {"speed": "5"}, "before_s": 1.0},
            [HandOver(from_step=43, arguments={"speed": "5"}, option="--set")],
        ),
        ({"code": "current", "from_step": 4}, [HandOver(from_step=4, option="--set")]),
        ({"agent": "a:B"}, [HandOver(from_step=0, driver="a:B")]),
        (
            {"agent": "ego=a:B", "arguments": {"speed": "5"}, "from_step": 4},
            [HandOver(from_step=4, driver="a:B", arguments={"speed": "5"}, agent="ego")],
        ),
        (
            {"overrule": "brake", "leave_out": ("x",), "futures": True, "from_step": 4},
            [Overrule(from_step=4, manoeuvre="brake"), LeaveOut(actors=("x",)), Reseed(from_step=4)],
        ),
        (
            {"overrule": "bus=keep_lane", "from_step": 4},
            [Overrule(from_step=4, manoeuvre="keep_lane", agent="bus")],
        ),
        (
            {"more": (Reseed(from_step=9),), "changes": {"gap_m": "9"}},
            [Reseed(from_step=9), SetArguments(changes={"gap_m": "9"})],
        ),
    ],
    ids=str,
)
def test_options_request_interventions(options, expected):
    assert interventions_of(crash(), **{"changes": {}, **options}) == expected


@pytest.mark.parametrize(
    ("options", "message", "fix"),
    [
        ({"arguments": {"speed": "5"}}, "--arg speed has no effect without --agent", "give --agent"),
        ({"futures": True}, "--futures needs a step", "give --from-step K or --before"),
        ({"overrule": "brake"}, "--overrule brake needs a step", "give --from-step K or --before"),
        ({"overrule": "bus=brakes", "from_step": 4}, "--overrule 'bus=brakes' is no manoeuvre", "give one of brake"),
        ({"agent": "a:B", "changes": {"speed": "5"}}, "--set and --agent contradict each other", "by --arg"),
        ({"agent": "=a:B"}, "is not of the form MODULE:NAME", "ID=MODULE:NAME"),
        ({"agent": "ego="}, "is not of the form MODULE:NAME", "ID=MODULE:NAME"),
        ({"from_step": 4}, "--from-step is given without a change", "also give"),
        ({"before_s": 1.0}, "--before is given without a change", "also give"),
        ({"from_step": 4, "changes": {"gap_m": "9"}}, "--set gap_m is an argument of the scenario", "--from-step"),
        ({"before_s": 1.0, "changes": {"gap_m": "9"}}, "--set gap_m is an argument of the scenario", "--before"),
        (
            {"from_step": 4, "changes": {"ego.speed": "5", "bus.speed": "5"}},
            "--set names several agents: bus, ego", "for one agent at a time",
        ),
    ],
    ids=str,
)  # fmt: skip
def test_options_that_contradict_each_other_are_refused(options, message, fix):
    with pytest.raises(UsageError, match=message) as refused:
        interventions_of(crash(agents=("ego", "bus")), **{"changes": {}, **options})
    assert fix in refused.value.fix


class _PreparedError(Exception):
    pass


@pytest.mark.parametrize(
    ("step", "options", "message"),
    [
        (0, {}, ""), (52, {}, ""), (53, {}, "--from-step is 53"), (-1, {}, "--from-step is -1"),
        (0, {"times": 1_000_000}, ""), (0, {"times": 1_000_001}, "--times is 1000001"), (0, {"times": -1}, "is -1"),
        (0, {"code": "current"}, ""), (0, {"code": "log"}, "recorded actions cannot react"),
    ],
)  # fmt: skip
def test_runs_are_refused_before_the_crash_is_prepared(monkeypatch, step, options, message):
    def prepare(bundle, asked):
        raise _PreparedError

    monkeypatch.setattr(_engine, "prepare", prepare)
    with pytest.raises(UsageError if message else _PreparedError, match=message or None):
        what_if(crash(), [Reseed(from_step=step)], WhatIfOptions(**options))


@pytest.mark.parametrize("steps", [0, 1])
def test_crash_in_its_first_step_can_be_changed_from_the_start(steps):
    _engine._check(crash(steps), [Reseed(from_step=0)], WhatIfOptions())


@dataclass
class _Worker:
    scenario: SimpleNamespace
    code: tuple[str, ...] = ()


@dataclass
class _Rerun:
    spec: TrialSpec
    worker: _Worker
    bundle: SimpleNamespace


def rerun_of(agents):
    """A crash of agents, each with its code, that can be run again."""
    scenario = SimpleNamespace(agents={name: SimpleNamespace(agent=driver) for name, driver in agents.items()})
    scenario.with_agents = lambda drivers: rerun_of({**agents, **drivers}).worker.scenario
    spec = TrialSpec(0, 1, {name: {"speed": 3.0} for name in agents}, {}, 99)
    return _Rerun(spec, _Worker(scenario), SimpleNamespace(path=Path("/hunt/crash")))


KEEPS = "crashhunt.agents:KeepLaneWithSpeed"


@pytest.mark.parametrize(
    ("given", "driver", "arguments"),
    [
        ({}, KEEPS, {"speed": 3.0}),
        ({"arguments": {"speed": "7.5"}}, KEEPS, {"speed": 7.5}),
        ({"driver": KEEPS}, KEEPS, {"speed": 3.0}),
        ({"driver": "crashhunt.agents:CarFollowing"}, "crashhunt.agents:CarFollowing", {}),
    ],
)
def test_agent_that_takes_over_has_recorded_arguments_only_if_it_is_the_recorded_agent(given, driver, arguments):
    was = rerun_of({"ego": KEEPS, "bus": KEEPS})
    found = HandOver(from_step=4, agent="ego", **given).applied(was)
    assert found.spec.arguments == {"ego": arguments, "bus": {"speed": 3.0}}
    assert {name: setup.agent for name, setup in found.worker.scenario.agents.items()} == {"ego": driver, "bus": KEEPS}
    assert found.spec.handover == Handover("ego", 4, "/hunt/crash/log.mcap")


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"arguments": {"sped": "7"}}, f"--arg: {KEEPS} has no argument 'sped'"),
        ({"arguments": {"speed": "1:3"}}, "--arg speed: '1:3' is not a single value"),
        ({"agent": ""}, "the crash has several agents"),
        ({"agent": "tram"}, "there is no agent 'tram'"),
    ],
)
def test_agent_that_cannot_take_over_is_refused(given, message):
    with pytest.raises(UsageError, match=message):
        HandOver(**{"from_step": 4, "agent": "ego", **given}).applied(rerun_of({"ego": KEEPS, "bus": KEEPS}))


def test_what_the_engine_changes_itself_leaves_the_run_as_it_is():
    rerun = rerun_of({"ego": KEEPS})
    for one in (SetArguments(changes={"speed": "7"}), LeaveOut(actors=("a",)), Reseed(from_step=4)):
        assert one.applied(rerun) is rerun
    more = Disturbance(9, "ahead", "brake", 1.0, 1.0, "ego")
    disturbed = Disturb(disturbances=(more,)).applied(Disturb(disturbances=(replace(more, step=20),)).applied(rerun))
    assert [one.step for one in disturbed.spec.disturbances] == [9, 20]


def test_interventions_are_described_in_words():
    brake, late = (Disturbance(9, "ahead", what, 1.0, 1.0, "ego") for what in ("brake", "late_observation"))
    assert [str(one) for one in (
        HandOver(from_step=4, arguments={"speed": "7", "gap": "2"}), HandOver(from_step=4, driver="a:B"),
        Overrule(from_step=4), Overrule(from_step=4, manoeuvre="left", agent="bus"),
        SetArguments(changes={"speed": "7", "gap_m": "9"}), LeaveOut(actors=("a", "b")),
        Disturb(disturbances=(brake, late)),
    )] == [
        "the recorded agent takes over after step 4, with speed=7 and gap=2", "a:B takes over after step 4",
        "the agent is overruled after step 4: brake", "bus is overruled after step 4: left", "speed=7, gap_m=9",
        "without a, b", "ego: brake in step 9, ego: late_observation in step 9",
    ]  # fmt: skip
    assert [Disturb(disturbances=each).from_step for each in ((brake,), (late,), (brake, late))] == [8, 7, 7]
    assert Disturb(disturbances=(replace(late, step=1),)).from_step == 0
