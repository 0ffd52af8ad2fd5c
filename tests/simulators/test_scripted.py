"""Episodes whose others are moved along recorded ways, on SUMO and on highway-env."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pytest

from crashhunt.base.errors import InvalidEpisodeError
from crashhunt.highway import HighwaySimulator
from crashhunt.scenario import argument_values, load_scenario
from crashhunt.sumo import SumoSimulator
from crashhunt.world import paths_of

if TYPE_CHECKING:
    from collections.abc import Callable


def speed_and_lane(simulator, step):
    return {"ego": (12.0 + step % 7, 1 if step == 5 else 0)}


def meta_actions(simulator, step):
    words = {agent: "LANE_LEFT" if step == 2 and agent == "ego" else "FASTER" for agent in simulator.agents}
    return {agent: simulator.actions[agent].space.meanings.index(word) for agent, word in words.items()}


class Course(NamedTuple):
    """An episode to record: its actions depend on the step only.

    A later episode begins at step `begin`, and continues for `beyond` steps after the recorded end. Its agent is within
    `tolerance` of the recorded one.
    """

    simulator: Any
    act: Callable
    seed: int
    steps: int
    begin: int
    beyond: int
    tolerance: float
    arguments: dict[str, Any] = {}  # noqa: RUF012 - nothing changes it

    def driven(self, begin=0, end=None, **options):
        """The scenes and what the agents saw, from one step on."""
        simulator = self.simulator
        arguments = {**argument_values(simulator._scenario), **self.arguments}
        seen, _ = simulator.reset(seed=self.seed, options={"arguments": arguments, **options})
        scenes, shown = [simulator.scene()], [seen]
        for step in range(begin, end or self.steps):
            if not simulator.agents:
                break
            actions = self.act(simulator, step)
            seen, *_ = simulator.step({agent: simulator.actions[agent].encode(one) for agent, one in actions.items()})
            scenes.append(simulator.scene())
            shown.append(seen)
        return scenes, shown


def told(scene, name):
    row = scene.roster.index[name]
    return *scene.points[row], scene.headings[row], scene.speeds[row], scene.lanes[row] if scene.lanes else ""


@pytest.fixture(scope="module", params=["loop", "merge-highway-env"])
def course(request, tmp_path_factory):
    kind = SumoSimulator if request.param == "loop" else HighwaySimulator
    simulator = kind(load_scenario(request.param), tmp_path_factory.mktemp("stage"))
    if kind is SumoSimulator:
        yield Course(simulator, speed_and_lane, 3, 30, 20, 5, 1e-9, {"vehicles": 12})
    else:  # its agent keeps its lane and seeks its speed until a later episode begins
        yield Course(simulator, meta_actions, 4, 14, 10, 2, 0.3)
    simulator.close()


@pytest.fixture(scope="module")
def recorded(course):
    return course.driven()


def test_the_others_are_where_they_were_and_the_agent_sees_what_it_saw(course, recorded):
    scenes, shown = recorded
    paths = paths_of(scenes, ("ego",))
    assert isinstance(course.simulator, SumoSimulator) or "obstacle.1" in paths.names
    again, seen = course.driven(script=paths.placing())
    assert course.simulator.scripted
    assert [scene.time_s for scene in again] == [scene.time_s for scene in scenes]
    for one, other in zip(scenes, again, strict=True):
        names = {actor.id for actor in one.roster.actors}
        assert set(one.roster.actors) == set(other.roster.actors)
        assert all(told(one, name) == told(other, name) for name in names - {"ego"})
        assert np.allclose(told(one, "ego")[:4], told(other, "ego")[:4], atol=1e-9)
    np.testing.assert_allclose([each["ego"] for each in seen], [each["ego"] for each in shown], atol=1e-5)


def test_it_begins_later_without_most_of_them_and_continues_after_the_end(course, recorded):
    scenes, _ = recorded
    paths = paths_of(scenes, ("ego",))
    stays = next(name for name in paths.names if not name.startswith("obstacle"))
    step_s = course.simulator.step_length_s
    script = paths.only((stays,)).cut(course.begin, course.steps, step_s).placing()
    again, _ = course.driven(course.begin, course.steps + course.beyond, script=script)
    assert {actor.id for scene in again for actor in scene.roster.actors} == {"ego", stays}
    for one, other in zip(scenes[course.begin :], again, strict=False):
        assert one.time_s == pytest.approx(other.time_s)
        assert told(one, stays)[:4] == told(other, stays)[:4]
        assert np.allclose(told(one, "ego")[:4], told(other, "ego")[:4], atol=course.tolerance)
    end, later = told(again[-1 - course.beyond], stays), told(again[-1], stays)
    assert np.hypot(later[0] - end[0], later[1] - end[1]) == pytest.approx(course.beyond * step_s * end[3])
    everybody, _ = course.driven()
    assert not course.simulator.scripted
    assert everybody[-1].points == scenes[-1].points


def test_where_an_agent_is_to_begin_must_be_known(course, recorded):
    paths = paths_of(recorded[0], ("ego",))
    if isinstance(course.simulator, SumoSimulator):
        course.driven(3, 4, script=paths.cut(3, course.steps, 0.1))  # its lane is that of a step before
        late = paths_of(recorded[0][3:], ("ego",))
    else:
        late = replace(paths.placing(), agents=(replace(paths.placing().agents[0], first=1),))
    with pytest.raises(InvalidEpisodeError, match="is unknown"):
        course.driven(script=late)


@pytest.mark.parametrize("form", ["acceleration_steering", "target_pose"])
def test_vehicle_that_moves_freely_begins_where_it_was(tmp_path, form):
    def steered(simulator, step):
        return {"ego": simulator._driving.moving["ego"]._action(0.5, 0.001)}

    scenario = load_scenario("loop")
    agents = {"ego": replace(scenario.agents["ego"], action=form)}
    with closing(SumoSimulator(replace(scenario, agents=agents), tmp_path)) as simulator:
        course = Course(simulator, steered, 3, 30, 20, 0, 1e-6, {"vehicles": 12})
        scenes, _ = course.driven()
        script = paths_of(scenes, ("ego",)).cut(course.begin, course.steps, simulator.step_length_s).placing()
        for one, other in zip(scenes[course.begin :], course.driven(course.begin, script=script)[0], strict=True):
            assert np.allclose(told(one, "ego")[:4], told(other, "ego")[:4], atol=course.tolerance)


def test_an_agent_is_moved_and_the_other_one_meets_it(tmp_path):
    course = Course(HighwaySimulator(load_scenario("intersection-two-agents"), tmp_path), meta_actions, 4, 60, 0, 0, 0)
    scenes, _ = course.driven()
    hits = [hit for scene in scenes for hit in scene.contacts]
    assert hits
    agent = next(name for name in (hits[0].collider, hits[0].victim) if name in ("south", "west"))
    names = {hits[0].collider, hits[0].victim} | {"south", "west"}
    paths = paths_of(scenes, ("south", "west")).driven_by((agent,)).only(names)
    again, seen = course.driven(script=paths.placing())
    assert course.simulator.agents in ([], [agent])
    assert all(set(each) == {agent} for each in seen)
    other = next(iter({"south", "west"} - {agent}))
    for one, moved in zip(scenes, again, strict=False):
        assert told(one, other) == told(moved, other)
    found = [hit for scene in again for hit in scene.contacts]
    assert [(hit.collider, hit.victim) for hit in found][:1] == [(hits[0].collider, hits[0].victim)]
