"""Splitting: when a path of a root trial reaches a level, it is copied, and the copies get other random numbers.

A level is a threshold for a measure of the current scene: the closing speed divided by the gap to the vehicle ahead. A
path that reaches the next level for the first time continues as `COPIES_PER_LEVEL` paths with an equal share of its
weight. The path itself keeps its random numbers. The simulator of each copy gets new seeds. The root and its copies
form a tree.

Invariant: the weights of a tree have the sum 1, and each copy has the law of the original from its state on. Therefore,
the expected weight of the crashes of a tree is the crash probability of a plain trial, for any levels that are fixed
before the root begins. The measure may depend only on past and current scenes, because a measure of later scenes would
select paths by their ends. The root is bit-identical to a plain trial.

The random numbers of the agent and of disturbances are the same in all copies. Equal random numbers correlate the paths
of a tree, but cause no bias. Trees are independent.

A copy always runs to the end of its trial. A tree in which a copy has no result counts as incomplete.

Source: Glasserman, Heidelberger, Shahabuddin and Zajic, Multilevel splitting for estimating rare event probabilities,
Operations Research 47(4), 1999.

Cost: the steps of the copies, a fork for each copy, and about 20 µs for the measure of a scene.
"""

from __future__ import annotations

import time
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Final, Protocol, cast

import numpy as np

from crashhunt.base.capabilities import supports
from crashhunt.base.errors import CrashhuntError
from crashhunt.base.forks import NoAnswer
from crashhunt.episode._forks import ForkRunner
from crashhunt.simulators import SupportsReseeding
from crashhunt.trial import Forced, ForcedCopy, Outcome, Reseeding
from crashhunt.world import closing_rate

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from crashhunt.base.codec import JsonObject
    from crashhunt.base.json_types import Plain
    from crashhunt.episode._episode import Episode
    from crashhunt.trial import TrialResult

__all__ = ["COPIES_PER_LEVEL", "SplitPath", "Splitter", "run_path", "split_path"]

COPIES_PER_LEVEL: Final = 3
"""Paths as which a path continues from a level on: about as many as one of the pilots' levels is harder to reach."""
_SPLITS = 0x73706C69  # separates the seeds of copies from others with the seed of the trial


class SplitPath(Protocol):
    """A running trial, or a copy of a running trial.

    Attributes:
        reached: number of levels that the path has reached.
        weight: share of the path in the weight of the tree.
        measure: measure of the current scene, which is compared with the levels.
        is_over: whether the path has ended.
    """

    reached: int
    weight: float

    @property
    def measure(self) -> float: ...
    @property
    def is_over(self) -> bool: ...

    def step(self) -> None:
        """Run one step of the path."""

    def fork(self, grow: Callable[[SplitPath], list[ForcedCopy]]) -> list[ForcedCopy]:
        """Make a copy of the path with new random numbers, and return the result of `grow` for it."""

    def end(self) -> ForcedCopy:
        """Return how the path ended."""


def split_path(path: SplitPath, levels: Sequence[float]) -> list[ForcedCopy]:
    """Copy a path for each level that it has reached; return how these copies and their own copies ended."""
    ends: list[ForcedCopy] = []
    while path.reached < len(levels) and path.measure >= levels[path.reached]:
        path.reached += 1
        path.weight /= COPIES_PER_LEVEL
        for _ in range(COPIES_PER_LEVEL - 1):
            ends += path.fork(partial(run_path, levels=levels))
    return ends


def run_path(path: SplitPath, levels: Sequence[float]) -> list[ForcedCopy]:
    """Run a path and its copies to their ends; return how each ended, the path itself first."""
    ends: list[ForcedCopy] = []
    while not path.is_over:
        ends += split_path(path, levels)
        path.step()
    return [path.end(), *ends]


class Splitter:
    """Runs a tree of copies for each root trial.

    Args:
        crash_on: the outcomes that count as a crash.
        patience_s: time limit of a copy that has no copies itself, in s of wall time.
        delay: function called with the wall time that copies have taken, in s.
        tell: function called with texts for the user.
        refuse: function called with the reason if the simulator has no random numbers to change.

    Attributes:
        fork_runner: object that runs the forks, and counts those without a result.
    """

    def __init__(
        self,
        crash_on: Sequence[Outcome],
        patience_s: float,
        delay: Callable[[float], None],
        tell: Callable[[str], None] = lambda _: None,
        refuse: Callable[[str], None] = lambda _: None,
    ) -> None:
        self._crashes = frozenset(map(str, crash_on))
        self._patience_s = patience_s
        self._delay = delay
        self._refuse = refuse
        self.fork_runner = ForkRunner("rare", tell)
        self._path: _EpisodePath | None = None
        self._copies: list[ForcedCopy] = []
        self._peak = 0.0

    def is_due(self, episode: Episode) -> bool:
        """Return whether the trial is a root trial of splitting, in which the measure of every step is needed."""
        return episode.spec.forcing is not None and episode.spec.forcing.levels is not None

    def ask(self, episode: Episode) -> None:
        """Make the copies that begin after the completed step; this method is also called before the first step."""
        assert episode.spec.forcing is not None
        if self._path is None:
            self._path = _EpisodePath(episode, self._crashes, self._patience_s, (), fork_runner=self.fork_runner)
            if why_not := _why_no_noise(episode):
                self.fork_runner.stop(why_not)
                self._refuse(why_not)
        self._peak = max(self._peak, self._path.measure)
        if self.fork_runner.why_not and not self.fork_runner.unanswered:
            self.fork_runner.skip()
        if self.fork_runner.unanswered:
            return  # the tree is incomplete anyway
        began = time.monotonic()
        try:
            self._copies += split_path(self._path, episode.spec.forcing.levels or ())
        except CrashhuntError as error:
            self.fork_runner.stop(error.message)
            self.fork_runner.skip()
        finally:
            if self._path.has_forked:
                self._path.has_forked = False
                self._delay(time.monotonic() - began)

    def result(self, result: TrialResult) -> TrialResult:
        """Return the result of the root trial with the results of its copies, and begin the next trial."""
        path, copies, peak, runner = self._path, tuple(self._copies), self._peak, self.fork_runner
        self._path, self._copies, self._peak = None, [], 0.0
        if path is None:
            return result
        forced = Forced(
            survival=path.weight,
            masses={},
            copies=copies,
            steps=sum(copy.step - copy.branched for copy in copies),
            unanswered=runner.unanswered,
            why_unanswered=runner.why_unanswered,
            may_be_asked_again=runner.may_be_answered,
            peak=peak,
        )
        runner.begin_trial()
        return replace(result, forced=forced)


class _LostError(Exception):
    """A copy of a copy has no result."""


class _EpisodePath:
    """An episode as a path; copies are forks of its process.

    Args:
        episode: the running episode.
        crashes: the outcomes that count as a crash.
        patience_s: time limit of a copy that has no copies itself, in s of wall time.
        key: numbers of the forks that led to this path, from which the seeds of its copies are derived.
        reseedings: step and seed of each of these forks.
        reached: number of levels that the path has reached.
        weight: share of the path in the weight of the tree.
        fork_runner: object that counts copies without a result, for the root path; None for a copy, which fails if one
            of its own copies fails.

    Attributes:
        has_forked: whether the path has been copied.
    """

    def __init__(
        self,
        episode: Episode,
        crashes: frozenset[str],
        patience_s: float,
        key: tuple[int, ...],
        reseedings: tuple[tuple[int, int], ...] = (),
        reached: int = 0,
        weight: float = 1.0,
        fork_runner: ForkRunner | None = None,
    ) -> None:
        self.episode, self.reached, self.weight = episode, reached, weight
        self.has_forked = False
        self._crashes, self._patience_s, self._key, self._reseedings = crashes, patience_s, key, reseedings
        self._fork_runner = fork_runner
        self._branched = episode.steps
        self._forks = 0

    @property
    def measure(self) -> float:
        """The greatest closing speed divided by gap, over the vehicles ahead of agents, in 1/s."""
        scene = self.episode.scene
        return 0.0 if scene is None else max(closing_rate(scene.frame, name) for name in self.episode.names)

    @property
    def is_over(self) -> bool:
        """Whether the trial has ended."""
        return self.episode.result is not None

    def step(self) -> None:
        """Run one step of the episode."""
        self.episode.step()

    def fork(self, grow: Callable[[SplitPath], list[ForcedCopy]]) -> list[ForcedCopy]:
        """Make a copy with new seeds of its simulator, and return the result of `grow` for it.

        Raises:
            _LostError: the copy has no result, and this path is a copy itself.
        """
        self._forks += 1
        self.has_forked = True
        key = (*self._key, self._forks)
        sequence = np.random.SeedSequence(self.episode.spec.seed, spawn_key=(_SPLITS, *key))
        seed = int(sequence.generate_state(1)[0] >> 1)
        # A second level in the same step re-seeds all generators again, so only the last seed of a step counts.
        earlier = tuple(one for one in self._reseedings if one[0] != self.episode.steps)
        again = (*earlier, (self.episode.steps, seed))

        def run(made: Episode) -> Plain:
            path = _EpisodePath(made, self._crashes, self._patience_s, key, again, self.reached, self.weight)
            made.reseed(seed)
            try:
                return {"ends": [one.to_json() for one in grow(path)]}
            except _LostError as lost:
                reason: NoAnswer = lost.args[0]
                return {"lost": reason.why, "is_from_outside": reason.is_from_outside}

        def attempt() -> tuple[Plain | None, NoAnswer | None]:
            copy = self.episode.fork(run, observed=False)
            return copy.answer(self._patience_s * COPIES_PER_LEVEL**self._levels_left), copy.no_answer

        if self._fork_runner is not None:
            answer = self._fork_runner.run(attempt)
            if answer is None:
                return []
        else:
            answer, no_answer = attempt()
            if answer is None:
                raise _LostError(no_answer or NoAnswer("did not answer"))
        if lost := answer.get("lost"):
            reason = NoAnswer(str(lost), is_from_outside=bool(answer["is_from_outside"]))
            if self._fork_runner is None:
                raise _LostError(reason)
            self._fork_runner.skip(f"a copy {reason.why}", is_from_outside=reason.is_from_outside)
            return []
        return [ForcedCopy.from_json(end) for end in cast("list[JsonObject]", answer["ends"])]

    @property
    def _levels_left(self) -> int:
        forcing = self.episode.spec.forcing
        return len(forcing.levels or ()) - self.reached if forcing is not None else 0

    def end(self) -> ForcedCopy:
        """Return how the path ended.

        Raises:
            _LostError: the simulator failed, possibly because the path is a copy.
        """
        result = self.episode.result
        assert result is not None
        if result.outcome in (Outcome.SIMULATOR_ERROR, Outcome.INVALID):
            raise _LostError(NoAnswer(f"ended by {result.outcome}"))
        crashed = str(result.outcome) in self._crashes
        *earlier, (after, seed) = self._reseedings
        return ForcedCopy(
            cell=f"level {self.reached}",
            onset=after,
            weight=self.weight,
            branched=self._branched,
            crash=str(result.outcome) if crashed else "",
            step=result.steps,
            disturbed=result.disturbed,
            disturbances=self.episode.spec.disturbances if crashed else (),
            reseeding=Reseeding(after, seed, tuple(earlier)) if crashed else None,
        )


def _why_no_noise(episode: Episode) -> str:
    """Return why copies of an episode cannot get other random numbers; empty if they can get them."""
    simulator = episode.simulator
    if not supports(simulator, SupportsReseeding):
        return "the simulator cannot re-seed its random generators"
    return simulator.why_no_reseeding
