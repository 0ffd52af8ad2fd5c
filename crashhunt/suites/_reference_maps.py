"""In which cases of a manoeuvre each model of a competent driver crashes, by equations of motion.

The controlled vehicle keeps its speed until the model brakes. First the speed changes, then the position by the new
speed. The other road users move as in the scenarios. A model watches every vehicle, and the strongest braking counts.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from crashhunt.agents import REFERENCE_MODELS, Situation
from crashhunt.world import START_M, actor_of_manoeuvre, manoeuvre_motions

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from crashhunt.trial import Value

    Values = NDArray[np.float64]

_LANE_M = 3.5
_WANDERING_M = 0.375  # from here on, a vehicle ahead shows what is ahead of it. Source: UN R157, table 1
_TIE_M = 1e-9
_KMH = 3.6
_OWN = actor_of_manoeuvre("ego")
# In cut-outs, R157 has the careful human react when the standing vehicle becomes visible, at any distance.
_REACTS_AT_ONCE = {("cut_out", "cc_human"): {"early_s": 1000.0}}


class ReferenceMaps:
    """The motions of all road users in some cases of a manoeuvre, and how each model would end.

    Args:
        manoeuvre: name of the manoeuvre.
        cases: arguments of the scenario in each case.
        steps: number of steps.
        step_s: step length, in s.
    """

    def __init__(self, manoeuvre: str, cases: Sequence[Mapping[str, Value]], *, steps: int, step_s: float) -> None:
        self._manoeuvre, self._step_s, self._count = manoeuvre, step_s, len(cases)
        self._speeds = np.array([float(case["ego_kmh"]) / _KMH for case in cases])
        self._own_y = 0.0
        found: dict[str, Values] = {}
        for number, case in enumerate(cases):
            values = {name: float(value) for name, value in case.items() if isinstance(value, int | float)}
            self._own_y, next_y = (0.0, _LANE_M) if values.get("side", -1.0) >= 0 else (_LANE_M, 0.0)
            states = manoeuvre_motions(manoeuvre, values, self._own_y, next_y, step_s)
            for step in range(steps):
                for name, state in next(states).items():
                    if name not in found:
                        found[name] = np.full((3, steps, self._count), np.nan)
                    found[name][:, step, number] = state.x, state.y - self._own_y, state.speed
        self._tracks, self._steps = found, steps

    def crashes(self, model: str) -> NDArray[np.bool_]:
        """Return whether the model crashes in each case."""
        more = _REACTS_AT_ONCE.get((self._manoeuvre, model), {})
        drivers = {name: REFERENCE_MODELS[model](self._count, self._step_s, **more) for name in self._tracks}
        before: dict[str, Values] = {}
        speed, front = self._speeds, np.full(self._count, START_M)
        crashed = np.zeros(self._count, bool)
        for step in range(self._steps):
            acceleration = np.zeros(self._count)
            for name, (xs, ys, speeds) in self._tracks.items():
                other = actor_of_manoeuvre(name)
                present = ~np.isnan(xs[step])
                gap = np.where(present, xs[step] - other.length - front, np.inf)
                side = np.where(present, np.abs(ys[step]) - (other.width + _OWN.width) / 2, np.inf)
                length = other.length + _OWN.length
                crashed |= (side < 0) & (gap <= 0) & (gap > -length)
                with np.errstate(invalid="ignore"):
                    towards = (before.get(name, side) - side) / self._step_s
                before[name] = side
                situation = Situation(
                    speed=speed,
                    other_speed=np.where(present, speeds[step], 0.0),
                    gap=gap,
                    lateral_gap=side,
                    lateral_speed=np.where(present, np.nan_to_num(np.maximum(0.0, towards), posinf=0.0), 0.0),
                    length=np.full(self._count, _OWN.length),
                    other_length=np.full(self._count, other.length),
                    visible=present & self._is_shown(name, step),
                )
                acceleration = np.minimum(acceleration, drivers[name].brake(situation))
            speed = np.where(crashed, 0.0, np.maximum(0.0, speed + acceleration * self._step_s))
            front = front + speed * self._step_s
        if self._manoeuvre == "cut_in":  # a risk that the model has classified as harmless
            crashed &= ~drivers["other"].dismissed
        return crashed

    def _is_shown(self, name: str, step: int) -> NDArray[np.bool_]:
        """Return whether no vehicle ahead hides a standing vehicle."""
        if name != "standing" or "leader" not in self._tracks:
            return np.ones(self._count, bool)
        _, ys, speeds = self._tracks["leader"]
        shown: NDArray[np.bool_] = (np.abs(ys[step]) >= _WANDERING_M - _TIE_M) | (speeds[step] <= 0)
        return shown
