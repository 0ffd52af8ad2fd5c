"""Measure splitting: where it helps, whether it is unbiased, and whether the noise of SUMO's drivers decides crashes.

A level is a threshold on a measure of the present scene. A path that reaches the next level for the first time
continues as several copies. Each has an equal share of its weight. All but the path itself get new random numbers. The
value of a tree is the weight of the paths that crash.

The weights of a tree sum to 1, and a copy has the law of the original from its state on. So the expected value of a
tree is the crash probability of a plain trial, for any levels and any number of copies. This needs a measure that
looks at the past and the present only. Trees are independent, copies within a tree are not.

Source: P. Glasserman, P. Heidelberger, P. Shahabuddin and T. Zajic, Multilevel splitting for estimating rare event
probabilities, Operations Research 47(4), 1999.

Prints the tables of crashhunt/guide/reference/evaluation/rates-evaluation.md. Set OPENBLAS_NUM_THREADS=1 for `loop`,
because a process with threads cannot be forked.
usage: scripts/studies/run splitting walk [REPETITIONS] [CASE]            a random walk with a known probability (500)
       scripts/studies/run splitting loop TREES COPIES LEVEL,… SPEED SEED   on `loop`, an agent at constant SPEED in m/s
       scripts/studies/run splitting levels SCENARIO AGENT [NAME=VALUE]…    the test of levels of `--rare splitting`
"""

from __future__ import annotations

import copy
import math
import random
import sys
import tempfile
from dataclasses import dataclass
from functools import partial
from itertools import islice, pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, cast

import numpy as np

from crashhunt.agents import KeepLaneWithSpeed
from crashhunt.base.plugins import locate
from crashhunt.episode import COPIES_PER_LEVEL, Episode, seed_everything
from crashhunt.oracles import Overlap, ReportedCollision
from crashhunt.scenario import argument_values, load_scenario, with_action
from crashhunt.statistics import RareCounter, RateTest, Root, choose_levels, why_unfit
from crashhunt.trial import CRASHES, TrialSpec
from crashhunt.world import closing_rate

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from crashhunt.base.codec import JsonObject
    from crashhunt.base.json_types import Plain

PILOT_TREES: Final = 64
"""Trees for the test of the levels. They do not count for the estimate."""
MIN_FACTOR: Final = 2.0
"""From level to level, the crash probability has to grow by this factor at least."""
ALPHA = 0.05


@dataclass(frozen=True, slots=True)
class Leaf:
    """How a path ended.

    Args:
        weight: its share of the tree.
        reached: how many levels it reached before its end.
        crashed: whether it ended by a crash.
    """

    weight: float
    reached: int
    crashed: bool


class SplitPath:
    """A running trial, or a copy of it.

    Attributes:
        steps: that it and its copies took.
    """

    steps = 0
    level: float
    is_over: bool
    has_crashed: bool

    def step(self) -> None:
        """Run one step."""
        raise NotImplementedError

    def fork(self, work: Callable[[SplitPath], list[Leaf]]) -> list[Leaf]:
        """Make a copy with new random numbers, and return what the work with it returns."""
        raise NotImplementedError


def grow_tree(
    path: SplitPath, levels: Sequence[float], copies: int, reached: int = 0, weight: float = 1.0
) -> list[Leaf]:
    """Run a path and its copies to their ends, and return how they ended, the path itself first."""
    leaves: list[Leaf] = []
    while not path.is_over:
        while reached < len(levels) and path.level >= levels[reached]:
            reached, weight = reached + 1, weight / copies
            grow = partial(grow_tree, levels=levels, copies=copies, reached=reached, weight=weight)
            for _ in range(copies - 1):
                leaves += path.fork(grow)
        path.step()
    return [Leaf(weight, reached, path.has_crashed), *leaves]


def value_of(leaves: Iterable[Leaf]) -> float:
    """Return the value of a tree: its estimate of the crash probability of a trial, from 0 to 1."""
    return math.fsum(leaf.weight for leaf in leaves if leaf.crashed)


def crash_shares(trees: Sequence[Iterable[Leaf]], levels: int) -> list[float]:
    """Return the crash probability of all paths, and of those that have reached each level; NaN where none has."""
    leaves = [leaf for tree in trees for leaf in tree]
    found = []
    for number in range(levels + 1):
        beyond = [leaf for leaf in leaves if leaf.reached >= number]
        mass = math.fsum(leaf.weight for leaf in beyond)
        found.append(value_of(beyond) / mass if mass else math.nan)
    return found


def passes(trees: Sequence[Iterable[Leaf]], levels: int) -> bool:
    """Return whether each level at least doubles the crash probability."""
    shares = crash_shares(trees, levels)
    return all(0 < MIN_FACTOR * one <= other for one, other in pairwise(shares))


# A random walk that crashes at its top.

UP, DOWN = 0.1, 0.35
COPIES_OF_WALKS = 4
WALKS: dict[str, tuple[dict[str, Any], tuple[int, ...]]] = {
    "1e-3": ({"top": 7}, (3, 4, 5, 6)),
    "3e-4": ({"top": 8}, (3, 4, 5, 6, 7)),
    "2e-5": ({"top": 10}, (3, 4, 5, 6, 7, 8, 9)),
    "2e-5, hidden 1e-4": ({"top": 10, "hidden": 2.5e-6}, (3, 4, 5, 6, 7, 8, 9)),
}


@dataclass(frozen=True)
class Walk:
    """The parameters.

    Args:
        top: the place at which a path crashes.
        steps: of a trial.
        hidden: probability per step of a crash at place 0, which no level leads to.
    """

    top: int = 8
    steps: int = 60
    hidden: float = 0.0

    def truth(self) -> float:
        """Return the crash probability by dynamic programming."""
        places, crashed = [1.0] + [0.0] * (self.top - 1), 0.0
        for _ in range(self.steps):
            crashed += places[0] * self.hidden
            places[0] *= 1.0 - self.hidden
            after = [0.0] * self.top
            for place, mass in enumerate(places):
                after[max(0, place - 1)] += mass * DOWN
                after[place] += mass * (1.0 - UP - DOWN)
                if place + 1 < self.top:
                    after[place + 1] += mass * UP
                else:
                    crashed += mass * UP
            places = after
        return crashed


class WalkPath(SplitPath):
    """A path of a walk; the level is its place."""

    def __init__(self, walk: Walk, seed: float) -> None:
        self.walk, self.rng = walk, random.Random(seed)
        self.level, self.steps, self.has_crashed, self.at = 0, 0, False, 0

    @property
    def is_over(self) -> bool:  # type: ignore[override]
        """Whether the trial has ended."""
        return self.has_crashed or self.at >= self.walk.steps

    def step(self) -> None:
        """Run one step."""
        self.at += 1
        self.steps += 1
        if self.walk.hidden and self.level == 0 and self.rng.random() < self.walk.hidden:
            self.has_crashed = True
            return
        drawn = self.rng.random()
        if drawn < UP:
            self.level += 1
            self.has_crashed = self.level >= self.walk.top
        elif drawn < UP + DOWN:
            self.level = max(0, self.level - 1)

    def fork(self, work: Callable[[SplitPath], list[Leaf]]) -> list[Leaf]:
        """Make a copy with new random numbers, and return what the work with it returns."""
        made = copy.copy(self)
        made.rng, made.steps = random.Random(self.rng.random()), 0
        leaves = work(made)
        self.steps += made.steps
        return leaves


def walks(repetitions: int, name: str) -> None:
    """Print how splitting estimates a known crash probability from 400 trees, after 64 pilot trees."""
    case, levels = WALKS[name]
    walk, steps, refused, found, ever = Walk(**case), 0, 0, [], 0
    truth = walk.truth()
    for repetition in range(repetitions):
        paths = (WalkPath(walk, (repetition << 20) + number) for number in range(PILOT_TREES + 400))
        trees = ((grow_tree(path, levels, COPIES_OF_WALKS), path) for path in paths)
        refused += not passes([leaves for leaves, _ in islice(trees, PILOT_TREES)], len(levels))
        counter, certain = RareCounter(), RateTest()
        for leaves, path in trees:
            value = value_of(leaves)
            counter.add(Root(undisturbed=value, disturbed=0.0, own=value, own_steps=walk.steps))
            certain.add(value)
            steps += path.steps
        found.append(counter.estimate())
        low, high = certain.interval(ALPHA)
        ever += low <= truth <= high
    values = np.array([one.estimate for one in found], float)
    z = (values.mean() - truth) / (values.std(ddof=1) / math.sqrt(repetitions))
    told = [one.estimated for one in found if one.estimated is not None]
    covers = f"{np.mean([one.low <= truth <= one.high for one in told]):.1%}" if told else "-"
    saved = truth * (1 - truth) / values.var() * walk.steps / (steps / repetitions)
    print(
        f"{name:<20} {repetitions} repetitions  truth {truth:.3g}  mean {values.mean():.3g}  z {z:+.2f}  "
        f"reported {len(told) / repetitions:.0%}  covers {covers}  certain covers {ever / repetitions:.1%}  "
        f"refused by pilots {refused / repetitions:.1%}  steps saved {saved:.0f} times",
        flush=True,
    )


# SUMO.

STEPS = 300
PATIENCE_S = 600.0
EGO = "ego"


class EpisodePath(SplitPath):
    """An episode as a path; copies are forks of this process, with new seeds of SUMO's generators.

    Args:
        episode: that runs.
        key: numbers of the forks that led to it.

    Attributes:
        ends: of it and its copies, the last step and the place of the agent.
    """

    def __init__(self, episode: Episode, key: tuple[int, ...] = ()) -> None:
        self.episode, self.key, self.forks = episode, key, 0
        self.ends: list[list[float]] = []

    @property
    def level(self) -> float:  # type: ignore[override]
        """Closing speed by gap, in 1/s."""
        scene = self.episode.scene
        return 0.0 if scene is None else closing_rate(scene.frame, EGO)

    @property
    def is_over(self) -> bool:  # type: ignore[override]
        """Whether the trial has ended."""
        return self.episode.result is not None

    @property
    def has_crashed(self) -> bool:  # type: ignore[override]
        """Whether it ended by a crash."""
        return self.episode.result is not None and self.episode.result.outcome in CRASHES

    def step(self) -> None:
        """Run one step."""
        self.episode.step()
        self.steps += 1
        if self.is_over and self.episode.scene is not None:
            speeds = self.episode.scene.frame.columns[-1][-len(self.episode.scene.frame.roster.actors) :]
            self.ends.append([self.episode.steps, float(speeds.sum())])

    def fork(self, work: Callable[[SplitPath], list[Leaf]]) -> list[Leaf]:
        """Make a copy with new random numbers, and return what the work with it returns."""
        self.forks += 1
        key = (*self.key, self.forks)
        (seed,) = np.random.SeedSequence(self.episode.spec.seed, spawn_key=key).generate_state(1)

        def run(made: Episode) -> Plain:
            path = EpisodePath(made, key)
            made.reseed(int(seed) >> 1)
            leaves = [[one.weight, one.reached, one.crashed] for one in work(path)]
            return {"leaves": leaves, "steps": path.steps, "ends": path.ends}

        forked = self.episode.fork(run, observed=False)
        answer = forked.answer(PATIENCE_S)
        if answer is None:
            raise SystemExit(f"a copy has no answer: {forked.no_answer}")
        found = cast("JsonObject", answer)
        self.steps += cast(int, found["steps"])
        self.ends += cast("list[list[float]]", found["ends"])
        return [Leaf(*one) for one in cast("list[tuple[float, int, bool]]", found["leaves"])]


class _PeakPath(EpisodePath):
    """A root, which also records the greatest level."""

    peak = 0.0

    def step(self) -> None:
        """Run one step."""
        super().step()
        self.peak = max(self.peak, self.level)


def loop(trees: int, copies: int, levels: Sequence[float], speed: float, first: int) -> None:
    """Grow trees on `loop`, and print how often their paths crash."""
    scenario = load_scenario("loop")
    simulator = locate("simulators", scenario.simulator)(scenario, Path(tempfile.mkdtemp()))
    found, steps = [], 0
    for seed in range(first, first + trees):
        seed_everything(seed)
        spec = TrialSpec(seed, seed, {EGO: {"speed": speed}}, argument_values(scenario), STEPS)
        with Episode(
            spec, simulator=simulator, make_agent=lambda *_: KeepLaneWithSpeed(speed),
            oracles=[ReportedCollision(), Overlap()], crash_on=CRASHES, forks=True,
        ) as episode:  # fmt: skip
            if episode.start() is not None:
                raise SystemExit(f"trial {seed} did not start: {episode.result}")
            path = EpisodePath(episode)
            leaves = grow_tree(path, levels, copies)
        found.append(leaves)
        steps += path.steps
        crashed = sum(leaf.crashed for leaf in leaves)
        different = len({tuple(end) for end in path.ends})
        print(f"seed {seed}: {crashed} of {len(leaves)} paths crashed; {different} different ends", flush=True)
    values = [value_of(leaves) for leaves in found]
    shares = ", ".join(f"{share:.3g}" for share in crash_shares(found, len(levels)))
    mean, variance = float(np.mean(values)), float(np.var(values, ddof=1))
    print(f"crash probability of all paths, and from each level: {shares}")
    print(
        f"{trees} trees: {mean:.3g}, standard error {math.sqrt(variance / trees):.2g}, {steps / trees:.0f} steps each"
    )
    print(f"{sum(leaves[0].crashed for leaves in found)} of {trees} first paths crashed")
    if variance > 0:
        print(f"steps saved: {mean * (1 - mean) / variance * STEPS * trees / steps:.2f} times")


def levels(name: str, agent: str, arguments: dict[str, float], first: int = 700_000) -> None:
    """Choose levels by pilots and test them by trees, as `--rare splitting` does, without the plain trials."""
    scenario = with_action(load_scenario(name), EGO, "continuous")
    simulator = locate("simulators", scenario.simulator)(scenario, Path(tempfile.mkdtemp()))
    driver = locate("agents", agent)

    def run(seed: int, of_tree: Sequence[float]) -> tuple[float, list[Leaf]] | None:
        seed_everything(seed)
        spec = TrialSpec(seed, seed, {EGO: dict(arguments)}, argument_values(scenario), STEPS)
        with Episode(
            spec, simulator=simulator, make_agent=lambda *_: driver(**arguments),
            oracles=[ReportedCollision(), Overlap()], crash_on=CRASHES, forks=True,
        ) as episode:  # fmt: skip
            if episode.start() is not None:
                return None
            path = _PeakPath(episode)
            leaves = grow_tree(path, of_tree, COPIES_PER_LEVEL)
            if episode.result is not None and episode.result.outcome.category == "software fault":
                raise SystemExit(f"trial {seed}: {episode.result.summary}")
            return path.peak, leaves

    pilots = list(islice(filter(None, (run(seed, ()) for seed in range(first, first + 1000))), PILOT_TREES))
    chosen = choose_levels([peak for peak, _ in pilots])
    trees = islice(filter(None, (run(seed, chosen) for seed in range(first + 1000, first + 2000))), PILOT_TREES)
    found = [leaves for _, leaves in trees]
    shares = crash_shares(found, len(chosen))
    print(f"{name}, {agent}: levels {chosen}, crash probability of all paths and from each level {shares}")
    print(
        f"  crashed pilots: {sum(leaves[0].crashed for _, leaves in pilots)}; {why_unfit(shares) or 'levels are fit'}"
    )
    mixed = sum(0 < sum(leaf.crashed for leaf in leaves) < len(leaves) for leaves in found)
    crashed = sum(any(leaf.crashed for leaf in leaves) for leaves in found)
    print(f"  trees with a crash: {crashed}, in {mixed} of these some paths did not crash", flush=True)


def main(words: list[str]) -> None:
    """Print the table that was asked for."""
    if words[:1] == ["levels"]:
        pairs = (word.partition("=") for word in words[3:])
        levels(words[1], words[2], {name: float(value) for name, _, value in pairs})
        return
    if words[:1] == ["loop"]:
        loop(
            int(words[1]), int(words[2]), [float(word) for word in words[3].split(",")], float(words[4]), int(words[5])
        )
        return
    for name in WALKS:
        if len(words) < 3 or words[2] == name:
            walks(int(words[1]) if len(words) > 1 else 500, name)


if __name__ == "__main__":
    main(sys.argv[1:])
