"""What agent and others did before a collision that it may hang on: braking, speeding up, changing lanes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from crashhunt.recording import Recording
    from crashhunt.triage import LaneMap
    from crashhunt.world import Scene

__all__ = ["Doing", "doings_of", "near_ones"]

_BEFORE_S = 10.0  # nobody asks what somebody did longer ago
_NEAR_S, _NEAR_M = 5.0, 60.0  # who is further away than that is not asked about
_BRAKES, _SPEEDS_UP = -1.5, 1.0  # m/s²; less is driving along
_BEGINS = 0.3  # m/s²; from here on, it belongs to what follows
_PAUSE_S = 0.5  # who goes on after it has not stopped
_CHANGED = 1.0  # m/s in all; less makes no difference


@dataclass(frozen=True, slots=True)
class Doing:
    """Something that somebody did.

    Args:
        actor: who.
        what: ``braked``, ``sped up`` or ``changed lanes``.
        step: after which it began.
        speed: that the actor had then, in m/s.
    """

    actor: str
    what: str
    step: int
    speed: float


def near_ones(recording: Recording, agent: str, other: str, most: int) -> list[str]:
    """Return who may have to do with a crash: the other one, and who came nearest to the agent before it.

    Args:
        recording: of the collision.
        agent: the controlled vehicle.
        other: whom it collided with; empty for nobody.
        most: how many at most.
    """
    scenes = recording.scenes()
    since = scenes[-1].time_s - _NEAR_S if scenes else 0.0
    nearest: dict[str, float] = {}
    for scene in scenes:
        row = scene.roster.index.get(agent)
        if row is None or scene.time_s < since:
            continue
        away = np.hypot(*(scene.centers - scene.centers[row]).T)
        for actor, distance in zip(scene.roster.actors, away.tolist(), strict=True):
            if actor.id != agent and distance < min(_NEAR_M, nearest.get(actor.id, _NEAR_M)):
                nearest[actor.id] = distance
    if other:
        nearest[other] = -1.0
    return sorted((name for name in nearest if name not in recording.agents), key=lambda name: (nearest[name], name))[
        :most
    ]


def doings_of(recording: Recording, actor: str, lanes: LaneMap, end: int) -> list[Doing]:
    """Return what somebody did in the last seconds before a step, the last of each sort.

    Args:
        recording: of the collision.
        actor: who.
        lanes: around the place.
        end: the step of the collision; what happens in it is left out, as it changes speeds by itself.
    """
    dt = recording.prologue.step_length_s
    first = max(0, end - round(_BEFORE_S / dt))
    numbered = [
        (step.step, step.scene)
        for step in recording.all_steps
        if first <= step.step < end and step.scene is not None and actor in step.scene.roster.index
    ]
    if len(numbered) < 2:
        return []
    steps, scenes = [number for number, _ in numbered], [scene for _, scene in numbered]
    speeds = np.array([scene.speeds[scene.roster.index[actor]] for scene in scenes])
    found = []
    for what, limit in (("braked", _BRAKES), ("sped up", _SPEEDS_UP)):
        place = _onset(np.diff(speeds) / dt, limit, max(1, round(_PAUSE_S / dt)), dt)
        if place is not None:
            found.append(Doing(actor, what, steps[place], float(speeds[place])))
    place = _change(recording, scenes, actor, lanes)
    if place is not None:
        found.append(Doing(actor, "changed lanes", steps[place], float(speeds[min(place, len(speeds) - 1)])))
    return found


def _onset(changes: NDArray[np.float64], limit: float, pause: int, dt: float) -> int | None:
    """The scene after which somebody last began to brake, or to speed up; None where nobody did."""
    way = 1.0 if limit > 0 else -1.0
    hard = np.flatnonzero(way * changes >= abs(limit))
    while len(hard):
        breaks = np.flatnonzero(np.diff(hard) > pause)
        begin = int(hard[breaks[-1] + 1]) if len(breaks) else int(hard[0])
        until = int(hard[-1])
        while begin > 0 and way * changes[begin - 1] >= _BEGINS:
            begin -= 1
        if abs(float(changes[begin : until + 1].sum())) * dt >= _CHANGED:
            return begin
        hard = hard[hard < begin]
    return None


def _change(recording: Recording, scenes: Sequence[Scene], actor: str, lanes: LaneMap) -> int | None:
    if not lanes:
        return None
    if actor in recording.agents:  # with the last scene, in which it may just reach over
        after = recording.scenes()[-1]
        scenes = [*scenes, after] if actor in after.roster.index and after is not scenes[-1] else scenes
    place = lanes.change_began(scenes, actor)
    return None if place is None else min(place, len(scenes) - 2)
