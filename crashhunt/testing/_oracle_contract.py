"""The contract suite for oracles."""

from __future__ import annotations

import copy
import random
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from crashhunt.oracles import BringsOutcomes, Finding, Oracle, SeesMap
from crashhunt.trial import Outcome
from crashhunt.world import Actor, Contact, Event, Lane, Roster, Scene

Make = Callable[[], Oracle]

_AGENTS = ("ego", "second")
_LANES = [Lane("road_0", 3.2, ((0.0, 0.0), (400.0, 0.0))), Lane("road_1", 3.2, ((0.0, 3.2), (400.0, 3.2)))]


class OracleContract:
    """Checks an oracle against `crashhunt.oracles.Oracle`, and against `SeesMap` and `BringsOutcomes` if supported.

    The fixture ``make`` returns a function that creates an oracle.
    """

    @pytest.fixture
    def make(self) -> Make:
        """Return a function that creates an oracle."""
        raise NotImplementedError("the test class must define the fixture 'make'")

    def test_it_has_a_name_and_states_which_outcomes_it_brings(self, make: Make) -> None:
        """The name and the outcomes with their categories are texts that reports can print."""
        oracle = make()
        assert isinstance(oracle.name, str)
        assert oracle.name
        if isinstance(oracle, BringsOutcomes):
            for name, category in oracle.outcomes.items():
                assert Outcome.own(name, category).category in ("traffic crash", "traffic event")

    def test_it_finds_what_agents_do_and_gives_the_evidence(self, make: Make) -> None:
        """A finding has one piece of evidence on one agent, and a built-in or declared outcome."""
        oracle = make()
        brings = set(oracle.outcomes) if isinstance(oracle, BringsOutcomes) else set()
        for findings in _watch(oracle):
            for finding in findings:
                assert finding.outcome in brings or not Outcome(finding.outcome).is_own
                assert Outcome(finding.outcome).category in ("traffic crash", "traffic event")
                evidence = [part for part in (finding.collision, finding.event) if part is not None]
                assert [part.agent in _AGENTS for part in evidence] == [True]

    def test_the_same_scenes_give_the_same_findings(self, make: Make) -> None:
        """The oracle uses no random numbers and no clock, and a new oracle has no memory of earlier scenes."""
        assert list(_watch(make(), seed=1)) == list(_watch(make(), seed=2))

    def test_it_leaves_scenes_as_they_are(self, make: Make) -> None:
        """The oracle must not change scenes, because scenes are recorded and other oracles receive them."""
        oracle = make()
        _show_map(oracle)
        for scene in drive():
            before = copy.deepcopy((scene.data.tolist(), scene.contacts, scene.off_road, scene.events, scene.lanes))
            oracle.check(scene, _AGENTS)
            assert (scene.data.tolist(), scene.contacts, scene.off_road, scene.events, scene.lanes) == before

    def test_it_bears_agents_that_are_not_there_and_empty_roads(self, make: Make) -> None:
        """A vehicle that has arrived is not in the scenes any more, and the oracle must accept this."""
        oracle = make()
        _show_map(oracle, lanes=())
        assert oracle.check(Scene(0.0, Roster(()), [], [], []), _AGENTS) == []
        for scene in drive():
            assert oracle.check(scene, ("gone",)) == []
            assert oracle.check(scene, ()) == []


def drive() -> Iterator[Scene]:
    """Yield the scenes of an episode with many traffic events, each with its previous scene.

    The vehicle ``ego`` drives into ``other``, passes ``near`` closely, runs a red light and leaves the road; ``second``
    stands still.
    """
    actors = [Actor(id=name, kind="car", length=4.5, width=1.8) for name in ("ego", "second", "other", "near")]
    roster, previous = Roster(tuple(actors)), None
    for step in range(60):
        x = 1.5 * step
        points = [(x, 0.0), (-30.0, 0.0), (40.0 + 0.5 * step, 0.0), (60.0, 2.2)]
        touching = abs(points[2][0] - 2.25 - (x - 2.25)) < 4.5
        scene = Scene(
            0.1 * step,
            roster,
            points,
            [0.0] * 4,
            [15.0, 0.0, 5.0, 0.0],
            contacts=(
                Contact(
                    collider="ego",
                    victim="other",
                    kind="collision",
                    lane="road_0",
                    collider_speed=15.0,
                    victim_speed=5.0,
                ),
            )
            if touching
            else (),
            off_road=("ego",) if step > 55 else (),
            lanes=("road_0", "road_0", "road_0", "road_1"),
            swept=step > 0,
        )
        if step == 20:
            scene.events = (Event("red_light", "ego", "ego ran the red light 'c'", x=x, y=0.0, speed=15.0),)
        scene.follow(previous)
        previous = scene
        yield scene


def _watch(oracle: Oracle, seed: int = 0) -> Iterator[list[Finding]]:
    _show_map(oracle)
    random.seed(seed)  # another seed detects draws from a global generator
    np.random.seed(seed)  # noqa: NPY002
    for scene in drive():
        yield oracle.check(scene, _AGENTS)


def _show_map(oracle: Oracle, lanes: tuple[Lane, ...] = tuple(_LANES)) -> None:
    if isinstance(oracle, SeesMap):
        oracle.see_map(lanes)
