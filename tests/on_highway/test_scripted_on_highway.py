"""Episodes of highway-env whose others are moved along recorded ways."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from crashhunt.base.errors import InvalidEpisodeError
from crashhunt.highway import HighwaySimulator
from crashhunt.scenario import argument_values, load_scenario
from crashhunt.world import paths_of

STEPS, BEGIN = 14, 10


@pytest.fixture(scope="module")
def merging(tmp_path_factory):
    return HighwaySimulator(load_scenario("merge-highway-env"), tmp_path_factory.mktemp("stage"))


def driven(simulator, begin=0, end=STEPS, **options):
    """The scenes and what the agents saw, from one step on, with actions that depend on the step only."""
    arguments = {**argument_values(simulator._scenario)}
    seen, _ = simulator.reset(seed=4, options={"arguments": arguments, **options})
    scenes, shown = [simulator.scene()], [seen]
    for step in range(begin, end):
        if not simulator.agents:
            break
        words = {agent: "LANE_LEFT" if step == 2 and agent == "ego" else "FASTER" for agent in simulator.agents}
        forms = {agent: simulator.actions[agent] for agent in words}
        actions = {agent: form.encode(form.space.meanings.index(words[agent])) for agent, form in forms.items()}
        seen, *_ = simulator.step(actions)
        scenes.append(simulator.scene())
        shown.append(seen)
    return scenes, shown


def told(scene, name):
    row = scene.roster.index[name]
    return *scene.points[row], scene.headings[row], scene.speeds[row]


@pytest.fixture(scope="module")
def merged(merging):
    return driven(merging)


def test_others_and_obstacles_are_where_they_were_and_the_agent_drives_as_it_did(merging, merged):
    scenes, shown = merged
    paths = paths_of(scenes, ("ego",))
    assert "obstacle.1" in paths.names
    again, seen = driven(merging, script=paths.placing())
    assert merging.scripted
    assert [scene.time_s for scene in again] == [scene.time_s for scene in scenes]
    for one, other in zip(scenes, again, strict=True):
        names = set(one.roster.actors)
        assert set(other.roster.actors) == names
        assert all(told(one, actor.id) == told(other, actor.id) for actor in names if actor.id != "ego")
        assert np.allclose(told(one, "ego"), told(other, "ego"), atol=1e-9)
    np.testing.assert_allclose([each["ego"] for each in seen], [each["ego"] for each in shown], atol=1e-5)


def test_it_begins_later_without_most_and_continues_after_the_recorded_end(merging, merged):
    scenes, _ = merged
    paths = paths_of(scenes, ("ego",))
    stays = next(name for name in paths.names if name.startswith("vehicle"))
    script = paths.only((stays,)).cut(BEGIN, STEPS, merging.step_length_s).placing()
    again, _ = driven(merging, BEGIN, STEPS + 2, script=script)
    assert {actor.id for scene in again for actor in scene.roster.actors} == {"ego", stays}
    for one, other in zip(scenes[BEGIN:], again, strict=False):
        assert one.time_s == pytest.approx(other.time_s)
        assert told(one, stays) == told(other, stays)
        assert np.allclose(told(one, "ego"), told(other, "ego"), atol=0.3)  # it has kept its lane and sought its speed
    end, later = told(again[-3], stays), told(again[-1], stays)
    assert np.hypot(later[0] - end[0], later[1] - end[1]) == pytest.approx(2 * merging.step_length_s * end[3])
    everybody, _ = driven(merging)
    assert not merging.scripted
    assert everybody[-1].points == scenes[-1].points


def test_where_an_agent_begins_must_be_known_on_highway_env(merging, merged):
    paths = paths_of(merged[0], ("ego",)).placing()
    late = replace(paths, agents=(replace(paths.agents[0], first=1),))
    with pytest.raises(InvalidEpisodeError, match="start position of 'ego' is unknown"):
        driven(merging, script=late)


def test_an_agent_is_moved_and_the_other_one_meets_it(tmp_path):
    simulator = HighwaySimulator(load_scenario("intersection-two-agents"), tmp_path)
    scenes, _ = driven(simulator, end=60)
    hits = [hit for scene in scenes for hit in scene.contacts]
    assert hits
    agent = next(name for name in (hits[0].collider, hits[0].victim) if name in ("south", "west"))
    names = {hits[0].collider, hits[0].victim} | {"south", "west"}
    paths = paths_of(scenes, ("south", "west")).driven_by((agent,)).only(names)
    again, seen = driven(simulator, end=60, script=paths.placing())
    assert simulator.agents == [] or simulator.agents == [agent]
    assert all(set(each) == {agent} for each in seen)
    other = next(iter({"south", "west"} - {agent}))
    for one, moved in zip(scenes, again, strict=False):
        assert told(one, other) == told(moved, other)
    found = [hit for scene in again for hit in scene.contacts]
    assert [(hit.collider, hit.victim) for hit in found][:1] == [(hits[0].collider, hits[0].victim)]
