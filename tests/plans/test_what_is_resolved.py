"""What a request becomes: the executor, the scenario, the settings and their file."""

from __future__ import annotations

import os
import sys
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import pytest
from conftest import one_in

from crashhunt.disturbances import ModelApart
from crashhunt.errors import ArgumentError, HuntDirectoryError, PluginError, ScenarioError, UsageError
from crashhunt.executors import FreshProcessExecutor, PoolExecutor
from crashhunt.plans import (
    Owners,
    Request,
    Takes,
    agent_of,
    disturber_apart,
    hunt_options,
    plan,
    read_settings,
    takes_of,
    with_settings,
    write_settings,
)  # fmt: skip
from crashhunt.plans._arguments import _spec
from crashhunt.plans._code import _check_defaults, notes_on_programs
from crashhunt.plans._executor_choice import executor_of, parallel_here, sizes_itself
from crashhunt.scenario import copy_shipped_scenario
from crashhunt.sumo._options import SumoSetup
from crashhunt.trial import Argument, CallSignature, parse_spec

EXECUTORS = """
class Cluster:
    sizes_itself = True

    def __init__(self, worker, *, parallel, argument=""):
        self.asked = worker, parallel, argument

class Alone:
    sizes_itself = False

    def __init__(self, worker, *, parallel):
        pass

def anything(worker, **options):
    return worker, options
"""
SCENARIO = """
title = "A toy"
schema = 1
simulator = "toy"
[arguments.gap_m]
default = 12.0
range = "5:20"
[arguments.needed]
{needed}
[agents.ego]
agent = "drives:Agent"
[agents.ego.arguments.speed]
default = 9.0
range = "8:14"
"""
AGENT = """
class Agent:
    def __init__(self, speed: float = 7.0, mode: str = "a|b", needed=None, gap: float = "wide", step_length_s=1):
        pass
    def reset(self, seed): ...
    def act(self, observation): ...

class Either(Agent):
    def __init__(self, gap: float | str = "wide", far: str | float = 30, name: str | float = "7"):
        pass

class Needs(Agent):
    def __init__(self, speed: float, weights: str):
        pass

class Open(Agent):
    def __init__(self, speed: float = 7.0, *, observation_space, **options):
        pass
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with executors, agents and a scenario, from which they are imported."""
    (tmp_path / "ours.py").write_text(EXECUTORS)
    (tmp_path / "drives.py").write_text(AGENT)
    (tmp_path / "scenario.toml").write_text(SCENARIO.format(needed="default = 1"))
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    return tmp_path


def asked(**options):
    return Request(trials=3, max_steps=100, scenario="scenario.toml", seed=1, **options)


def test_the_executor_that_is_meant_is_made(folder):
    assert executor_of("pool") is PoolExecutor
    assert executor_of("fresh") is FreshProcessExecutor
    import ours

    assert executor_of("ours:Cluster") is ours.Cluster
    assert executor_of("ours:Cluster:host:10001")("w", parallel=3).asked == ("w", 3, "host:10001")
    assert executor_of("ours:Cluster:")("w", parallel=3).asked == ("w", 3, "")
    assert executor_of("ours:anything:x")("w", parallel=2) == ("w", {"parallel": 2, "argument": "x"})
    for word in ("ours:Alone:x", "pool:x"):
        with pytest.raises(UsageError, match=f"--executor {word}: '{word[:-2]}' takes no argument"):
            executor_of(word)


def test_how_many_run_here_is_known_of_each_executor(folder, monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {0, 1, 2})
    assert [sizes_itself(word) for word in ("ours:Cluster:x", "ours:Alone", "ours:anything", "pool")] == [
        True, False, False, False,
    ]  # fmt: skip
    assert [parallel_here("pool", count) for count in (0, 2, 9)] == [3, 2, 9]
    assert [parallel_here("ours:Cluster", count) for count in (0, 2, 9)] == [3, 2, 3]
    sizes = {}
    for word in ("pool", "ours:Cluster", "ours:Alone"):
        sizes[word] = plan(asked(executor=word, parallel=0))[1].run.parallel
    assert sizes == {"pool": 3, "ours:Cluster": 0, "ours:Alone": 3}
    assert plan(asked(parallel=7))[1].run.parallel == 7


def test_an_option_states_what_it_means_and_whether_it_may_be_excluded():
    options = {option.name: option for option in hunt_options()}
    assert options["snapshot_code"].default is True
    assert options["snapshot_code"].about.meaning.startswith("whether the snapshot contains code")
    assert options["snapshot_limit_mb"].default == 500.0
    assert options["timeout_s"].help.endswith("; default: 60")
    assert options["sampler"].help.endswith("; default: random")
    assert "default" not in options["keep_going"].help
    assert options["seed"].line == "seed: seed of the hunt; by default a new one, which is printed."
    for option in options.values():
        default = option.default
        kinds = {
            "flag": bool, "integer": int, "number": (int, float), "text": (str, Path), "list": (tuple, list),
            "table": dict,
        }  # fmt: skip
        assert default is None or isinstance(default, kinds[option.form]), option.name
        assert option.about.meaning
        assert not option.about.meaning[0].isupper()


def test_arguments_are_those_of_scenario_agent_and_request_in_this_order(folder):
    def specs(request):
        _, settings = plan(request)
        arguments = {name: (spec.spec, spec.kind) for name, spec in settings.agents["ego"].arguments.items()}
        return arguments, {name: (spec.spec, spec.kind) for name, spec in settings.scenario_arguments.items()}

    own, its = specs(asked())
    assert own == {"speed": ("8.0:14.0", "float")}  # "a|b" would be a choice, None is no value, "wide" no float
    assert its == {"gap_m": ("5.0:20.0", "float"), "needed": ("1", "int")}
    own, its = specs(asked(arguments={"speed": "3", "mode": "b"}, scenario_arguments={"gap_m": "7:9"}))
    assert own == {"mode": ("b", "str"), "speed": ("3.0", "float")}
    assert its["gap_m"] == ("7.0:9.0", "float")
    # What a sweep was not asked to vary keeps its default.
    own, its = specs(asked(sampler="sweep", arguments={"speed": "3:5"}))
    assert own == {"speed": ("3.0:5.0", "float")}
    assert its == {"gap_m": ("12.0", "float"), "needed": ("1", "int")}
    own, _ = specs(asked(agents={"ego": "drives:Either"}))
    assert own == {"far": ("30.0", "float|str"), "gap": ("wide", "float|str")}  # "7" would be a number
    own, _ = specs(asked(agents={"ego": "drives:Either"}, arguments={"gap": "5:40", "far": "near|40", "name": "x"}))
    assert own == {
        name: (spec, "float|str") for name, spec in (("gap", "5.0:40.0"), ("far", "near|40.0"), ("name", "x"))
    }
    own, _ = specs(asked(agents={"ego": "drives:Open"}, arguments={"other": "2:3"}))
    assert own["other"][0] == "2:3"


def test_what_an_agent_needs_has_to_be_given(folder):
    with pytest.raises(ArgumentError, match="drives:Needs needs the argument 'weights'") as refused:
        plan(asked(agents={"ego": "drives:Needs"}, arguments={"speed": "3"}))
    assert refused.value.fix == "give --arg weights=SPEC"
    (folder / "policy.py").write_text("def act(observation): return (1.0, 0)\n")
    with pytest.raises(ArgumentError, match="the argument 'observation'; name a class with the methods"):
        plan(asked(agents={"ego": "policy:act"}))
    _, settings = plan(asked(agents={"": "drives:Needs"}, arguments={"weights": "w", "speed": "3"}))
    assert settings.agents["ego"].agent == "drives:Needs"
    (folder / "scenario.toml").write_text(SCENARIO.format(needed='unit = "m"'))
    with pytest.raises((ScenarioError, ArgumentError)):
        plan(asked())


@pytest.mark.parametrize(
    ("options", "says"),
    one_in(
        3,
        [
            (
                {"arguments": {"gap_m": "3"}},
                "gap_m is an argument of the scenario, not of an agent; write --set gap_m=SPEC",
            ),
            ({"arguments": {"spede": "3"}}, "did you mean 'speed'"),
            ({"arguments": {"ego.spede": "3"}}, "--arg ego.spede: drives:Agent"),
            ({"scenario_arguments": {"gap": "3"}}, "the scenario has no argument 'gap'"),
            ({"agents": {"other": "drives:Agent"}}, "other"),
            ({"action": "meta"}, "--action meta is for"),
            ({"branch": True}, "--branch needs disturbances, but the hunt has none"),
            ({"disturb": ["brake@101=ahead:4:2"]}, "--disturb brake@101: a trial has only 100 steps"),
            ({"scenario_arguments": {"gap_m": "signal:0:1"}}, "--set gap_m: the argument cannot vary over time"),
            (
                {"disturb": ["brake@10=ahead:signal:0:6:2"]},
                "the strength of brake cannot vary over time in this scenario",
            ),
            ({"crash_on": ["red-light"]}, "did you mean 'red_light'"),
        ],
    ),
)
def test_what_cannot_be_resolved_is_refused(folder, options, says):
    with pytest.raises((ArgumentError, UsageError, ScenarioError)) as refused:
        plan(asked(**options))
    assert says in str(refused.value)


def test_points_of_signals_of_scenarios_and_disturbances_are_arguments_of_the_scenario():
    words = ["brake@10=ahead:signal:0:6:points=2:3.0", "cut_in=0.1"]
    signals = {"slower_kmh": "signal:0:60:points=3:kind=constant"}
    request = replace(asked(disturb=words, scenario_arguments=signals), scenario="r157-following")
    settings = plan(request)[1]
    found = {name: spec.spec for name, spec in settings.scenario_arguments.items() if "0:" in spec.spec}
    points = {f"slower_kmh[{number}]": "0.0:60.0" for number in range(3)}
    points |= {f"brake@10[{number}]": "0.0:6.0" for number in range(2)}
    assert found.items() >= points.items()
    assert settings.scenario_arguments["slower_kmh"].spec == "signal:constant:3:10.0"
    assert settings.scenario_arguments["brake@10"].spec == "signal:linear:2:3.0"
    assert plan(replace(request, disturb=settings.disturb))[1] == settings
    with pytest.raises(ArgumentError, match=r"--set headway_s.*give a range, or vary one of slower_kmh"):
        plan(replace(request, scenario_arguments={"headway_s": "signal:1:2"}))


def test_parts_are_those_of_the_command_line_then_of_the_named_class_then_of_the_scenario(folder):
    named = AGENT.replace("class Agent:", "class Agent:\n    observation = 'ego, actors'", 1)
    (folder / "drives.py").write_text(named + AGENT.replace("class Agent:", "class Plain:", 1))
    copy_shipped_scenario("loop", folder / "town")
    text = (folder / "town" / "scenario.toml").read_text()

    def parts(observe=(), scenario=(), agent="drives:Agent"):
        words = f"observation = {list(scenario)}" if scenario else ""
        (folder / "town" / "scenario.toml").write_text(text.replace("[agents.ego]", f"[agents.ego]\n{words}"))
        request = Request(
            trials=3, max_steps=9, scenario="town", seed=1, agents={"ego": agent}, observe=observe,
            scenario_arguments={}, arguments={"speed": "3"},
        )  # fmt: skip
        made, settings = plan(request)
        assert made.agents["ego"].observation == settings.agents["ego"].observation
        return settings.agents["ego"].observation

    assert parts() == ("ego", "actors")
    assert parts(scenario=["ego"]) == ("ego", "actors")
    assert parts(scenario=["ego"], agent="drives:Plain") == ("ego",)
    assert parts(observe=["actors:rows=3"], scenario=["ego"]) == ("actors:rows=3",)
    assert parts(observe=["kinematics"]) == ("kinematics",)
    for words, where in (
        ({"observe": ["eg"]}, "--observe"),
        ({"scenario": ["eg"], "agent": "drives:Plain"}, "agents.ego.observation"),
    ):
        with pytest.raises(UsageError) as refused:
            parts(**words)
        assert str(refused.value).startswith(f"{where}: 'eg' is not a part of observations; did you mean 'ego'?")


@pytest.mark.parametrize(
    ("text", "kind"),
    [
        ("None", ""), ("()", ""), ("lambda self: 1", ""), ("classmethod(lambda cls: ['ego'])", ""), ("3", "int"),
        ("property(lambda self: ['ego'])", "property"), ("[1]", "list"), ("{'ego'}", "set"), ("b'ego'", "bytes"),
    ],
)  # fmt: skip
def test_attribute_observation_that_names_no_parts_is_ignored_with_a_note(folder, text, kind):
    (folder / "drives.py").write_text(AGENT.replace("class Agent:", f"class Agent:\n    observation = {text}", 1))
    scenario, settings = plan(asked())
    assert settings.agents["ego"].observation is None
    notes = [note for note in scenario.notes if "attribute" in note]
    ignored = f"the attribute observation of drives:Agent is ignored, because its type is {kind}; set it in the class"
    assert [note.startswith(ignored) for note in notes] == ([True] if kind else [])


def test_field_of_a_dataclass_that_is_made_with_each_object_is_ignored_with_a_note(folder):
    made = "import dataclasses\n@dataclasses.dataclass\nclass Agent:\n"
    made += "    action: str = 'meta'\n    observation: list = dataclasses.field(default_factory=list)\n"
    (folder / "drives.py").write_text(AGENT.replace("class Agent:", made, 1))
    notes = [note for note in plan(asked())[0].notes if "attribute" in note]
    assert [note.partition(";")[0] for note in notes] == [
        "the attribute observation of drives:Agent is ignored, because its type is dataclass field with default_factory"
    ]


def test_a_grid_of_one_point_is_noted():
    fixed = {"vehicles": 10, "trucks_per_100_cars": 0, "imperfection": 0.5, "speed_spread": 0.1}

    def noted(sampler, speed, scenario_arguments=None):
        request = Request(
            scenario="loop", trials=3, max_steps=9, sampler=sampler, arguments={"speed": speed},
            scenario_arguments=scenario_arguments,
        )  # fmt: skip
        return [note for note in plan(request)[0].notes if "varies no argument" in note]

    (note,) = noted("grid", "12")
    assert note.endswith("all trials have the same arguments. Fix: give a range, such as --arg speed=5:30:5")
    assert noted("random", "12", fixed) == noted("grid", "5:30") == []  # the seeds of random trials differ


def test_disturbances_are_those_that_are_asked_for_or_those_of_the_scenario(folder):
    text = SCENARIO.format(needed="default = 1") + "[disturbances]\nbrake = 0.5\n"
    (folder / "scenario.toml").write_text(text)
    assert plan(asked())[1].disturb == ("brake=0.5",)
    assert plan(asked(disturb=["stop=0.1"]))[1].disturb == ("stop=0.1",)
    assert plan(asked(disturb=["brake@100=ahead:4:2"]))[1].disturb == ("brake@100=ahead:4.0:2.0",)
    assert plan(asked(disturb=["none"]))[1].disturb in ((), ("none",))
    assert plan(asked(branch=True))[1].branch
    for old, new, says in (
        ("brake", "braek", "[disturbances]: there is no disturbance 'braek'; did you mean 'brake'"),
        ("0.5", "-1", "[disturbances] brake=-1.0: '-1.0' is not a rate"),
    ):
        (folder / "scenario.toml").write_text(text.replace(old, new))
        with pytest.raises((UsageError, ScenarioError)) as refused:
            plan(asked())
        assert says in str(refused.value)
        assert "scenario.toml" in str(refused.value)
        assert "--disturb" not in str(refused.value)


def test_a_survey_sees_what_was_asked_and_its_scenario_is_planned(folder):
    seen = []

    def survey(scenario, request, settings):
        seen.append((scenario.name, request.max_steps, settings.trials))
        return replace(scenario, notes=(*scenario.notes, "surveyed"))

    scenario, _ = plan(asked(), survey=survey)
    assert seen[0][1:] == (100, 3)
    assert "surveyed" in scenario.notes
    assert plan(asked(), survey=lambda scenario, *_: scenario)[1] == plan(asked())[1]


def test_compiled_core_is_switched_off_as_the_settings_say_where_there_is_one(folder):
    for name, core in (("scenario.toml", False), ("r157-following", True)):
        for native in (True, False):
            scenario, settings = plan(replace(asked(native=native), scenario=name))
            used = with_settings(scenario, settings)
            assert (scenario.backend.core is not None) is core
            assert not core or (used.table(SumoSetup).native is not False) is native


def test_range_of_the_scenario_comes_before_that_of_the_agents_own_code():
    own, its = (Argument("speed", "float", distribution=parse_spec(text)) for text in ("1.0:2.0", "8.0:14.0"))
    for known, declared, spec in ((its, own, "8.0:14.0"), (None, own, "1.0:2.0"), (its, None, "8.0:14.0")):
        assert _spec("speed", declared, known, None, hunted=True).spec == spec
        assert _spec("speed", declared, known, None, hunted=False) is None


@pytest.mark.parametrize(
    ("agents", "options", "says"),
    [
        (("a:B", "exec:./p"), {"step_timeout_s": 0.5}, ["--step-timeout does not limit ego"]),
        (("exec:./p", "exec:./p"), {"step_timeout_s": 0.5}, []),
        (("a:B", "exec:./p"), {"probe": 1.0}, ["each fork of --probe starts the program of other again"]),
        (("a:B", "a:B"), {"probe": 1.0, "branch": True}, []),
        (("a:B", "exec:./p"), {"reuse": True, "audit": 0.05}, ["the program of other drives in one trial after"]),
        (("a:B", "a:B"), {"reuse": True}, ["--reuse has no effect"]),
    ],
    ids=str,
)
def test_notes_state_what_programs_cost_and_which_agents_no_step_timeout_limits(folder, agents, options, says):
    settings = plan(asked())[1]
    own = {name: options[name] for name in options.keys() & {"probe", "branch"}}
    run = {name: value for name, value in options.items() if name not in own}
    chosen = {
        name: replace(settings.agents["ego"], agent=agent) for name, agent in zip(("ego", "other"), agents, strict=True)
    }
    settings = replace(settings, agents=chosen, run=replace(settings.run, **run), **own)
    notes = list(notes_on_programs(settings))
    assert [note.startswith(start) for note, start in zip(notes, says, strict=True)] == [True] * len(says)


def test_unused_statistics_next_to_a_policy_are_a_note(folder, tmp_path):
    for name in ("model.zip", "norm.pkl", "other.txt"):
        (tmp_path / name).touch()
    asked_for = {"path": str(tmp_path / "model.zip")}
    (tmp_path / "drives_by_model.py").write_text(
        "class Agent:\n    def __init__(self, path, normalize=None): ...\n    def reset(self, seed): ...\n"
    )
    given = {"agents": {"ego": "drives_by_model:Agent"}}
    scenario, _ = plan(asked(arguments=asked_for, **given))
    (note,) = [note for note in scenario.notes if "norm.pkl" in note]
    assert note.startswith("norm.pkl is next to the policy and is not used")
    assert note.endswith(f"normalize={tmp_path / 'norm.pkl'}")
    scenario, _ = plan(asked(arguments={**asked_for, "normalize": "none"}, **given))
    assert not any("norm.pkl" in note for note in scenario.notes)


@pytest.mark.parametrize(
    ("numbers", "says"),
    [
        ({"trials": -1}, "TRIALS is -1; give at least 0"),
        ({"trials": True}, "TRIALS is True; give a whole number"),
        ({"max_steps": 0}, "MAX_STEPS is 0; give at least 1"),
        ({"max_steps": 2.5}, "MAX_STEPS is 2.5; give a whole number"),
        ({"parallel": -1}, "PARALLEL is -1; give at least 0 (0: one per core)"),
        ({"trials": 0}, "TRIALS is 0; give at least 1, or 0 (no limit) with --for or --until-rate"),
    ],
)
def test_numbers_that_cannot_be_meant_are_refused(numbers, says):
    with pytest.raises(UsageError) as refused:
        Request(**{"trials": 1, "max_steps": 1, **numbers}).checked()
    assert str(refused.value) == says


def test_no_trials_are_fine_with_a_time_and_drivers_have_to_be_importable(folder):
    options = {option.name for option in hunt_options()}
    name = "duration" if "duration" in options else "for"
    assert Request(**{name: "5s"}, trials=0, max_steps=1).checked().trials == 0
    assert Request(until_rate="1/hour", trials=0, max_steps=1).checked().keep_going
    for other in ({"distinct": 2}, {"only_at_fault": True}):
        with pytest.raises(
            UsageError, match=f"--until-rate and --{next(iter(other)).replace('_', '-')} contradict each other"
        ):
            Request(until_rate="1/hour", trials=0, max_steps=1, **other).checked()
    sys.modules.pop("drives", None)
    import drives

    assert Request(agent=drives.Agent, trials=1, max_steps=1).agents == {"": "drives:Agent"}
    both = Request(agent="a:B", agents={"x": "c:D", "y": None}, trials=1, max_steps=1)
    assert both.agents == {"x": "c:D", "": "a:B"}
    assert Request(agent="", trials=1, max_steps=1).agents == {}

    class Local: ...

    elsewhere = type("Here", (), {"__module__": "__main__"})
    for who in (Local, elsewhere, lambda: None):
        with pytest.raises(UsageError, match="is not in a module that workers can import"):
            Request(agent=who, trials=1, max_steps=1)
    with pytest.raises(UsageError, match=r"the agent is an object of class Agent, .*; give the class Agent itself"):
        Request(agent=drives.Agent(), trials=1, max_steps=1)


def test_an_argument_that_is_nobodys_is_named_with_those_that_exist():
    owners = Owners(
        {"a": Takes(("speed", "gap")), "a.b": Takes(("speed",)), "c": Takes((), open=True)}, ("gap", "rain")
    )
    assert Owners({"a": Takes(("speed",))}).of("mood", option="--arg") is None
    assert (agent_of("a.b.speed", owners.agents), agent_of("a.x", owners.agents), agent_of("x", owners.agents)) == (
        "a.b", "a", "",
    )  # fmt: skip
    unknown = owners.unknown("speeed", option="--set", whose="the crash")
    assert "the crash has no argument 'speeed'" in str(unknown)
    assert "speed" in unknown.fix


def test_of_a_record_the_code_is_asked_only_where_it_does_not_know():
    owners = Owners({"a": Takes(("speed",)), "b": Takes(())}, ("rain",))
    calls = []

    def ask(agent):
        calls.append(agent)
        return Takes(("weights",) if agent == "b" else ())

    assert owners.of_record("speed", ask) == ("a", "speed")
    assert owners.of_record("scenario.x", ask) is None
    assert owners.of_record("weights", None) is None
    assert calls == []
    assert owners.of_record("weights", ask) == ("b", "weights")
    assert calls == ["a", "b"]
    assert owners.of_record("b.weights", ask) == ("b", "weights")
    assert calls == ["a", "b", "b"]
    assert owners.of_record("a.weights", ask) is None
    assert owners.of_record("a.weights", lambda _: Takes((), open=True)) == ("a", "weights")


@pytest.mark.parametrize(("default", "text"), [(5, "5:25"), (26, None), (None, "5:25"), (26, "5:25")])
def test_default_of_a_program_lies_within_its_range(default, text):
    argument = Argument("v", default=default, distribution=text and parse_spec(text))
    refusal = pytest.raises(PluginError, match=r"the default of its argument v, 26, is outside its range '5:25'")
    with refusal if (default, text) == (26, "5:25") else nullcontext():
        _check_defaults("exec:./p", CallSignature({"v": argument}, open=False, given=()))


def test_code_states_what_an_agent_takes(folder):
    assert takes_of("drives:Agent") == Takes(
        ("speed", "mode", "needed", "gap"), defaults={"speed": 7.0, "mode": "a|b", "gap": "wide"}
    )
    assert takes_of("drives:Open") == Takes(("speed",), open=True, defaults={"speed": 7.0})
    assert takes_of("drives:Nothing") == Takes(open=True)  # whoever runs it says why
    other = folder / "other"
    other.mkdir()
    (other / "drives.py").write_text("class Agent:\n    def __init__(self, other: int = 1): ...\n")
    assert takes_of("drives:Agent", [str(other)]) == Takes(("other",), defaults={"other": 1})
    assert takes_of("drives:Agent", folder=other) == Takes(("other",), defaults={"other": 1})
    assert "speed" in takes_of("keep-lane").names


def test_a_command_is_one_line_of_the_settings(folder):
    _, settings = plan(asked())
    path = folder / "hunt.toml"
    write_settings(path, settings, ["crashhunt", "run", "a b", "x\\y", "one\ntwo\rthree"])
    lines = path.read_bytes().split(b"\n")
    assert lines[0] == rb"# crashhunt run 'a b' 'x\y' $'one\x0atwo\x0dthree'"
    assert lines[1].startswith(b"scenario = ")
    assert read_settings(path) == settings


def test_settings_that_cannot_be_read_say_where_and_why(folder):
    with pytest.raises(HuntDirectoryError, match=r"it has no hunt\.toml; give the directory of a hunt"):
        read_settings(folder / "hunt.toml")
    with pytest.raises(HuntDirectoryError, match=r"'.*nowhere' does not exist"):
        read_settings(folder / "nowhere" / "hunt.toml")
    (folder / "hunt.toml").write_text("a = ")
    with pytest.raises(HuntDirectoryError, match=r"hunt\.toml: not valid TOML"):
        read_settings(folder / "hunt.toml")
    (folder / "hunt.toml").unlink()
    (folder / "hunt.toml").mkdir()
    with pytest.raises(HuntDirectoryError, match="cannot be read"):
        read_settings(folder / "hunt.toml")


def test_keys_of_a_later_version_are_kept_and_slips_are_refused(folder):
    _, settings = plan(asked())
    path = folder / "hunt.toml"
    write_settings(path, settings, ["x"])
    text = path.read_text().replace("schema = 1\n", 'schema = 1\nmood = "calm"\n')
    path.write_text(text)
    assert read_settings(path) == settings
    write_settings(path, replace(settings, trials=9), ["y"])
    assert 'mood = "calm"' in path.read_text()
    write_settings(folder / "copy.toml", settings, ["z"], like=path)
    assert 'mood = "calm"' in (folder / "copy.toml").read_text()
    path.write_text(text.replace("max_steps = ", "max_step = "))
    with pytest.raises(HuntDirectoryError, match="max_step"):
        read_settings(path)


def test_foreign_disturbances_of_a_hunt_are_drawn_elsewhere(folder):
    (folder / "errs.py").write_text("from crashhunt.disturbances import brake as Brake, stop as Stop\n")
    scenario, settings = plan(replace(asked(disturb=["errs:Brake=0.5", "stop=0.5"]), scenario="loop"))
    found = disturber_apart(scenario, settings)
    assert isinstance(found.models["errs:Brake"], ModelApart)
    assert not isinstance(found.models["stop"], ModelApart)
    assert "errs" not in sys.modules
    found.close()


def test_argument_that_only_one_of_two_hunts_has_is_one_difference():
    _, settings = plan(Request(trials=1, max_steps=10, seed=1))
    name = next(iter(settings.scenario_arguments))
    fewer = {key: value for key, value in settings.scenario_arguments.items() if key != name}
    other = replace(settings, scenario_arguments=fewer, seed=2)
    value = settings.scenario_arguments[name].spec
    assert settings.differences(other) == [
        "seed was 1 and is now 2", f"scenario_arguments.{name} was {value} and is now (not there)",
    ]  # fmt: skip
    assert other.differences(settings)[1] == f"scenario_arguments.{name} was (not there) and is now {value}"


def test_difference_of_forms_of_actions_names_what_resumes_the_hunt():
    """A hunt from before the setting ``visible``, or with ``visible=front``, has recorded the form without it."""
    _, settings = plan(Request(trials=1, max_steps=10, seed=1))

    def acting(form):
        return replace(settings, agents={"ego": replace(settings.agents["ego"], action=form)})

    before, now = acting("trajectory"), acting("trajectory:visible=whole")
    says = "agents.ego.action was trajectory:visible=front and is now trajectory:visible=whole"
    assert before.differences(now) == [says]
    assert before.differences(before) == []
    assert before.differences(acting("of_a_later_version"))[0].endswith("is now of_a_later_version")
