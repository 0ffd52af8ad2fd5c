"""What `--crash-on` may be given: outcomes, traffic events, and their limits."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import ClassVar

import pytest

from crashhunt.errors import ScenarioError, UsageError
from crashhunt.ledger import Ledger
from crashhunt.plans import Request, plan, read_settings, with_settings, write_settings
from crashhunt.plans._choices import parse_crash_on
from crashhunt.scenario import load_scenario, shipped_folder
from crashhunt.trial import CRASHES, EVENTS, Outcome, TrialResult, TrialSpec
from crashhunt.world import EVENT_WORDS, Event, event_counts


def test_traffic_events_are_no_crash_unless_named():
    assert [str(outcome) for outcome in CRASHES] == [
        "collision", "off_road", "agent_error", "simulator_error", "process_died", "hang",
    ]  # fmt: skip
    assert tuple(EVENTS) == tuple(EVENT_WORDS)
    assert {outcome.category for outcome in EVENTS} == {"traffic event"}
    assert not any(outcome.is_traffic_crash or outcome.is_software_fault for outcome in EVENTS)


def test_names_and_limits():
    assert parse_crash_on(["red_light", "collision"]) == ((Outcome.COLLISION, Outcome.RED_LIGHT), {})
    found = parse_crash_on(["not_moving:30", "hard_braking:6.5", "teleport"])
    assert found == (
        (Outcome.NOT_MOVING, Outcome.HARD_BRAKING, Outcome.TELEPORT),
        {"not_moving": 30, "hard_braking": 6.5},
    )


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["red-light"], "did you mean 'red_light'?"),
        (["redlight"], "did you mean 'red_light'?"),
        (["too_fast"], "'too_fast' is not an outcome that can count as a crash"),  # of an oracle that is not chosen
        (["survived"], "'survived' is not an outcome that can count as a crash"),
        (["teleport:3"], "teleport has no limit; write teleport alone; only not_moving and hard_braking have a limit"),
        (["not_moving:"], "'' is not a limit; give s above 0, such as not_moving:30"),
        (["not_moving:0"], "'0' is not a limit"),
        (["hard_braking:nan"], "'nan' is not a limit; give m/s² above 0"),
        (["hard_braking:soft"], "'soft' is not a limit"),
        ([], "names no outcome"),
    ],
)
def test_what_is_none_is_reported_in_one_line(words, message):
    with pytest.raises(UsageError) as caught:
        parse_crash_on(words)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_limits_reach_the_simulator_and_the_file(tmp_path):
    request = Request(trials=1, max_steps=10, seed=1, crash_on=("collision", "not_moving:12.5"))
    scenario, settings = plan(request)
    assert settings.events == {"not_moving": 12.5}
    assert with_settings(scenario, settings).events == {"not_moving": 12.5}
    assert settings.crash_on_words == ("collision", "not_moving:12.5")
    write_settings(tmp_path / "hunt.toml", settings, ["crashhunt"])
    assert read_settings(tmp_path / "hunt.toml") == settings
    _, other = plan(replace(request, crash_on=("collision", "not_moving:13")))
    assert settings.differences(other) == ["events.not_moving was 12.5 and is now 13.0"]
    _, plain = plan(replace(request, crash_on=("collision",)))
    assert plain.scenario_digest == settings.scenario_digest
    write_settings(tmp_path / "plain.toml", plain, ["crashhunt"])
    assert "events" not in (tmp_path / "plain.toml").read_text()  # as before there were any


def test_what_a_simulator_never_reports(tmp_path):
    with pytest.raises(
        UsageError, match="the simulator 'highway' cannot report these outcomes; it reports wrong_way, not_moving"
    ):
        plan(Request(trials=1, max_steps=10, scenario="highway", crash_on=("red_light",)))
    scenario, _ = plan(Request(trials=1, max_steps=10, scenario="highway", crash_on=("red_light", "collision")))
    assert "the simulator 'highway' never reports red_light" in scenario.notes


@pytest.mark.parametrize(
    ("options", "note"),
    [
        (
            {"oracles": ("too-close:gap_m=1",)},
            "--oracle too-close:gap_m=1 detects nothing: Gymnasium shows no vehicles",
        ),
        ({"crash_on": ("collision", "off_road")}, "the simulator 'gym' never reports off_road"),
        ({"oracles": ("red-light",)}, "the simulator 'gym' never reports red_light"),
        ({"oracles": (f"{__name__}:RedLamp",)}, ""),
        ({"oracles": (f"{__name__}:RedLamp",), "crash_on": ("red_light",)}, ""),
        ({}, ""),
    ],
)
def test_oracle_or_outcome_that_never_occurs_with_a_simulator_has_a_note(tmp_path, options, note):
    request = Request(trials=1, max_steps=10, scenario=str(environment_in(tmp_path)), **options)
    scenario, _ = plan(request)
    assert [text for text in scenario.notes if "nothing" in text or "never" in text] == [note] * bool(note)
    with pytest.raises(UsageError, match="the simulator 'gym' cannot report these outcomes"):
        plan(replace(request, oracles=("too-close",), crash_on=("too_close", "off_road")))


class RedLamp:
    """An oracle that reports an event from evidence of its own."""

    name = "red-lamp"
    outcomes: ClassVar = {"red_light": "traffic event"}

    def check(self, scene, agents):
        return []


def environment_in(folder):
    (folder / "scenario.toml").write_text(
        'schema = 1\nsimulator = "gym"\nstep_length_s = 1.0\n[agents.ego]\nagent = "crashhunt.agents:RandomAgent"\n'
        '[gym]\nid = "CartPole-v1"\n[gym.crash]\ntermination = true\n'
    )
    return folder


@pytest.mark.parametrize(("key", "message"), [("red_light = 3", "has no limit"), ("not_moving = 0", "is not a limit")])
def test_limits_of_a_scenario(tmp_path, key, message):
    text = (shipped_folder() / "loop" / "scenario.toml").read_text()
    for file in (shipped_folder() / "loop").iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    (tmp_path / "scenario.toml").write_text(f"{text}\n[events]\n{key}\n")
    with pytest.raises(ScenarioError, match=message):
        load_scenario(tmp_path)
    (tmp_path / "scenario.toml").write_text(f"{text}\n[events]\nnot_moving = 20\n")
    assert load_scenario(tmp_path).events == {"not_moving": 20.0}


def test_results_from_before_there_were_events(tmp_path):
    spec = TrialSpec(0, 1, {"ego": {}}, {}, max_steps=10)
    event = Event("red_light", "ego", "ego ran a red light", lane="a_0")
    result = TrialResult(spec, Outcome.RED_LIGHT, steps=3, event=event, events={"red_light": 2})
    assert TrialResult.from_json(json.loads(json.dumps(result.to_json()))) == replace(
        result, event=TrialResult.from_json(result.to_json()).event
    )
    assert result.summary == "ego ran a red light, at step 3"
    old = {name: value for name, value in result.to_json().items() if name not in ("event", "events")}
    found = TrialResult.from_json(old)
    assert (found.event, found.events) == (None, None)
    with_more = Event.from_json({**event.to_json(), "what_comes_next": 1})
    assert with_more.what == event.what


def test_counts_over_a_ledger(tmp_path):
    ledger = Ledger(tmp_path / "ledger.sqlite", writable=True)
    for number, events in enumerate([{"red_light": 2, "teleport": 1}, {}, None, {"red_light": 1}]):
        spec = TrialSpec(number, 1, {"ego": {}}, {}, max_steps=10)
        ledger.record(TrialResult(spec, Outcome.SURVIVED, events=events), snapshot="x")
    assert ledger.traffic_events() == {"red_light": (3, 2), "teleport": (1, 1)}
    ledger.close()
    assert event_counts({"red_light": 3, "teleport": 1, "wrong_way": 0}) == "3 red lights run, 1 teleport"
