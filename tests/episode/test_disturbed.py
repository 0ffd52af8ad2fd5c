"""Episodes with disturbances, on the toy: what takes place, when, and what is recorded of it."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from episodes import record_run

from crashhunt.oracles import Overlap, ReportedCollision
from crashhunt.scenario import AgentSetup, Scenario
from crashhunt.simulators import PARTS, layouts_of
from crashhunt.simulators.toy import ToySimulator
from crashhunt.trial import Disturbance, Outcome, TrialResult, TrialSpec

ONE = Scenario(simulator="toy", agents={"ego": AgentSetup()})
TWO = Scenario(simulator="toy", agents={"ego": AgentSetup(), "second": AgentSetup()})
META = Scenario(simulator="toy", agents={"ego": AgentSetup(action="meta")})


class Counts:
    """Drives a little faster in every step, or does what it is told to."""

    def __init__(self, actions=None):
        self.actions = actions
        self.fail_at = 0

    def reset(self, seed):
        self.step = 0

    def act(self, observation):
        self.step += 1
        if self.step == self.fail_at:
            raise ValueError("enough")
        return self.actions(self.step) if self.actions else (5.0 + 0.01 * self.step, 0)


@pytest.fixture
def run(tmp_path):
    """Runs an episode; returns its result and its recording."""
    paths = (tmp_path / f"box{number}" for number in itertools.count())

    def run_it(*disturbances, scenario=ONE, steps=40, agent=None, **arguments):
        spec = TrialSpec(0, 1, {}, {"leader_speed": 10.0, **arguments}, steps, disturbances=disturbances)
        simulator, oracles = ToySimulator(scenario, tmp_path), [ReportedCollision(), Overlap()]
        return record_run(next(paths), spec, simulator, agent or Counts(), oracles=oracles)

    return run_it


def planned(step, what="brake", who="ahead", strong=4.0, long=1.0, agent="ego"):
    return Disturbance(step, who, what, strong, long, agent)


def speeds(recording, name="leader"):
    return [scene.speeds[scene.roster.index[name]] for scene in recording.scenes()]


def test_the_leader_brakes_for_so_long_and_drives_on_by_itself(run):
    result, recording = run(planned(11))
    plain, without = run()
    assert speeds(recording)[:11] == speeds(without)[:11]
    braking = np.diff(speeds(recording))[10:20] / 0.1
    assert np.allclose(braking, -4.0)
    assert speeds(recording)[-1] == speeds(without)[-1] == 10.0  # again by itself
    assert result.disturbances == (replace(planned(11), vehicle="leader"),)
    assert result.disturbances[0].words == "leader brakes with 4 m/s² for 1 s"
    assert result.disturbed
    assert not plain.disturbed
    assert plain.disturbances == ()
    assert recording.disturbances == result.disturbances


def test_what_never_begins_changes_no_digest(run):
    plain, _ = run(steps=10)
    late, _ = run(planned(11), steps=10)
    assert late.digest == plain.digest
    assert late.disturbances == ()


def test_no_one_there_and_agents_are_never_meant(run):
    result, recording = run(planned(3, who="behind"), planned(5, agent="ego"), scenario=TWO)
    assert result.disturbances == ()  # ahead of ego is the second agent
    assert [one.vehicle for one in recording.disturbances] == ["", ""]
    result, _ = run(planned(5, agent="second"), scenario=TWO)
    assert [one.vehicle for one in result.disturbances] == ["leader"]


def test_a_vehicle_deviates_once_at_a_time_and_right_after_again(run):
    result, _ = run(planned(5, long=1.0), planned(10, long=1.0), planned(15, long=0.5))
    assert [(one.step, one.vehicle) for one in result.disturbances] == [(5, "leader"), (15, "leader")]


@pytest.mark.parametrize("what", ["late_observation", "late_action", "noisy_observation"])
def test_so_do_the_eyes_and_hands_of_an_agent(run, what):
    some = [planned(step, what, "itself", 0.3, long) for step, long in ((5, 1.0), (10, 1.0), (15, 0.5))]
    result, _ = run(*some)
    assert [(one.step, one.vehicle) for one in result.disturbances] == [(5, "ego"), (15, "ego")]


def test_a_late_observation_is_recorded_as_it_is_shown(run):
    _, without = run(steps=30)
    late = planned(11, "late_observation", "itself", 0.3, 1.0)
    result, recording = run(late, steps=30)
    shown, true = recording.observations("ego"), without.observations("ego")
    assert (shown[:10] == true[:10]).all()
    assert (shown[10:13] == true[10]).all()  # nothing has come yet but the first
    assert (shown[13:20] == true[10:17]).all()
    assert (shown[20:] == true[20:]).all()
    assert result.disturbances == (replace(late, vehicle="ego"),)
    assert result.disturbances[0].words == "ego sees everything 0.3 s late for 1 s"


def test_a_late_observation_from_the_first_step_on(run):
    result, recording = run(planned(1, "late_observation", "itself", 0.2, 0.5), steps=8)
    _, without = run(steps=8)
    shown, true = recording.observations("ego"), without.observations("ego")
    assert (shown[:3] == true[0]).all()
    assert (shown[4] == true[2]).all()
    assert (shown[5:] == true[5:]).all()
    assert [one.step for one in result.disturbances] == [1]


def test_noise_is_within_its_share_and_leaves_directions_alone(run):
    _, without = run(steps=30)
    noisy = planned(11, "noisy_observation", "itself", 0.1, 1.0)
    (_, recording), (_, again) = run(noisy, steps=30), run(noisy, steps=30)
    shown, true = recording.observations("ego"), without.observations("ego")
    assert (shown == again.observations("ego")).all()
    assert shown.dtype == true.dtype
    assert (shown[:10] == true[:10]).all()
    assert (shown[20:] == true[20:]).all()
    assert (shown[10:20, :2, 1] != true[10:20, :2, 1]).all()  # x of itself and of the leader
    assert (abs(shown - true) <= 0.1001 * abs(true)).all()
    assert (shown[:, :, [0, 5, 6]] == true[:, :, [0, 5, 6]]).all()


@pytest.mark.parametrize("begin", [1, 11])
def test_history_stacks_the_observations_as_they_were_received(run, begin):
    parts = ("ego", "actors:rows=3", "lidar2d:rays=12")
    plain = Scenario(simulator="toy", agents={"ego": AgentSetup(observation=parts)})
    stacking = Scenario(simulator="toy", agents={"ego": AgentSetup(observation=(*parts, "history:steps=4"))})
    layout = layouts_of(stacking.agents, PARTS)["ego"]
    noise = (
        planned(begin, "noisy_observation", "itself", 0.2, 0.8),
        planned(20, "noisy_observation", "itself", 0.2, 0.5),
    )
    _, recording = run(*noise, scenario=stacking, steps=30)
    stacks = [layout.restore(array) for array in recording.observations("ego")]
    true = layouts_of(plain.agents, PARTS)["ego"]
    shown = [true.restore(array) for array in run(scenario=plain, steps=30)[1].observations("ego")]
    noisy = {*range(begin - 1, begin + 7), *range(19, 24)}
    for step, stack in enumerate(stacks):
        for name, array in stack.items():
            assert (array[-1].tobytes() == shown[step][name].tobytes()) == (step not in noisy), (step, name)
            for back in range(1, 4):
                assert array[-1 - back].tobytes() == stacks[max(0, step - back)][name][-1].tobytes(), (step, name, back)


def test_a_late_action_is_recorded_when_it_is_decided_and_done_later(run):
    agent = Counts(lambda step: (5.0 if step <= 10 else 8.0, 0))
    _, without = run(agent=agent, steps=30)
    _, recording = run(planned(11, "late_action", "itself", 0.5, 2.0), agent=agent, steps=30)
    assert (recording.actions("ego") == without.actions("ego")).all()
    there, here = speeds(recording, "ego"), speeds(without, "ego")
    assert there[:16] == [*here[:11], *here[10:11] * 5]  # it goes on as it did, for half a second
    assert there[16] == pytest.approx(here[11])


def test_what_is_late_is_so_in_whole_steps_and_reported_so(run):
    given = {"steps": 8, "agent": Counts(lambda step: (10.0 + 0.1 * step, 0))}
    _, without = run(**given)
    for what, shown in (("late_action", lambda made: speeds(made, "ego")), ("late_observation", observed)):
        result, recording = run(planned(3, what, "itself", 0.26, 0.33), **given)
        exact, same = run(planned(3, what, "itself", 0.3, 0.3), **given)
        assert shown(recording) == shown(same) != shown(without)
        assert [(one.how_strong, one.how_long) for one in result.disturbances] == [(0.3, 0.3)]
        assert exact.digest == result.digest
        result, recording = run(planned(3, what, "itself", 0.0, 0.3), **given)  # not late at all
        assert shown(recording) == shown(without)
        assert result.disturbances[0].how_strong == 0.0


def observed(recording):
    return recording.observations("ego").tolist()


def test_while_no_action_comes_no_lane_is_changed_and_nothing_is_pressed_again(run):
    seen = []

    class Watched(ToySimulator):
        def step(self, actions):
            seen.append(actions["ego"].tolist())
            return super().step(actions)

    late = planned(3, "late_action", "itself", 0.3, 0.8)
    for scenario, act, expected in (
        (ONE, lambda step: (5.0, 1 if step == 2 else 0), [[5, 0], [5, 1], [5, 0], [5, 0], [5, 0], [5, 0]]),
        (META, lambda step: 3 if step <= 2 else 4, [[3], [3], [1], [1], [1], [4]]),
    ):
        seen.clear()
        spec = TrialSpec(0, 1, {}, {}, 6, disturbances=(late,))
        from crashhunt.episode import Episode

        with Episode(spec, simulator=Watched(scenario, None), make_agent=lambda *_, act=act: Counts(act)) as episode:
            episode.start()
            while episode.result is None:
                episode.step()
        assert seen == expected


def test_a_vehicle_that_is_not_seen_is_there_all_the_same(run):
    _, without = run(steps=30)
    unseen = planned(11, "unseen", "ahead", 1.0, 1.0)
    result, recording = run(unseen, steps=30)
    shown, true = recording.observations("ego"), without.observations("ego")
    hidden = true.copy()
    hidden[11:21, 1:] = 0.0  # what it sees after the steps in which it does not
    assert (shown == hidden).all()
    assert speeds(recording) == speeds(without)
    assert result.disturbances[0].words == "ego does not see leader for 1 s"
    assert (run(steps=30)[1].observations("ego") == true).all()


def test_what_fails_in_the_step_that_is_disturbed_is_disturbed(run):
    agent = Counts()
    agent.fail_at = 6
    early, late = planned(6, "late_observation", "itself", 0.2, 0.5), planned(7, "late_observation", "itself", 0.2, 0.5)
    result, _ = run(early, agent=agent)
    assert (result.outcome, result.steps, result.disturbed) == (Outcome.AGENT_ERROR, 5, True)
    result, _ = run(late, agent=agent)
    assert not result.disturbed


def test_a_kind_that_the_simulator_cannot_do_makes_the_trial_invalid(run):
    result, _ = run(planned(1, "fly"))
    assert result.outcome is Outcome.INVALID
    assert "does not support the disturbance 'fly'" in result.failure.message


def test_a_trial_and_its_result_survive_json():
    spec = TrialSpec(3, 1, {}, {}, 9, disturbances=(planned(2), planned(4, "stop")))
    assert TrialSpec.from_json(spec.to_json()) == spec
    assert spec.to_json()["requires"] == ["disturbances"]
    happened = replace(planned(2), vehicle="leader")
    result = TrialResult(spec, Outcome.SURVIVED, steps=9, disturbances=(happened,), log_likelihood=-3.5)
    assert TrialResult.from_json(result.to_json()) == result
    plain = TrialResult(TrialSpec(3, 1, {}, {}, 9), Outcome.SURVIVED).to_json()
    assert not {"disturbances", "log_likelihood"} & plain.keys()
    assert not {"disturbances", "requires"} & plain["spec"].keys()
