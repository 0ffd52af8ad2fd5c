"""Whose crashhunt a replay runs, which trial it is in another scenario, and what of it is compared."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest

from crashhunt.base import layout
from crashhunt.errors import UntrustedError, UsageError
from crashhunt.plans import AgentSettings, HuntSettings, RunSettings
from crashhunt.replays import Look, ReplayOptions, ReplayReport, _debugger, _prepare, _replaying as _replay, prepare
from crashhunt.replays._edits import Edits
from crashhunt.replays._prepare import _in_scenario, is_current_code
from crashhunt.scenario import argument_values, load_scenario
from crashhunt.trial import Disturbance, Outcome, TrialResult, TrialSpec


def rerun(sizes, code=("code",)):
    files = {name: {"size": size} for name, size in sizes.items()}
    return SimpleNamespace(worker=SimpleNamespace(code=code), snapshot=SimpleNamespace(manifest={"files": files}))


def test_code_is_current_where_every_file_of_the_executors_has_its_size():
    name = f"code/{layout.PACKAGE.name}/executors/"
    sizes = {path.name: path.stat().st_size for path in (layout.PACKAGE / "executors").glob("*.py")}
    same = {f"{name}{file}": size for file, size in sizes.items()}
    assert is_current_code(rerun(same))
    assert is_current_code(rerun({**same, "code/planner.py": 7, "scenario/scenario.toml": 9}))
    assert not is_current_code(rerun({**same, f"{name}_pool.py": sizes["_pool.py"] + 1}))
    assert not is_current_code(rerun({**same, f"{name}_of_an_older_version.py": 9}))
    assert not is_current_code(rerun({"code/planner.py": 7}))
    assert is_current_code(rerun({"code/planner.py": 7}, code=()))  # the hunt kept no code


def test_a_trial_elsewhere_has_its_agents_and_those_arguments_that_are_there_too():
    recorded = TrialSpec(
        4, 77, {"car": {"speed": 8.0}}, {"density": 0.4, "gone": 5}, 300, only=("x",),
        disturbances=(Disturbance(21, "ahead", "brake", 4.0, 2.0, "car"),),
    )  # fmt: skip
    settings = HuntSettings(
        scenario="mine", scenario_digest="0", trials=3, max_steps=300, seed=1, run=RunSettings(),
        agents={"car": AgentSettings(agent="keep-lane")},
    )  # fmt: skip
    other = load_scenario("loop")
    name = next(iter(other.arguments))
    recorded = replace(recorded, scenario_arguments={name: 9.0, "gone": 5})
    scenario, trial = _in_scenario("loop", settings, recorded, step_length_s=0.05)
    (agent,) = scenario.agents
    assert scenario.agents[agent].agent == "keep-lane"
    assert trial.arguments == {agent: {"speed": 8.0}}
    assert trial.seed == 77
    assert trial.scenario_arguments == argument_values(scenario) | {name: 9.0}
    assert trial.max_steps == 150  # as long, in longer steps
    (braking,) = trial.disturbances
    assert (braking.step, braking.agent, braking.what) == (10, agent, "brake")
    assert trial.only is None
    with pytest.raises(UsageError, match="has 1 controlled vehicles, and the crash has 0"):
        _in_scenario("loop", replace(settings, agents={}), recorded, step_length_s=0.05)


def test_steps_that_were_looked_into_are_compared_up_to_where_the_user_stopped(monkeypatch):
    compared = []

    def judged(rerun, recorded, replayed, result, *, whole):
        compared.append((recorded.name, recorded.steps, replayed.name, replayed.steps, whole))
        return ReplayReport(rerun=rerun, verdict="reproduced", replayed=result, recording=replayed)

    was = SimpleNamespace(steps=30, name="was")
    result = TrialResult(TrialSpec(4, 1, {}, {}, 90), Outcome.COLLISION, steps=30)
    monkeypatch.setattr(_debugger, "debug", lambda rerun, look: (result, SimpleNamespace(name="now", steps=31)))
    monkeypatch.setattr(_replay, "judged", judged)
    monkeypatch.setattr(_replay, "up_to", lambda recording, step: SimpleNamespace(name=recording.name, steps=step))
    looked = SimpleNamespace(recorded=was)
    assert _replay._look_into(looked, Look(until=12)).verdicts == {"reproduced": 1}
    _replay._look_into(looked, Look(until=31))
    assert compared == [("was", 12, "now", 12, False), ("was", 30, "now", 31, True)]


@pytest.fixture
def prepared(monkeypatch, tmp_path):
    """Prepares a replay; everything that it asks for is made up, and `asked` has what it was asked with."""
    scenario = load_scenario("loop")
    (agent,) = scenario.agents
    spec = TrialSpec(4, 7, {agent: {"speed": 8.0}}, argument_values(scenario), 90)
    settings = HuntSettings(
        scenario="loop", scenario_digest="0", trials=3, max_steps=90, seed=1, run=RunSettings(timeout_s=9.0),
        agents={agent: AgentSettings(agent="keep-lane")}, crash_on=(Outcome.COLLISION,),
    )  # fmt: skip
    given = SimpleNamespace(
        has_code=True, faults=["a.py differs"], additions=["new.py"], environment={"cpu": "there"}, trusted=True,
        edits=Edits(), order="", landlock=3, acted=[20, 30], per_processor=False, spec=spec, asked=[],
    )  # fmt: skip
    snapshot = SimpleNamespace(
        faults=lambda: given.faults, verify=lambda: given.asked.append("verified"), additions=lambda: given.additions,
        scenario=scenario, environment=given.environment, settings="original",
        code=("snapshot/code",), argument_files={"w": "w.npz"},
    )  # fmt: skip
    recorded = SimpleNamespace(
        agents=["a", "b"][: len(given.acted)], prologue=SimpleNamespace(step_length_s=0.1),
        actions=lambda name: [0] * given.acted["ab".index(name)],
    )  # fmt: skip
    bundle = SimpleNamespace(
        recording=lambda: recorded, hunt=tmp_path, snapshot="0f", path=tmp_path / "crash",
        result=SimpleNamespace(spec=spec),
    )  # fmt: skip

    def trusted(asked, *, faults):
        given.asked.append(("trusted", faults))
        return given.trusted

    def edited(recorded_spec, current, original, changes, *, code):
        given.asked.append(("edited", original, changes, code))
        return given.spec, given.edits

    def opened(path):
        assert path == tmp_path / layout.SNAPSHOTS / "0f"
        snapshot.has_code = given.has_code
        return snapshot

    def with_order(scenario, order):
        given.asked.append(("order", order))
        return scenario

    for name, value in {
        "Snapshot": opened, "is_bundle_trusted": trusted, "edited_spec": edited,
        "read_settings": lambda path: settings, "refuse_untrusted": lambda given: UntrustedError("not yours", fix="x"),
        "with_recorded_load_order": with_order,
        "load_order_change": lambda scenario, order: given.order,
        "environment_changes": lambda environment: {"numpy": ("1", "2")}, "processor": lambda: "here",
        "vector_extension": lambda: "X86_V3",
        "refuse_side_effects": lambda *words: given.asked.append(("side effects", words[1:])),
        "landlock_version": lambda: given.landlock,
    }.items():  # fmt: skip
        monkeypatch.setattr(_prepare, name, value)
    given.settings, given.agent, given.bundle = settings, agent, bundle

    def run(**options):
        given.asked.clear()
        return prepare(bundle, ReplayOptions(**options))

    given.run = run
    return given


def test_replay_runs_the_code_of_the_snapshot(prepared):
    found = prepared.run(changes={"speed": "9"}, accelerate=False)
    assert prepared.asked == [
        "verified", ("trusted", []), ("order", None), ("edited", "original", {"speed": "9"}, ("snapshot/code",)),
    ]  # fmt: skip
    assert found.warnings == ("new.py was not in the snapshot, and may make a difference", "numpy was 1 and is 2")
    worker = found.worker
    assert (worker.code, dict(worker.argument_files), worker.sealed) == (("snapshot/code",), {"w": "w.npz"}, None)
    assert (worker.timeout_s, worker.keep_trials, worker.crash_on) == (9.0, True, (Outcome.COLLISION,))
    assert (found.code, found.spec, found.elsewhere, found.edits) == ("snapshot", prepared.spec, False, ())
    prepared.environment["load_order"] = "fixed"
    prepared.order = "another order"
    again = prepared.run()
    assert ("order", "fixed") in prepared.asked
    assert again.warnings[-1] == "another order"


def test_replay_by_other_code_imports_what_is_there_now(prepared):
    found = prepared.run(code="current")
    assert prepared.asked[-1] == ("edited", "original", {}, ())
    assert ("order", None) in prepared.asked
    assert (found.worker.code, dict(found.worker.argument_files), found.code) == ((), {}, "current")
    prepared.has_code = False
    found = prepared.run()
    assert found.code == "current"
    assert "--no-snapshot" in found.warnings[0]
    assert len(prepared.run(code="current").warnings) == 2
    assert prepared.run(code="log").code == "log"


def test_damaged_snapshot_is_replayed_by_force_only(prepared):
    found = prepared.run(force=True)
    assert found.warnings[0] == "the snapshot is damaged: a.py differs"
    assert prepared.asked[:1] == [("trusted", ["a.py differs"])]


def test_recorded_actions_run_no_code_that_is_not_trusted(prepared):
    prepared.trusted = False
    with pytest.raises(UntrustedError):
        prepared.run()
    with pytest.raises(UntrustedError):
        prepared.run(trusted=False)
    assert ("trusted", []) not in prepared.asked
    found = prepared.run(code="log")
    log = {"log": str((prepared.bundle.path / layout.LOG).resolve()), "agent": prepared.agent}
    assert found.spec.arguments == {prepared.agent: log}
    assert found.spec.max_steps == 30  # as long as an agent acted
    assert found.worker.scenario.agents[prepared.agent].agent == "crashhunt.agents:Recorded"
    assert found.worker.sealed == (str(prepared.bundle.path.resolve()),)
    assert ("edited", "original", {}, None) in prepared.asked
    assert ("side effects", (prepared.settings, prepared.spec.scenario_arguments)) in prepared.asked
    assert not any("Landlock" in warning for warning in found.warnings)
    prepared.landlock = 0
    assert "Landlock" in prepared.run(code="log").warnings[-1]
    prepared.acted[:] = [0, 0]
    assert prepared.run(code="log").spec.max_steps == 1
    prepared.acted[:] = [95, 3]
    assert prepared.run(code="log").spec.max_steps == 90
    prepared.trusted = True
    found = prepared.run(code="log")
    assert found.worker.sealed is None
    assert prepared.asked[-1][0] == "edited"
    prepared.edits = Edits(agents=("speed was 8",))
    with pytest.raises(UsageError, match="speed was 8") as caught:
        prepared.run(code="log")
    assert "--code snapshot" in caught.value.fix


def test_edits_and_another_scenario_may_explain_that_no_crash_occurs(prepared):
    prepared.edits = Edits(agents=("speed was 8",), others=("the seed was 1",), ignored=("a rate",))
    found = prepared.run()
    assert (found.edits, found.other_traffic) == (("speed was 8", "the seed was 1"), ("the seed was 1",))
    assert "a rate" in found.warnings
    found = prepared.run(scenario="loop")
    assert found.elsewhere
    assert found.other_traffic[1].endswith("the scenario was loop and is loop")
    prepared.edits = Edits()
    with pytest.raises(UsageError, match="'loop'"):
        prepared.run(scenario="loop", code="log")
    prepared.spec = replace(prepared.spec, disturbances=(Disturbance(5, "ahead", "fly", 1.0, 1.0, prepared.agent),))
    with pytest.raises(UsageError, match="'fly'") as caught:
        prepared.run()
    assert "brake" in caught.value.fix


def test_replay_on_another_processor_is_warned_of(prepared, monkeypatch):
    scenario = load_scenario("merge-highway-env")
    monkeypatch.setattr(_prepare, "with_settings", lambda *given: scenario)
    assert "'there' and is 'here'" in prepared.run().warnings[-1]
    prepared.environment["cpu"] = "here"
    assert len(prepared.run().warnings) == 2
    prepared.environment["simd"] = "X86_V3"
    assert len(prepared.run().warnings) == 2
    prepared.environment["simd"] = "AVX512_ICL"
    assert "extension AVX512_ICL and has X86_V3" in prepared.run().warnings[-1]
    defaults = prepared.run().defaults
    known = scenario.scenario_arguments()
    assert {name: defaults["", name] for name in known} == {name: one.default for name, one in known.items()}
    for agent in scenario.agents:
        for name, one in scenario.agent_arguments(agent).items():
            assert defaults[agent, name] == one.default
