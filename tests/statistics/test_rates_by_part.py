"""The crash rate of a hunt, and what divides it into parts: disturbances, and bins of an argument."""

from __future__ import annotations

import math
from contextlib import closing
from types import SimpleNamespace

import pytest
from test_comparison import hunt

from crashhunt.errors import HuntDirectoryError, UsageError
from crashhunt.ledger import Ledger
from crashhunt.report import describe_rates
from crashhunt.results import HuntResults
from crashhunt.statistics import compare, measure_rates
from crashhunt.statistics._hunt_rate import _bins, _division, rate_of_counts, rate_of_trials
from crashhunt.training import HeldOutTraffics
from crashhunt.trial import Choice, Range

SPACE = {
    ("ego", "speed"): Range(0.0, 8.0),
    ("", "traffic"): Range(1, 3, integer=True),
    ("ego", "gap"): Choice((5, 10)),
    ("", "gap"): Range(0.0, 1.0),
}
SETTINGS = SimpleNamespace(space=SPACE, disturb=("brake=0.1",))


def division(by, settings=SETTINGS):
    return _division(by, SimpleNamespace(crashes=[]), settings, {"dropped": {"rear end": [4, 5]}})


def trial(number=0, *, disturbances=(), **arguments):
    spec = {"number": number, "arguments": {"ego": arguments}, "scenario_arguments": {"traffic": 2, "gap": 0.6}}
    return {"spec": spec, "disturbances": [{"what": what} for what in disturbances]}


@pytest.mark.parametrize(
    ("distribution", "count", "places"),
    [
        (Range(0.0, 8.0), 4, {0.0: "0 to 2", 1.9: "0 to 2", 2.1: "2 to 4", 7.9: "6 to 8", 8.0: "6 to 8"}),
        (Range(1.0, 16.0, log=True), 2, {1.0: "1 to 4", 3.9: "1 to 4", 4.1: "4 to 16"}),
        (Range(1, 3, integer=True), 4, {1: "1", 2: "2", 3: "3"}),
        (Range(1, 100, integer=True), 2, {1: "1 to 50", 50: "1 to 50", 51: "51 to 100"}),
        (Range(5, 20, integer=True), 4, {8: "5 to 8", 9: "9 to 12", 13: "13 to 16", 20: "17 to 20"}),
        (Range(1, 5, integer=True), 2, {2: "1 to 2", 3: "3 to 5"}),
        (Range(20_000, 20_003, integer=True), 2, {20_001: "20000 to 20001", 20_002: "20002 to 20003"}),
        (Range(0.0, 1.0, step=0.1), 4, {0.2: "0 to 0.2", 0.3: "0.3 to 0.4", 1.0: "0.8 to 1"}),
        (Range(20.0, 20.01), 2, {20.001: "20 to 20.005", 20.009: "20.005 to 20.01"}),
        (Range(3.0, 3.0), 1, {3.0: "3.0"}),
        (Choice(("a", "b")), 1, {"a": "a", "b": "b"}),
    ],
    ids=str,
)
def test_bins_are_equally_likely_parts_of_a_distribution(distribution, count, places):
    labels, place = _bins(distribution, count)
    assert list(dict.fromkeys(places.values())) == [label for label in labels if label in places.values()]
    assert {value: labels[place(value)] for value in places} == places
    assert len(labels) == (count if isinstance(distribution, Range) and distribution.high != 3 else len(set(labels)))


def test_argument_is_named_alone_or_with_its_vehicle():
    speed, traffic = division("speed:4"), division("traffic")
    assert (speed.by, speed.of_crashes, speed.names[0]) == ("speed", False, "0 to 2")
    assert speed.tag(trial(speed=7.5)) == "6 to 8"
    assert traffic.tag(trial()) == "2"
    assert (division("ego.gap").tag(trial(gap=10)), division("scenario.gap:2").tag(trial())) == ("10", "0.5 to 1")


@pytest.mark.parametrize(
    ("by", "message", "fix"),
    [
        ("gap", "there is no argument 'gap'", "ego.gap"),  # two arguments have this name
        ("sped", "there is no argument 'sped'", "speed"),
        ("kind:3", "--by kind:3: kind", "give --by kind"),
        ("speed:0", "'0' is not a number of bins", "give 1 to"),
        ("speed:x", "'x' is not a number of bins", "give 1 to"),
        ("speed:999999", "'999999' is not a number of bins", "give 1 to"),
    ],
)
def test_mistakes_in_a_division_name_the_fix(by, message, fix):
    with pytest.raises(UsageError) as caught:
        division(by)
    assert message in caught.value.message
    assert fix in caught.value.fix


def test_crashes_are_divided_by_disturbance():
    both, first = division(""), division("disturbance")
    plain, disturbed = trial(), trial(disturbances=("brake", "stop"))
    assert [both.tag(one) for one in (plain, disturbed)] == list(both.names)
    assert [first.tag(one) for one in (plain, disturbed)] == [both.names[0], "brake"]
    assert (both.by, both.of_crashes, first.of_crashes) == ("disturbance", True, True)
    whole = division("", SimpleNamespace(space={}, disturb=()))
    assert (whole.by, whole.names, whole.tag(disturbed)) == ("", (), "")


def test_types_of_crashes_without_a_bundle_are_known():
    kinds, faults = division("kind"), division("fault")
    assert kinds.tag(trial(number=5)) == "rear end"
    assert kinds.tag(trial(number=6)) == faults.tag(trial(number=5)) != "rear end"


def test_rate_per_trial_has_an_interval_and_its_parts(tmp_path):
    (rate,) = measure_rates(hunt(tmp_path / "h", 10), per="trial", by="gap_m:2")
    assert (rate.units, rate.trials, rate.crashes, rate.steps, rate.estimate) == (40, 40, 10, 360, 0.25)
    assert (rate.confidence, rate.why_not, rate.dir) == (95.0, "", str(tmp_path / "h"))
    assert rate.certain.low < 0.25 < rate.certain.high
    low, high = rate.parts  # gap_m is 20 + number, and the range ends at 30
    assert [(part.by, part.name, part.trials, part.crashes) for part in rate.parts] == [
        ("gap_m", "20 to 25", 5, 5), ("gap_m", "25 to 30", 35, 5)
    ]  # fmt: skip
    assert low.estimate == 1.0
    assert high.estimate == pytest.approx(1 / 7)
    # Both intervals hold together with 95 %, so each is wider than one of the same trials alone.
    (alone,) = measure_rates(tmp_path / "h", per="trial", by="gap_m:1")
    (part,) = alone.parts
    assert (part.certain.low, part.certain.high) == (rate.certain.low, rate.certain.high)
    (surer,) = measure_rates(tmp_path / "h", per="trial", confidence=97.5)
    (halves,) = measure_rates(hunt(tmp_path / "w", 10, gap="20.0:60.0"), per="trial", by="gap_m:2")
    first = measure_rates(hunt(tmp_path / "f", 10, trials=20), per="trial", confidence=97.5)[0]
    assert (halves.parts[0].certain.low, halves.parts[0].certain.high) == (first.certain.low, first.certain.high)
    assert surer.certain.low < rate.certain.low


def test_every_unit_of_a_rate_is_measured_by_default(tmp_path):
    assert [rate.per for rate in measure_rates(hunt(tmp_path / "h", 10))] == ["trial", "hour", "1000km"]


@pytest.mark.parametrize(
    ("given", "why"),
    [
        ({"keep_going": False}, "the hunt stops at its first crash"),
        ({"distinct": 3}, "the hunt stops at 3 crash types"),
        ({"seeds": 8}, ""),
    ],
    ids=str,
)
def test_estimate_is_withheld_if_crashes_decide_the_number_of_trials(tmp_path, given, why):
    (rate,) = measure_rates(hunt(tmp_path / "h", 10, **given), per="trial")
    assert (rate.estimate is None) == bool(why)
    assert rate.why_not.startswith(why)
    assert 0 < rate.certain.low < rate.certain.high <= 1


@pytest.mark.parametrize("seeds", [0, 8])
def test_estimate_is_withheld_where_trials_were_changed_after_results(tmp_path, seeds):
    path = hunt(tmp_path / "h", 10, seeds=seeds)
    (before,) = measure_rates(path, per="trial", by="gap_m:2")
    assert before.estimate == 0.25
    with closing(Ledger(path / "ledger.sqlite", writable=True)) as ledger:
        ledger.note(replanned=True)
    (rate,) = measure_rates(path, per="trial", by="gap_m:2")
    assert rate.estimate is None
    assert rate.why_not.startswith("TRIALS was changed after results were known")
    assert [part.estimate for part in rate.parts] == [None] * len(rate.parts)
    # The interval is valid whenever looked at, but TRIALS decides which trials are a unit of --seeds.
    assert rate.certain == (None if seeds else before.certain)
    figures = compare(path, hunt(tmp_path / "other", 2)).hunts[0]
    assert (math.isnan(figures.crash_rate), figures.interval) == (True, None if seeds else tuple(before.certain))
    found = HuntResults(path)
    with closing(Ledger(path / "ledger.sqlite")) as ledger:
        again = rate_of_trials(path, found.settings, found.facts, ledger.plain_results(), HeldOutTraffics(()))
    assert (again.estimate, again.certain, again.why_not) == (None, rate.certain, rate.why_not)


def test_grid_that_was_extended_has_no_share_of_crashes(tmp_path):
    path = hunt(tmp_path / "h", 10, sampler="grid")
    other = hunt(tmp_path / "other", 2)
    assert compare(path, other).hunts[0].crash_rate == 0.25
    with closing(Ledger(path / "ledger.sqlite", writable=True)) as ledger:
        ledger.note(replanned=True)
    assert math.isnan(compare(path, other).hunts[0].crash_rate)


def test_hunt_whose_trials_are_not_independent_has_no_rate(tmp_path):
    path = hunt(tmp_path / "h", 10, sampler="grid")
    (rate,) = measure_rates(path, per="trial", bar=0.1)
    assert (rate.certain, rate.estimate, rate.verdict) == (None, None, "undecided")
    assert "the sampler grid does not draw trials independently" in rate.why_not
    assert "undecided about the bar of 0.1 per trial: there is no rate" in describe_rates([rate])


@pytest.mark.parametrize(
    ("crashes", "bar", "verdict", "text"), [(0, 0.3, "below", "0.3"), (10, 0.001, "above", "0.001")]
)
def test_verdict_on_a_bar_is_a_line(tmp_path, crashes, bar, verdict, text):
    (rate,) = measure_rates(hunt(tmp_path / "h", crashes), per="trial", bar=bar)
    assert (rate.verdict, rate.crashes, rate.estimate) == (verdict, crashes, crashes / 40)
    assert (rate.certain.low >= bar) == (verdict == "above")
    line = describe_rates([rate]).splitlines()[-1]
    words = "at most" if verdict == "below" else "at least"
    assert line.startswith(f"  certainly {verdict} the bar of {text} per trial: {words} ")
    assert (float(line.split()[-1]) < bar) == (verdict == "below")


def test_verdict_on_a_bar_and_its_interval_are_on_the_same_side_whatever_is_rounded(tmp_path):
    (rate,) = measure_rates(hunt(tmp_path / "h", 10), per="trial")
    for bar, end in ((rate.certain.high * 1.0004, "below"), (rate.certain.low * 0.9996, "above")):
        (found,) = measure_rates(tmp_path / "h", per="trial", bar=bar)
        line = describe_rates([found]).splitlines()[-1]
        assert line.strip().startswith(f"certainly {end}")
        assert (float(line.split()[-1]) < bar) == (end == "below")
    (found,) = measure_rates(tmp_path / "h", per="trial", bar=rate.certain.high * 0.9996)
    line = describe_rates([found]).splitlines()[-1].strip()
    assert line.startswith("undecided, because the rate may be ")
    assert float(line.split(" to ")[1].split(":")[0]) > rate.certain.high * 0.9996


def test_rate_of_the_trials_up_to_the_decision_of_a_bar(tmp_path):
    path = hunt(tmp_path / "h", 10, until_rate="0.1/trial")
    with closing(Ledger(path / "ledger.sqlite", writable=True)) as ledger:
        ledger.enter("rate", planned=40, hunt_seed=1, until_rate={"decided_at": 19})
    (rate,) = measure_rates(path, per="trial")
    assert (rate.trials, rate.crashes, rate.estimate) == (20, 10, None)
    assert rate.why_not.startswith("--until-rate ends the hunt by its crashes")
    assert rate.certain is not None


def test_counts_and_trials_give_the_measured_rate(tmp_path):
    path = hunt(tmp_path / "h", 10)
    (measured,) = measure_rates(path, per="trial")
    found = HuntResults(path)
    with closing(Ledger(path / "ledger.sqlite")) as ledger:
        facts, trials = ledger.facts(), [*ledger.plain_results()]
    assert rate_of_trials(path, found.settings, facts, trials, HeldOutTraffics(0)) == measured
    counts = {"valid": 40, "invalid": 0, "crashes": 10, "steps": 360}
    counted = rate_of_counts(path, found.settings, facts, excluded=0, **counts)
    assert counted == measured
    more = rate_of_counts(path, found.settings, facts, excluded=2, **counts)
    assert more.excluded == {"after_unfinished": 2}


def test_damaged_hunt_has_no_rate(tmp_path):
    path = hunt(tmp_path / "h", 10)
    (path / "ledger.sqlite").write_bytes(b"x" * 4096)
    with pytest.raises(HuntDirectoryError):
        measure_rates(path)
