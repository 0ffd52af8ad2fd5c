"""Whose crashhunt a replay runs, which trial it is in another scenario, and what of it is compared."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest

from crashhunt.base import layout
from crashhunt.errors import UsageError
from crashhunt.plans import AgentSettings, HuntSettings, RunSettings
from crashhunt.replays import Look, ReplayReport, _debugger, _replay
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
