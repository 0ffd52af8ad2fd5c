"""The models of a competent driver in UN R157 and in the literature, for many situations at once.

A model receives what its driver sees of one other vehicle, and returns the acceleration of its own vehicle. The same
code drives in a simulator, judges crashes, and answers the cases of `crashhunt.testing.r157`. All quantities are arrays
with one element per situation, in m, s, m/s and m/s².

Sources:

- R157: UN Regulation 157 (ALKS). Original series: Annex 4, appendix 3. 01 series: Annex 3.
- FSM: Mattas et al.: Fuzzy Surrogate Safety Metrics for real-time assessment of rear-end collision risk. Accident
  Analysis and Prevention 148 (2020), 105794. The same model is performance model 2 of R157, 01 series, Annex 3.
- RSS: Shalev-Shwartz, Shammah, Shashua: On a Formal Model of Safe and Scalable Self-driving Cars (2017),
  arXiv:1708.06374.
- Comparison of the four models, with the parameters that R157 does not define. Mattas et al.: Driver models for the
  definition of safety requirements of automated vehicles in international regulations. Accident Analysis and Prevention
  174 (2022), 106743.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    Values = NDArray[np.float64]
    Flags = NDArray[np.bool_]

GRAVITY_MPS2 = 9.81
MAX_BRAKING_MPS2 = 0.774 * GRAVITY_MPS2
"""Deceleration of the competent driver in an emergency. Source: R157, table 1 of performance model 1."""
BRAKING_JERK_MPS3 = 12.65
"""0.774 g is reached after 0.6 s. Source: R157, table 1 of performance model 1."""
REACTION_S = 0.75
"""Time from the end of the perception of a risk to the beginning of the deceleration. Source: R157, table 1."""
_STEP_TOLERANCE = 1e-9  # of a step: a time that is a whole number of steps is not rounded up
_SLOWING_MPS2 = 0.5  # a smaller deceleration of the vehicle ahead is not noticed
_TIE_M = 1e-9  # rounding errors of lateral gaps are smaller


@dataclass(frozen=True, slots=True, kw_only=True)
class Situation:
    """What a driver sees of the other vehicle before a step.

    Args:
        speed: speed of the driver's own vehicle, in m/s.
        other_speed: speed of the other vehicle along the road, in m/s.
        gap: distance from the front of the own vehicle to the rear of the other vehicle, in m; negative from the moment
            at which the front has passed the rear.
        lateral_gap: distance between the sides of the vehicles, in m; negative if one is in the path of the other.
        lateral_speed: speed of the other vehicle towards the own vehicle, in m/s.
        length: length of the own vehicle, in m.
        other_length: length of the other vehicle, in m.
        visible: whether the driver sees the other vehicle.
    """

    speed: Values
    other_speed: Values
    gap: Values
    lateral_gap: Values
    lateral_speed: Values
    length: Values
    other_length: Values
    visible: Flags

    @property
    def closing_speed(self) -> Values:
        """Speed at which the gap shrinks, in m/s."""
        closing: Values = self.speed - self.other_speed
        return closing

    @property
    def is_ahead(self) -> Flags:
        """Whether the driver sees the other vehicle and the own front has not passed the other front."""
        return self.visible & (self.gap > -self.other_length)


class ReferenceModel(Protocol):
    """A model of a competent driver for some number of situations at a time."""

    def brake(self, situation: Situation) -> Values:
        """Return the acceleration for the next step, in m/s²; 0 keeps the speed.

        Args:
            situation: what the driver sees now.
        """

    @property
    def perceived(self) -> Flags:
        """Whether the driver considers the situation a risk."""

    @property
    def dismissed(self) -> Flags:
        """Whether the driver has classified the cut-in as no risk, because it happens far enough ahead."""

    def following_distance(self, speed: Values) -> Values:
        """Return the gap that the driver keeps to a vehicle ahead that has the same speed, in m."""


class _Delay:
    """Counts the steps since a risk is present."""

    def __init__(self, count: int, reaction_s: float, step_length_s: float) -> None:
        self._steps = math.ceil(reaction_s / step_length_s - _STEP_TOLERANCE)
        self._waited = np.full(count, -1)

    @property
    def present(self) -> Flags:
        """Whether the risk is present."""
        return self._waited >= 0

    def update(self, risk: Flags) -> Flags:
        """Return in which situations the reaction time has passed since the beginning of the risk."""
        self._waited = np.where(risk, self._waited + 1, -1)
        return self._waited >= self._steps


class _Model:
    """The parts that the models share: parameters of the reaction, and the pedal.

    Args:
        count: number of situations.
        step_length_s: time from one step to the next, in s.
        reaction_s: time from the risk to the beginning of the deceleration, in s.
        max_brake: greatest deceleration, in m/s².
        jerk: greatest change of the acceleration, in m/s³.
    """

    def __init__(self, count: int, step_length_s: float, *, reaction_s: float, max_brake: float, jerk: float) -> None:
        self._step_length_s = step_length_s
        self._max_brake, self._jerk = max_brake, jerk
        self._delay = _Delay(count, reaction_s, step_length_s)
        self._acceleration = np.zeros(count)

    @property
    def perceived(self) -> Flags:
        """Whether the driver considers the situation a risk."""
        return self._delay.present

    @property
    def dismissed(self) -> Flags:
        """Whether the driver has classified the cut-in as no risk."""
        return np.zeros(len(self._acceleration), bool)

    def _approach(self, wanted: Values) -> Values:
        """Return the acceleration after one step on the way to a wanted acceleration."""
        most = self._jerk * self._step_length_s
        wanted = np.maximum(wanted, -self._max_brake)
        self._acceleration = np.clip(wanted, self._acceleration - most, self._acceleration + most)
        return self._acceleration


class CarefulHuman(_Model):
    """The competent and careful human driver of R157: performance model 1, named ``cc_human``.

    The driver perceives a cut-in when the other vehicle has entered the path of the own vehicle. This point follows the
    published comparison of the models. R157 requires the perception 0.375 m (wandering in the lane) and 0.4 s after the
    other vehicle leaves the middle of its lane. A vehicle that cuts in at 1.8 m/s or less has then moved 0.72 m more.
    The driver then lifts the foot, which decelerates the vehicle with `lift`. `reaction_s` later, the driver brakes
    until 0.774 g, which takes 0.6 s. A cut-in with a time to collision (TTC) above `ttc_s` is no risk by R157:

        TTC = gap / closing speed

    R157 does not say when the driver reacts to a slower vehicle that is in the path already. It is perceived as a risk
    if the time gap is at most `headway_s`, which is the boundary of the deceleration scenario. It is also perceived
    `early_s` before the last moment at which braking with `max_brake` equals the speeds in time:

        gap <= headway_s · own speed, or gap <= early_s · closing speed + closing speed² / (2 · max_brake)

    The driver brakes while the other vehicle is slower or slows down, and does not need another reaction time while the
    time gap is at most `headway_s`.

    Args:
        count: number of situations.
        step_length_s: time from one step to the next, in s.
        reaction_s: time from the perception to the beginning of the braking, in s. Source: R157, table 1.
        max_brake: greatest deceleration, in m/s². Source: R157, table 1 (0.774 g).
        jerk: change of the acceleration, in m/s³. Source: R157, table 1 (0.774 g after 0.6 s).
        lift: deceleration while the driver moves the foot, in m/s². Source: an assumption of the comparison.
        ttc_s: greatest TTC of a risk, in s. Source: R157, data sheets of cut-in.
        headway_s: time gap to a vehicle ahead, in s. Source: R157, data sheets of cut-out and deceleration.
        early_s: time between the perception of a slower vehicle in the path and the last moment to brake, in s. Source:
            ours, equal to the TTC of a risk.
    """

    def __init__(
        self,
        count: int,
        step_length_s: float,
        *,
        reaction_s: float = REACTION_S,
        max_brake: float = MAX_BRAKING_MPS2,
        jerk: float = BRAKING_JERK_MPS3,
        lift: float = 0.4,
        ttc_s: float = 2.0,
        headway_s: float = 2.0,
        early_s: float = 2.0,
    ) -> None:
        super().__init__(count, step_length_s, reaction_s=reaction_s, max_brake=max_brake, jerk=jerk)
        self._lift, self._ttc_s, self._headway_s, self._early_s = lift, ttc_s, headway_s, early_s
        self._dismissed = np.zeros(count, bool)
        self._entered = np.zeros(count, bool)
        self._other_speed = np.zeros(count)

    @property
    def dismissed(self) -> Flags:
        """Whether the TTC was above `ttc_s` when the other vehicle entered the path."""
        return self._dismissed

    def brake(self, situation: Situation) -> Values:
        """Return the acceleration for the next step, in m/s²."""
        in_path = situation.visible & (situation.lateral_gap <= _TIE_M)
        enters = in_path & ~self._entered
        self._entered = self._entered | in_path
        closing, gap = situation.closing_speed, situation.gap
        # Without division: the TTC is above the limit if the gap is greater than the limit times the closing speed.
        self._dismissed = self._dismissed | (enters & (situation.lateral_speed > 0) & (gap > self._ttc_s * closing))
        follows = gap <= self._headway_s * situation.speed
        near = follows | (gap <= self._early_s * closing + closing * closing / (2 * self._max_brake))
        slows = situation.other_speed < self._other_speed - _SLOWING_MPS2 * self._step_length_s
        self._other_speed = situation.other_speed
        is_risk = np.where(closing > 0, near | self._delay.present, (follows | slows) & self._delay.present)
        reacts = self._delay.update(in_path & (gap > 0) & is_risk)
        braked = np.maximum(self._acceleration - self._jerk * self._step_length_s, -self._max_brake)
        lifted = np.where(self._delay.present & ~reacts, -self._lift, 0.0)
        self._acceleration = np.where(reacts & ((closing > 0) | slows), braked, lifted)
        return self._acceleration

    def following_distance(self, speed: Values) -> Values:
        """Return the gap at a headway of `headway_s`."""
        gap: Values = self._headway_s * speed
        return gap


class FuzzySafety(_Model):
    """The fuzzy safety model of Mattas et al., named ``fsm``: performance model 2 of R157, 01 series.

    With the speeds u (own) and v (other), the gap d, the reaction time t, comfortable and maximum braking c and m, and
    maximum braking of the other vehicle o:

    The driver reacts if the other vehicle may enter the path before the own vehicle has passed:

        lateral gap / lateral speed < (d + lengths of both vehicles) / (u - v) + 0.1 s

    PFS (proactive fuzzy surrogate) is 0 above ``safe``, 1 below ``unsafe``, and linear between. The gap is d - margin::

        safe = u t + u² / 2c - v² / 2o + margin
        unsafe = u t + u² / 2m - v² / 2o

    CFS (critical fuzzy surrogate) is 0 if u <= v. Otherwise it is computed in the same way from the gap d::

        a = max(own acceleration, -c)
        w = u + a t
        n = ((u + w) / 2 - v) t
        safe = n + (w - v)² / 2c if w > v, otherwise (u - v)² / 2|a|
        unsafe = n + (w - v)² / 2m if w > v, otherwise (u - v)² / 2|a|

    The driver brakes with CFS (m - c) + c if CFS > 0, otherwise with PFS c.

    Args:
        count: number of situations.
        step_length_s: time from one step to the next, in s.
        reaction_s: reaction time, in s. Source: FSM and R157.
        comfort: comfortable deceleration, in m/s². Source: FSM.
        max_brake: greatest deceleration that the model asks for, in m/s². Source: FSM.
        other_brake: greatest deceleration of the other vehicle, in m/s². Source: FSM.
        margin: gap at standstill, in m. Source: FSM.
        limit: greatest deceleration that the vehicle reaches, in m/s². Source: R157, table 1.
        jerk: greatest change of the acceleration, in m/s³. Source: R157, table 1.
    """

    _LATERAL_MARGIN_S = 0.1

    def __init__(
        self,
        count: int,
        step_length_s: float,
        *,
        reaction_s: float = REACTION_S,
        comfort: float = 4.0,
        max_brake: float = 6.0,
        other_brake: float = 7.0,
        margin: float = 2.0,
        limit: float = MAX_BRAKING_MPS2,
        jerk: float = BRAKING_JERK_MPS3,
    ) -> None:
        super().__init__(count, step_length_s, reaction_s=reaction_s, max_brake=limit, jerk=jerk)
        self._reaction_s, self._comfort, self._hardest = reaction_s, comfort, max_brake
        self._other_brake, self._margin = other_brake, margin

    def brake(self, situation: Situation) -> Values:
        """Return the acceleration for the next step, in m/s²."""
        critical = self._critical(situation)
        wanted = np.where(
            critical > 0,
            critical * (self._hardest - self._comfort) + self._comfort,
            self._proactive(situation) * self._comfort,
        )
        wanted = np.where(self._may_meet(situation), wanted, 0.0)
        return self._approach(np.where(self._delay.update(wanted > 0), -wanted, 0.0))

    def following_distance(self, speed: Values) -> Values:
        """Return the gap from which on PFS is 0."""
        gap: Values = self._safe(speed, speed, self._comfort) + 2 * self._margin
        return gap

    def _safe(self, speed: Values, other_speed: Values, braking: float) -> Values:
        safe: Values = (
            speed * self._reaction_s
            + speed * speed / (2 * braking)
            - other_speed * other_speed / (2 * self._other_brake)
        )
        return safe

    def _proactive(self, situation: Situation) -> Values:
        safe = self._safe(situation.speed, situation.other_speed, self._comfort) + self._margin
        unsafe = self._safe(situation.speed, situation.other_speed, self._hardest)
        return _share_between(situation.gap - self._margin, safe, unsafe)

    def _critical(self, situation: Situation) -> Values:
        speed, closing = situation.speed, situation.closing_speed
        braking = np.maximum(self._acceleration, -self._comfort)
        later = speed + braking * self._reaction_s
        nearer = ((speed + later) / 2 - situation.other_speed) * self._reaction_s
        left = later - situation.other_speed
        with np.errstate(divide="ignore", invalid="ignore"):
            stops = closing * closing / np.abs(2 * braking)
        safe = np.where(left <= 0, stops, nearer + left * left / (2 * self._comfort))
        unsafe = np.where(left <= 0, stops, nearer + left * left / (2 * self._hardest))
        return np.where(closing > 0, _share_between(situation.gap, safe, unsafe), 0.0)

    def _may_meet(self, situation: Situation) -> Flags:
        closing, lateral = situation.closing_speed, np.maximum(situation.lateral_gap, 0.0)
        passing = situation.gap + situation.length + situation.other_length
        with np.errstate(divide="ignore", invalid="ignore"):
            meets_s = np.where(
                lateral <= 0, 0.0, np.where(situation.lateral_speed > 0, lateral / situation.lateral_speed, np.inf)
            )
            passed_s = passing / closing + self._LATERAL_MARGIN_S
        return situation.is_ahead & (closing > 0) & (meets_s < passed_s)


def _share_between(value: Values, safe: Values, unsafe: Values) -> Values:
    """Return 0 from ``safe`` on, 1 below ``unsafe``, and linear values between."""
    with np.errstate(divide="ignore", invalid="ignore"):
        between = (value - safe) / (unsafe - safe)
    return np.where(value < unsafe, 1.0, np.where(value >= safe, 0.0, between))


class SafetyRules(_Model):
    """A driver who brakes as Responsibility-Sensitive Safety requires, named ``rss``.

    The situation is dangerous if the gap and the lateral gap are both shorter than the safe distances of definitions 1
    and 6 of the paper. The speeds are u (own), v (other) and w (other, across the road). The response time is t. The
    acceleration and the deceleration are a and b along the road, and e and f across the road::

        safe gap = u t + a t² / 2 + (u + a t)² / 2b - v² / 2b
        safe lateral gap = margin + (2 w + e t) t / 2 + (w + e t)² / 2f

    After the response time, the driver brakes with `limit`, until the situation is no longer dangerous.

    Args:
        count: number of situations.
        step_length_s: time from one step to the next, in s.
        response_s: response time, in s. Source: the comparison, as the reaction time of R157.
        acceleration: acceleration during the response time, in m/s². Source: the comparison.
        braking: deceleration of both vehicles in the safe gap, in m/s². Source: the comparison.
        lateral_acceleration: acceleration and deceleration across the road, in m/s². Source: the comparison.
        lateral_margin: lateral margin, in m. Source: the comparison.
        limit: greatest deceleration that the vehicle reaches, in m/s². Source: R157, table 1.
        jerk: greatest change of the acceleration, in m/s³. Source: R157, table 1.
    """

    def __init__(
        self,
        count: int,
        step_length_s: float,
        *,
        response_s: float = REACTION_S,
        acceleration: float = 3.0,
        braking: float = 6.0,
        lateral_acceleration: float = 1.0,
        lateral_margin: float = 0.3,
        limit: float = MAX_BRAKING_MPS2,
        jerk: float = BRAKING_JERK_MPS3,
    ) -> None:
        super().__init__(count, step_length_s, reaction_s=response_s, max_brake=limit, jerk=jerk)
        self._response_s, self._gain, self._braking = response_s, acceleration, braking
        self._lateral, self._lateral_margin = lateral_acceleration, lateral_margin

    def brake(self, situation: Situation) -> Values:
        """Return the acceleration for the next step, in m/s²."""
        other = situation.other_speed
        near = situation.gap < np.maximum(0.0, self._driven(situation.speed) - other * other / (2 * self._braking))
        danger = situation.is_ahead & near & (situation.lateral_gap < self._safe_lateral(situation.lateral_speed))
        return self._approach(np.where(self._delay.update(danger), -self._max_brake, 0.0))

    def following_distance(self, speed: Values) -> Values:
        """Return the safe gap if the other vehicle, too, brakes after the response time only.

        The other vehicle's way in the response time is t² b / 2 shorter than at a constant speed::

            u t + (a + b) t² / 2 + (u + a t)² / 2b - max(0, u - b t)² / 2b
        """
        response = self._response_s
        later = np.maximum(0.0, speed - self._braking * response)
        gap: Values = (
            self._driven(speed) + self._braking * response * response / 2 - later * later / (2 * self._braking)
        )
        return gap

    def _driven(self, speed: Values) -> Values:
        """Return the way until standstill, in m."""
        later = speed + self._gain * self._response_s
        driven: Values = (
            speed * self._response_s
            + self._gain * self._response_s * self._response_s / 2
            + later * later / (2 * self._braking)
        )
        return driven

    def _safe_lateral(self, speed: Values) -> Values:
        later = speed + self._lateral * self._response_s
        gap: Values = (
            self._lateral_margin + (speed + later) / 2 * self._response_s + later * later / (2 * self._lateral)
        )
        return gap


class Regulation(_Model):
    """The requirement for cut-ins of R157, paragraph 5.2.5.2, as a driver, named ``reg157``.

    A collision must be avoided if, when the front tyre of the other vehicle is 0.3 m inside the lane,

        TTC > closing speed / (2 · 6 m/s²) + 0.35 s

    A driver who brakes with 6 m/s² 0.35 s after this moment avoids exactly these collisions. In lanes of 3.5 m with
    vehicles of 1.9 m, the lateral gap is then 0.5 m. The requirement applies to vehicles that move into the lane ahead.
    The driver brakes while its front has not passed the middle of the other vehicle, until both are equally fast.

    Args:
        count: number of situations.
        step_length_s: time from one step to the next, in s.
        reaction_s: reaction time, in s. Source: R157, 5.2.5.2.
        max_brake: deceleration, in m/s², which is reached at once. Source: R157, 5.2.5.2.
        lateral_gap: lateral gap at which the other vehicle has entered the lane, in m. Source: R157, 5.2.5.2.
    """

    def __init__(
        self,
        count: int,
        step_length_s: float,
        *,
        reaction_s: float = 0.35,
        max_brake: float = 6.0,
        lateral_gap: float = 0.5,
    ) -> None:
        super().__init__(count, step_length_s, reaction_s=reaction_s, max_brake=max_brake, jerk=math.inf)
        self._lateral_gap = lateral_gap
        self._entered = np.zeros(count, bool)

    def brake(self, situation: Situation) -> Values:
        """Return the acceleration for the next step, in m/s²."""
        closing = situation.closing_speed > 0
        inside = situation.lateral_gap <= self._lateral_gap + _TIE_M
        self._entered = self._entered | (situation.visible & inside & closing & (situation.gap > 0))
        reacts = self._delay.update(self._entered)
        brakes = reacts & closing & (situation.gap > -situation.other_length / 2)
        self._acceleration = np.where(brakes, -self._max_brake, 0.0)
        return self._acceleration

    def following_distance(self, speed: Values) -> Values:
        """Return the least gap of R157, 5.2.3.3, for cars: the speed times a time gap that grows with the speed."""
        headways_s = np.interp(speed * 3.6, _LEAST_HEADWAYS_KMH, _LEAST_HEADWAYS_S)
        return np.maximum(_LEAST_GAP_M, speed * headways_s)


_LEAST_HEADWAYS_KMH = (7.2, 10.0, 20.0, 30.0, 40.0, 50.0, 60.0)
_LEAST_HEADWAYS_S = (1.0, 1.1, 1.2, 1.3, 1.4, 1.5, 1.6)
_LEAST_GAP_M = 2.0

REFERENCE_MODELS: Mapping[str, type[CarefulHuman | FuzzySafety | SafetyRules | Regulation]] = {
    "cc_human": CarefulHuman,
    "fsm": FuzzySafety,
    "rss": SafetyRules,
    "reg157": Regulation,
}
"""The models by the names that commands and arguments use."""
