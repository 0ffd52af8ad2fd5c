"""A Markov model of a trial with a known crash probability, and hunts for it as the episode would do them.

A vehicle is ahead of the agent or not. A disturbance of the vehicle has an effect only where it is there. A hard stop
crashes by chance, which is the agent's own. A brake alone is harmless. Within a few steps after another onset it
crashes. And there is a mode that crashes without any disturbance.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from crashhunt.disturbances import Choices, DisturbanceSampler, FirstOnsets, first_forcing
from crashhunt.statistics import BLOCK, TRIALS_PER_ROOT, learn_forcing, root_of
from crashhunt.statistics._rare import with_plain
from crashhunt.trial import CRASHES, Disturbance, Forced, ForcedCopy, Outcome, TrialResult, TrialSpec

if TYPE_CHECKING:
    from collections.abc import Mapping

ENTERS, LEAVES = 0.15, 0.2
WINDOW = 6
HARD = 6.0
AGENT = "ego"


def models():
    """Return three models: of the agent itself, and of the vehicle ahead."""
    return {
        "late_action": Choices("late_action", {"itself": 1.0}, {0.5: 1.0}, {1.0: 1.0}),
        "brake": Choices("brake", {"ahead": 2.0, "left": 1.0}, {2.0: 1.0, 4.0: 1.0}, {1.0: 1.0, 2.0: 1.0}),
        "stop": Choices("stop", {"ahead": 1.0}, {3.0: 3.0, HARD: 1.0}, {8.0: 1.0}),
    }


@dataclass(frozen=True)
class Model:
    """The parameters.

    Args:
        chances: by model, per step.
        fails: probability that a hard stop crashes.
        hidden: probability per step of a crash without any disturbance.
        steps: of a trial.
    """

    chances: Mapping[str, float]
    fails: float = 0.5
    hidden: float = 0.0
    steps: int = 40

    def sampler(self):
        known = {name: model for name, model in models().items() if name in self.chances}
        return DisturbanceSampler(known, dict(self.chances), (AGENT,), 1.0)

    @property
    def hazard(self):
        return sum(self.chances.values())

    def truth(self):
        """Return the crash probability by dynamic programming: undisturbed part, disturbed part."""
        # State: vehicle there, steps left of the window, any effective onset; the value is its probability.
        states = {(False, 0, False): 1.0}
        crashed = {False: 0.0, True: 0.0}
        for _ in range(self.steps):
            for name, share in (("late_action", 1.0), ("brake", 2 / 3), ("stop", 1.0)):
                after: dict[tuple[bool, int, bool], float] = {}
                for (there, left, disturbed), mass in states.items():
                    fires = self.chances.get(name, 0.0) * share * (there or name == "late_action")
                    for probability, state in self._ways(name, fires, (there, left, disturbed)):
                        if state is None:
                            crashed[True] += mass * probability
                        else:
                            after[state] = after.get(state, 0.0) + mass * probability
                states = after
            after = {}
            for (there, left, disturbed), mass in states.items():
                crashed[disturbed] += mass * self.hidden
                lives = mass * (1 - self.hidden)
                changes = LEAVES if there else ENTERS
                for probability, state in ((changes, not there), (1 - changes, there)):
                    key = state, max(0, left - 1), disturbed
                    after[key] = after.get(key, 0.0) + lives * probability
            states = after
        return crashed[False], crashed[True]

    def _ways(self, name, fires, state):
        there, left, _ = state
        yield 1 - fires, state
        if name == "late_action":
            yield fires, (there, WINDOW, True)
        elif name == "brake":
            yield fires, None if left else (there, WINDOW, True)
        else:
            hits = 0.25 * self.fails
            yield fires * hits, None
            yield fires * (1 - hits), (there, left, True)


@dataclass
class Episode:
    """A running trial; a copy of it is a fork, with the same random numbers."""

    model: Model
    draws: list[list[float]]  # of each step
    planned: list[Disturbance]
    steps: int = 0
    there: bool = False
    left: int = 0
    disturbed: bool = False
    crashed: bool = False
    told: list[Disturbance] = field(default_factory=list)

    def has_target(self, one):
        assert one.step == self.steps + 1
        return one.who == "ahead" and self.there

    def fork(self, planned):
        made = copy.copy(self)
        made.planned = list(planned)
        made.told = []
        return made

    @property
    def over(self):
        return self.crashed or self.steps >= self.model.steps

    def step(self):
        self.steps += 1
        fails, hidden, moves = self.draws[self.steps - 1]
        now = [one for one in self.planned if one.step == self.steps]
        for name in ("late_action", "brake", "stop") if now else ():
            for one in now:
                if one.what == name:
                    self._begin(one, fails)
                if self.crashed:
                    return
        if hidden < self.model.hidden:
            self.crashed = True
            return
        self.there ^= moves < (LEAVES if self.there else ENTERS)
        self.left = max(0, self.left - 1)

    def _begin(self, one, fails):
        if one.what != "late_action" and not (one.who == "ahead" and self.there):
            return
        self.disturbed = True
        if one.what == "late_action":
            self.left = WINDOW
        elif one.what == "brake":
            self.crashed = self.left > 0
            self.left = WINDOW
        elif one.how_strong == HARD:
            self.crashed = fails < self.model.fails


def episode_of(model, seed, planned):
    """Return an episode before its first step."""
    return Episode(model, np.random.default_rng(seed + 1).random((model.steps, 3)).tolist(), list(planned))


def run_root(model, sampler, forcing, seed):
    """Return the result of a root, as an episode gives it."""
    spec = TrialSpec(0, seed, {}, {}, model.steps, disturbances=sampler.draw(seed, 1), forcing=forcing)
    episode = episode_of(model, seed, spec.disturbances)
    onsets, copies, steps = FirstOnsets(sampler, forcing, seed, model.steps), [], 0
    while True:
        for onset in onsets.after(episode.steps, episode.has_target):
            kept = [one for one in spec.disturbances if one.step > episode.steps]
            found, taken = run_copy(episode, kept, onset, onsets.following(onset))
            copies += found
            steps += taken
        episode.step()
        if episode.over:
            break
    forced = Forced(onsets.survival, onsets.masses, tuple(copies), steps)
    outcome = Outcome.COLLISION if episode.crashed else Outcome.SURVIVED
    there = spec.disturbances if episode.disturbed else ()
    return replace(TrialResult(spec, outcome, steps=episode.steps), forced=forced, disturbances=there)


def run_copy(episode, kept, onset, following):
    """Return the copies of a first onset, and the steps that they take."""
    made = episode.fork([*kept, *(onset.planned if following is None else onset.alone)])
    found, steps = [], 0
    while not made.over:
        for second in following.after(made.steps, made.has_target) if following else ():
            other = made.fork([*(one for one in made.planned if one.step > made.steps), *second.planned])
            while not other.over:
                other.step()
            steps += other.steps - made.steps
            found.append(copy_of(onset, made, other, second))
        made.step()
    steps += made.steps - episode.steps
    return [copy_of(onset, episode, made, within=following.survival if following else 1.0), *found], steps


def copy_of(onset, left, made, second=None, *, within=None):
    within = second.weight if second else within
    return ForcedCopy(
        cell=onset.cell, onset=(second or onset).step, weight=onset.weight * within, branched=left.steps,
        crash="collision" if made.crashed else "", step=made.steps, disturbed=made.disturbed, within=within,
        second=second.cell if second else "",
    )  # fmt: skip


def run_plain(model, sampler, seed):
    """Return the result of a plain trial."""
    spec = TrialSpec(0, seed, {}, {}, model.steps, disturbances=sampler.draw(seed, model.steps))
    episode = episode_of(model, seed, spec.disturbances)
    while not episode.over:
        episode.step()
    there = spec.disturbances if episode.disturbed else ()
    outcome = Outcome.COLLISION if episode.crashed else Outcome.SURVIVED
    return replace(TrialResult(spec, outcome, steps=episode.steps), disturbances=there)


def run_roots(model, count, seed, *, sampler=None, plain=True):
    """Return the values of roots with their plain trials, with the forcing learned as a hunt learns it."""
    sampler = sampler or model.sampler()
    start = first_forcing(sampler, model.steps)
    results: list[TrialResult] = []
    for number in range(count):
        block = number // BLOCK
        if number % BLOCK == 0:
            forcing = learn_forcing([one.forced for one in results[: max(0, block - 1) * BLOCK]], start)
        results.append(run_root(model, sampler, forcing, seed * 1_000_003 + 7 * number))
    roots = [root_of(result, CRASHES, model.hazard) for result in results]
    if not plain:
        return roots
    seeds = iter(range(seed * 1_000_003 + 10**9, 10**12))
    return [
        with_plain(root, [run_plain(model, sampler, next(seeds)) for _ in range(TRIALS_PER_ROOT - 1)], CRASHES)
        for root in roots
    ]
