"""Oracles that are chosen, given arguments, and bring outcomes of their own."""

from __future__ import annotations

import pickle
import sys

import pytest

from crashhunt.errors import CrashhuntError, FormulaError, UsageError
from crashhunt.oracles import (
    DEFAULT_ORACLES,
    TooClose,
    chosen_oracles,
    modules_of,
    oracle_name,
    outcomes_brought,
    parse_oracle,
    requirement_oracles,
)
from crashhunt.requirements import TRAFFIC_RULES
from crashhunt.trial import CRASHES, Outcome, in_order
from crashhunt.world import Actor, Roster, Scene

OWN = """
class Slow:
    name = "slow"
    outcomes = {"too_slow": "traffic crash"}
    def __init__(self, below: float, label: str = "x"): self.below, self.label = below, label
    def check(self, scene, agents): return []

class Wrong(Slow):
    outcomes = {"hang": "traffic crash"}

class Broken:
    def __init__(self): raise OSError("no licence")
"""


@pytest.fixture
def own(tmp_path, monkeypatch):
    (tmp_path / "own_oracles.py").write_text(OWN)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield
    sys.modules.pop("own_oracles", None)


def test_a_choice_is_a_name_and_arguments_of_the_types_that_the_oracle_declares(own):
    choice = parse_oracle("own_oracles:Slow:below=2,label=2")
    assert choice.name == oracle_name("own_oracles:Slow:below=2,label=2") == "own_oracles:Slow"
    assert choice.arguments == {"below": 2.0, "label": "2"}
    assert isinstance(choice.arguments["below"], float)
    made = choice.make()
    assert (made.below, made.label) == (2.0, "2")
    assert made is not choice.make()
    assert parse_oracle("overlap").arguments == {}
    assert oracle_name("overlap") == "overlap"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("overlaps", "did you mean 'overlap'?"),
        ("too-close:gap=1", "too-close takes no argument 'gap'; did you mean 'gap_m'?"),
        ("too-close:gap_m=1,gap_m=2", "gives 'gap_m' twice"),
        ("too-close:gap_m=1,speed", "'speed' is not an argument"),
        ("too-close:gap_m=much", "too-close:gap_m"),
        ("too-close:gap_m=0.1:2", "is not a single value"),
        ("too-close:gap_m=-1", "gap_m is -1"),
        ("overlap:gap_m=1", "overlap takes no argument 'gap_m'; it takes no arguments"),
        ("own_oracles:Wrong:below=1", "'hang' is a software fault, not a traffic crash"),
        ("own_oracles:Broken", "the oracle 'own_oracles:Broken' cannot be created: OSError: no licence"),
        ("own_oracles:Slow", "missing 1 required positional argument: 'below'"),
        ("", "names no oracle"),
    ],
)
def test_a_choice_that_cannot_be_had_is_refused_in_one_line(own, text, said):
    with pytest.raises(CrashhuntError) as refused:
        chosen_oracles([text])
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)


def test_chosen_oracles_come_after_the_default_ones_unless_none_drops_these():
    assert chosen_oracles([]) == DEFAULT_ORACLES
    assert chosen_oracles(["too-close", "overlap"]) == (*DEFAULT_ORACLES, "too-close")
    assert chosen_oracles(["none", "overlap"]) == ("overlap",)
    with pytest.raises(CrashhuntError, match="leaves no oracle"):
        chosen_oracles(["none"])


def test_an_outcome_of_ones_own_has_a_category_that_goes_along_to_other_processes(own):
    (outcome,) = outcomes_brought(["overlap", "own_oracles:Slow:below=1"])
    assert outcome == "too_slow"
    assert outcome.is_own
    assert outcome.is_traffic_crash
    assert outcome not in CRASHES
    assert outcome not in list(Outcome)
    assert pickle.loads(pickle.dumps(outcome)) is outcome is Outcome("too_slow")
    assert in_order(["too_slow", "hang", "survived"]) == [Outcome.SURVIVED, Outcome.HANG, outcome]
    for text in ("Too slow", "too-slow", "", "_", "x" * 41):
        with pytest.raises(ValueError, match="not a valid"):
            Outcome(text)
    assert [outcome.category for outcome in Outcome].count("no crash") == 3


def scene(gap_m, *, speed=10.0, other_speed=5.0, turn=0.0):
    """The agent, 4.5 m long, behind another vehicle of 4 m; turned, it stands across ahead of the other's flank."""
    roster = Roster((Actor("ego", "car", 4.5, 1.8), Actor("left.3", "car", 4.0, 2.0), Actor("far", "car", 4.0, 2.0)))
    ahead = (gap_m + 4.0, 0.0) if not turn else (gap_m + 1.0, 2.0)
    points, headings = [(0.0, 0.0), ahead, (500.0, 0.0)], [0.0, turn, 0.0]
    return Scene(1.0, roster, points, headings, [speed, other_speed, 0.0])


@pytest.mark.parametrize("turn", [0.0, 1.5707963267948966])
def test_a_near_miss_is_a_gap_below_the_limit_and_no_contact(turn):
    oracle = TooClose(gap_m=0.5)
    near = scene(0.3, turn=turn)
    near.agent_lanes = {"ego": "east_1"}
    (finding,) = oracle.check(near, ["ego"])
    assert finding.outcome == "too_close"
    assert finding.event.lane == "east_1"
    assert finding.event.what == "ego came within 0.30 m of left.3"
    assert finding.event.others == ("left.3",)
    assert finding.event.speed == 10.0
    assert oracle.check(scene(0.51, turn=turn), ["ego"]) == []
    assert oracle.check(scene(-0.1, turn=turn), ["ego"]) == []  # the overlap oracle's business
    assert oracle.check(scene(0.3, turn=turn), ["nobody"]) == []


def test_of_several_the_nearest_is_reported():
    roster = Roster(tuple(Actor(name, "car", 4.0, 2.0) for name in ("ego", "ahead", "beside", "touched")))
    points = [(0.0, 0.0), (4.4, 0.0), (0.0, 2.2), (0.0, -1.9)]  # 0.4 m, 0.2 m, and not missed
    near = Scene(1.0, roster, points, [0.0] * 4, [10.0, 5.0, 5.0, 5.0])
    (finding,) = TooClose(gap_m=0.5).check(near, ["ego"])
    assert finding.event.what == "ego came within 0.20 m of beside"


def test_the_one_that_creeps_up_in_a_queue_has_no_near_miss():
    assert TooClose(gap_m=0.5, speed=1.0).check(scene(0.3, speed=5.5), ["ego"]) == []
    assert [bool(TooClose(speed=0.0).check(scene(gap, speed=5.5), ["ego"])) for gap in (0.4, 0.6)] == [True, False]
    assert TooClose(gap_m=0.5, speed=0.0).check(scene(0.3, speed=5.5), ["ego"]) != []
    assert TooClose(gap_m=0.5, speed=0.0).check(scene(0.3, speed=0.0), ["ego"]) == []  # it has not come near


def test_modules_of_oracles_are_known_without_an_import():
    assert modules_of(["a.b:C:label=x:y", "collision", "requirement:calm=speed < 5", "c:D"]) == ["a.b", "c"]


def test_requirements_become_oracles_under_their_names():
    name, rule = next(iter(TRAFFIC_RULES.items()))
    formula = " ".join(rule.formula.split())
    assert requirement_oracles([f" {name} ", f"mine = {name}", "calm=always  (x > 1)", "x == 1", "x > 2"]) == [
        f"requirement:{name.replace('-', '_')}={formula}", f"requirement:mine={formula}",
        "requirement:calm=always (x > 1)", "requirement:requirement=x == 1", "requirement:requirement_5=x > 2",
    ]  # fmt: skip
    with pytest.raises(UsageError, match="--require: 'calm' is given twice"):
        requirement_oracles(["calm=x > 1", "calm=x > 2"])
    with pytest.raises(FormulaError) as refused:
        requirement_oracles(["calm=always (x >"])
    assert refused.value.where == "--require calm"
