"""Episodes whose others are moved along recorded ways."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest

from crashhunt.base.errors import InvalidEpisodeError
from crashhunt.scenario import argument_values, load_scenario
from crashhunt.sumo import SumoSimulator
from crashhunt.world import paths_of

STEPS, BEGIN = 30, 20


@pytest.fixture(scope="module")
def simulator(tmp_path_factory):
    made = SumoSimulator(load_scenario("loop"), tmp_path_factory.mktemp("stage"))
    yield made
    made.close()


def driven(simulator, begin=0, end=STEPS, **options):
    """The scenes and what the agent saw, from one step on, with actions that depend on the step only."""
    arguments = {**argument_values(simulator._scenario), "vehicles": 12}
    seen, _ = simulator.reset(seed=3, options={"arguments": arguments, **options})
    scenes, shown = [simulator.scene()], [seen["ego"]]
    for step in range(begin, end):
        action = simulator.actions["ego"].encode((12.0 + step % 7, 1 if step == 5 else 0))
        seen, *_ = simulator.step({"ego": action})
        scenes.append(simulator.scene())
        shown.append(seen["ego"])
    return scenes, shown


def told(scene, name):
    row = scene.roster.index[name]
    return *scene.points[row], scene.headings[row], scene.speeds[row], scene.lanes[row] if scene.lanes else ""


@pytest.fixture(scope="module")
def recorded(simulator):
    return driven(simulator)


def test_the_others_are_where_they_were_and_the_agent_sees_what_it_saw(simulator, recorded):
    scenes, shown = recorded
    paths = paths_of(scenes, ("ego",))
    again, seen = driven(simulator, script=paths.placing())
    assert simulator.scripted
    assert [scene.time_s for scene in again] == [scene.time_s for scene in scenes]
    for one, other in zip(scenes, again, strict=True):
        names = {actor.id for actor in one.roster.actors}
        assert {actor.id for actor in other.roster.actors} == names
        assert all(told(one, name) == told(other, name) for name in names - {"ego"})
        assert np.allclose(told(one, "ego")[:4], told(other, "ego")[:4], atol=1e-9)
    np.testing.assert_allclose(seen, shown, atol=1e-6)


def test_it_begins_later_without_most_of_them_and_continues_after_the_end(simulator, recorded):
    scenes, _ = recorded
    paths = paths_of(scenes, ("ego",))
    stays = paths.names[0]
    script = paths.only((stays,)).cut(BEGIN, STEPS, simulator.step_length_s).placing()
    again, _ = driven(simulator, BEGIN, STEPS + 5, script=script)
    assert {actor.id for scene in again for actor in scene.roster.actors} == {"ego", stays}
    for one, other in zip(scenes[BEGIN:], again, strict=False):
        assert one.time_s == pytest.approx(other.time_s)
        assert told(one, stays)[:4] == told(other, stays)[:4]
        assert np.allclose(told(one, "ego")[:4], told(other, "ego")[:4], atol=1e-9)
    end, later = told(again[-6], stays), told(again[-1], stays)
    moved = np.hypot(later[0] - end[0], later[1] - end[1])
    assert moved == pytest.approx(5 * simulator.step_length_s * end[3])
    everybody, _ = driven(simulator)
    assert not simulator.scripted
    assert everybody[-1].points == scenes[-1].points


def test_where_an_agent_is_to_begin_must_be_known(simulator, recorded):
    paths = paths_of(recorded[0], ("ego",))
    nowhere = paths.cut(3, STEPS, 0.1)  # fine: its lane is that of a step before
    driven(simulator, 3, 4, script=nowhere)
    for wrong in (paths_of(recorded[0][3:], ("ego",)),):
        with pytest.raises(InvalidEpisodeError, match="is unknown"):
            driven(simulator, script=wrong)


@pytest.mark.parametrize("form", ["acceleration_steering", "target_pose"])
def test_vehicle_that_moves_freely_begins_where_it_was(tmp_path, form):
    scenario = load_scenario("loop")
    agents = {"ego": replace(scenario.agents["ego"], action=form)}
    with closing(SumoSimulator(replace(scenario, agents=agents), tmp_path)) as simulator:

        def drive(steps, **options):
            arguments = {**argument_values(simulator._scenario), "vehicles": 12}
            simulator.reset(seed=3, options={"arguments": arguments, **options})
            yield simulator.scene()
            for _ in range(steps):
                motion = simulator._driving.moving["ego"]
                simulator.step({"ego": simulator.actions["ego"].encode(motion._action(0.5, 0.001))})
                yield simulator.scene()

        scenes = [*drive(STEPS)]
        script = paths_of(scenes, ("ego",)).cut(BEGIN, STEPS, simulator.step_length_s).placing()
        for one, other in zip(scenes[BEGIN:], drive(STEPS - BEGIN, script=script), strict=True):
            assert np.allclose(told(one, "ego")[:4], told(other, "ego")[:4], atol=1e-6)
