"""The observer that measures how near to a crash an episode comes."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, ClassVar

from crashhunt.base.faculties import offers
from crashhunt.episode._observer import Observer
from crashhunt.simulators import NamesDanger
from crashhunt.trial import Outcome
from crashhunt.world import ApproachMeter, DangerMeter

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from crashhunt.episode._episode import Episode
    from crashhunt.trial import TrialResult
    from crashhunt.world import ClosestApproach, Frame, Scene

__all__ = ["Nearness"]

_AT_ONCE = 2048  # scenes


class Nearness(Observer):
    """Measures the closest approach and the danger, and adds them to the result.

    Args:
        take_frames: returns the scenes since it was last called, such as `BlackBox.take_frames`: there they lie as
            columns already.
    """

    EVERY: ClassVar = 256
    """Steps; scenes are taken in many at a time, which costs a tenth of one at a time."""

    def __init__(self, take_frames: Callable[[], Sequence[Frame]]) -> None:
        self._take_frames = take_frames
        self._meter = ApproachMeter(())
        self._dangers = DangerMeter((), 1.0)
        self._simulator: object = None
        self._waiting: list[Frame] = []  # for the closest approach, of which so many at a time cost least

    @property
    def closest(self) -> ClosestApproach:
        """The closest approach so far, up to the last complete step."""
        self._take_in()
        self._measure()
        return self._meter.closest

    def begin(self, episode: Episode) -> None:
        """Note who is controlled."""
        self._meter = ApproachMeter(episode.names)
        self._simulator = episode.simulator
        self._dangers = DangerMeter(episode.names, episode.simulator.step_length_s)

    def scene(self, step: int, scene: Scene, rewards: tuple[float, ...]) -> None:
        """Take in what there is, now and then."""
        if step and step % self.EVERY == 0:
            self._take_in()
            if sum(len(frame.columns) for frame in self._waiting) >= _AT_ONCE:
                self._measure()

    def end(self, result: TrialResult) -> TrialResult:
        """Add the closest approach and the danger."""
        closest = self.closest
        if result.collision is not None and "overlap" in result.collision.seen_by:
            closest = replace(closest, gap_m=0.0, time_to_collision_s=0.0)  # perhaps between two scenes
        if result.outcome is Outcome.INVALID:
            return replace(result, closest=closest)
        touched = result.outcome.is_traffic_crash or closest.gap_m <= 0.0
        danger = 1.0 if touched else self._dangers.danger
        # Asked at the end: before the first step it names none, which counts as one that never does.
        if danger is None and offers(self._simulator, NamesDanger):
            named = self._simulator.named_danger
            danger = None if named is None or math.isnan(named) else min(max(named, 0.0), 1.0)
        return replace(result, closest=closest, danger=danger)

    def _take_in(self) -> None:
        frames = self._take_frames()
        self._waiting += frames
        self._dangers.add(frames)

    def _measure(self) -> None:
        waiting, self._waiting = self._waiting, []
        self._meter.measure(waiting)
