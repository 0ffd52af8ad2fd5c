"""What `assert_survives` asks of a hunt, and what it prints, without running a trial."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from crashhunt.agents import KeepLaneWithSpeed
from crashhunt.errors import CrashhuntError, UsageError
from crashhunt.plans import Request
from crashhunt.testing import _survives, assert_survives
from crashhunt.trial import Disturbance, Outcome, TrialResult, TrialSpec

SPEC = TrialSpec(number=4, seed=9, arguments={"ego": {"speed": 21.0}}, scenario_arguments={"gap_m": 20.0}, max_steps=80)


def result(outcome=Outcome.COLLISION, **changes):
    spec = TrialSpec(**{name: getattr(SPEC, name) for name in SPEC.__slots__} | changes)
    return TrialResult(spec, outcome, steps=3, wall_s=0.1)


@pytest.fixture
def hunt(monkeypatch):
    """Replace hunts: what was asked for is in `asked`, and `report` is what a hunt returns."""
    found = SimpleNamespace(asked=[], stopped_because="trials", reason="", crashes=[], shrunk=[])

    def run(*words, **options):
        found.asked.append((words, options))
        return found

    def shrink(bundle, **options):
        found.shrunk.append((bundle, options))
        return SimpleNamespace(small=found.small)

    monkeypatch.setattr(_survives, "run", run)
    monkeypatch.setattr(_survives, "shrink", shrink)
    found.small = None
    return found


def test_hunt_has_what_was_asked_for(hunt, tmp_path):
    assert_survives(
        KeepLaneWithSpeed, "toy", trials=3, max_steps=7, seed=5, parallel=2, directory=tmp_path,
        arguments={"speed": "4:6"}, scenario_arguments={"gap_m": 9},
    )  # fmt: skip
    ((words, options),) = hunt.asked
    assert words == (tmp_path, 2, 3, 7)
    assert options == {
        "deterministic": True, "agent": KeepLaneWithSpeed, "scenario": "toy", "arguments": {"speed": "4:6"},
        "scenario_arguments": {"gap_m": 9}, "seed": 5,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("why", "error", "message"),
    [
        ("interrupted", KeyboardInterrupt, "^$"),
        ("no_valid_trial", CrashhuntError, "no trial could be set up: bad; correct"),
    ],
)
def test_hunt_without_verdict_is_no_success(hunt, why, error, message):
    hunt.stopped_because, hunt.reason = why, "bad"
    with pytest.raises(error, match=message):
        assert_survives("keep-lane", "toy")


def test_minimized_crash_is_printed_with_the_place_of_a_kept_hunt(hunt, tmp_path):
    large, small = (SimpleNamespace(id=name, result=result(seed=seed)) for name, seed in (("large", 1), ("small", 2)))
    hunt.crashes = [large]
    for budget, directory, smaller, shown in (
        (5, None, small, small),
        (5, tmp_path, None, large),
        (0, None, small, large),
    ):
        hunt.small = smaller
        with pytest.raises(AssertionError) as caught:
            assert_survives("keep-lane", "toy", max_steps=80, budget=budget, parallel=3, directory=directory)
        lines = str(caught.value).splitlines()
        assert f"'seed': {shown.result.spec.seed}" in lines[3]
        assert lines[4:] == ([f"look at it: crashhunt show {tmp_path} --crash large"] if directory else [])
    assert hunt.shrunk == [(large, {"budget": 5, "parallel": 3, "form": "traffic"})] * 2


def test_crash_that_cannot_be_minimized_is_printed_as_it_is(hunt, monkeypatch):
    def fail(*_, **__):
        raise CrashhuntError("no", fix="no")

    monkeypatch.setattr(_survives, "shrink", fail)
    hunt.crashes = [SimpleNamespace(id="large", result=result(seed=1))]
    with pytest.raises(AssertionError, match="'seed': 1"):
        assert_survives("keep-lane", "toy")


def test_example_replaces_arguments_of_its_names_only():
    arguments = {"speed": 1.0, "ego.speed": 2.0}
    options = Request(agent="keep-lane", arguments=arguments, scenario_arguments={"a": 1}, trials=1, max_steps=9)
    example = {"arguments": {"ego": {"speed": 3.0, "mode": "x|y"}}, "scenario_arguments": {"b": 2}}
    found = _survives._asking(options, example)
    assert found.arguments == {"speed": "1.0", "ego.speed": "3.0"}  # a text with | would be read as a choice
    assert found.scenario_arguments == {"a": "1", "b": "2"}
    assert found.agents == {"": "keep-lane"}
    assert _survives._asking(Request(trials=1, max_steps=9), {}).arguments == {}
    with pytest.raises(UsageError, match="the example has the unknown key 'seeds'; did you mean 'seed'"):
        _survives._asking(options, {"seeds": 1})
    with pytest.raises(UsageError, match=r"the arguments of 'speed' are 3.0; give the arguments of each agent"):
        _survives._asking(options, {"arguments": {"speed": 3.0}})


@pytest.mark.parametrize("outcome", [Outcome.SURVIVED, Outcome.FINISHED, Outcome.COLLISION, Outcome.HANG])
def test_example_alone_is_run_and_judged(hunt, monkeypatch, outcome):
    asked = []
    monkeypatch.setattr(_survives, "_run_one", lambda *words: asked.append(words) or result(outcome))
    example = {"seed": 3}
    if outcome in (Outcome.SURVIVED, Outcome.FINISHED):
        assert_survives("keep-lane", "toy", max_steps=80, example=example)
    else:
        with pytest.raises(AssertionError, match="This call runs that trial alone"):
            assert_survives("keep-lane", "toy", max_steps=80, example=example)
    ((request, given),) = asked
    assert (request.agents, request.scenario, given) == ({"": "keep-lane"}, "toy", example)
    assert request.max_steps == 80
    assert hunt.asked == []


def test_printed_call_has_all_of_the_trial():
    erring = Disturbance(5, "ahead", "brake", 4.0, 0.5, "ego", "other")
    text = _survives._told(result(only=("left.1",), disturbances=(erring,)), "'a', 'toy', max_steps=80", "")
    lines = text.splitlines()
    assert lines[0] == ""
    assert len(lines) == 4
    called = {}
    exec(lines[3].strip(), {"assert_survives": lambda *words, **options: called.update(words=words, **options)})
    assert called == {
        "words": ("a", "toy"),
        "max_steps": 80,
        "example": {
            "seed": 9, "arguments": {"ego": {"speed": 21.0}}, "scenario_arguments": {"gap_m": 20.0},
            "only": ["left.1"], "disturbances": [erring.to_json()],
        },
    }  # fmt: skip
    plain = _survives._told(result(), "'a'", "look")
    assert "only" not in plain
    assert "disturbances" not in plain
    assert plain.splitlines()[-1] == "look"
    assert _survives._word(KeepLaneWithSpeed) == "KeepLaneWithSpeed"
    assert _survives._word("a:b") == "'a:b'"


class Executor:
    """Gives one result, at the second request."""

    def __init__(self, worker):
        self.worker, self.requests, self.closed = worker, 0, 0
        made.append(self)

    def submit(self, spec):
        self.spec = spec

    def completed(self, timeout_s):
        self.requests += 1
        return [result(outcome)] if self.requests > 1 else []

    def close(self):
        self.closed += 1


made: list[Executor] = []
outcome = Outcome.COLLISION


@pytest.mark.parametrize("found", [Outcome.COLLISION, Outcome.INVALID])
def test_trial_of_an_example_has_its_values_and_no_others(toy, monkeypatch, found):
    monkeypatch.chdir(toy.folder)
    monkeypatch.setattr(_survives, "PoolExecutor", Executor)
    monkeypatch.setitem(globals(), "outcome", found)
    erring = Disturbance(5, "ahead", "brake", 4.0, 0.5, "ego", "other")
    example = {
        "arguments": {"ego": {"speed": 21.0}}, "scenario_arguments": {"gap_m": 20.0}, "only": ["left.1"],
        "disturbances": [erring.to_json()], "seed": 3,
    }  # fmt: skip
    options = Request(agent="keep-lane", scenario="toy", trials=1, max_steps=77)
    for given in (example, {}):
        if found is Outcome.INVALID:
            with pytest.raises(CrashhuntError, match="the example could not be set up: "):
                _survives._run_one(options, given)
        else:
            assert _survives._run_one(options, given).spec == made[-1].spec
        assert made[-1].closed == 1
        assert not made[-1].worker.scratch.exists()
    full, empty = (executor.spec for executor in made[-2:])
    assert (full.number, full.seed, full.max_steps) == (0, 3, 77)
    assert (full.arguments, full.scenario_arguments) == (example["arguments"], {"gap_m": 20.0})
    assert (full.only, full.disturbances) == (("left.1",), (erring,))
    assert (empty.seed, empty.arguments, empty.scenario_arguments) == (0, {}, {})
    assert (empty.only, empty.disturbances) == (None, ())


def test_call_without_options_has_the_values_of_its_signature(hunt):
    hunt.crashes = [SimpleNamespace(id="large", result=result(seed=1))]
    hunt.small = None
    with pytest.raises(AssertionError, match="max_steps=500, example="):
        assert_survives("keep-lane", "toy")
    ((words, options),) = hunt.asked
    assert words[1:] == (0, 20, 500)
    assert options["seed"] == 0
    assert [options for _, options in hunt.shrunk] == [{"budget": 100, "parallel": 0, "form": "traffic"}]


def test_failure_is_shown_in_the_test_and_not_inside_crashhunt(hunt):
    hunt.crashes = [SimpleNamespace(id="large", result=result(seed=1))]
    with pytest.raises(AssertionError) as caught:
        assert_survives("keep-lane", "toy")
    assert caught.traceback.filter(caught)[-1].path.name == "test_assert_survives.py"
