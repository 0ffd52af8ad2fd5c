"""Traffic rules as ready requirements, each with its source.

Sources: S. Maierhofer, A.-K. Rettinger, E. C. Mayer and M. Althoff, "Formalization of Interstate Traffic Rules in
Temporal Logic", IV 2020 (rules R_G1 to R_G3 and R_I1); S. Maierhofer, P. Moosbrugger and M. Althoff, "Formalization of
Intersection Traffic Rules in Temporal Logic", IV 2022 (traffic lights and priority). The formulas follow the structure
of these rules with the signals of crashhunt. Where a rule was changed, its entry says how. Its limits, such as a
deceleration of 10 m/s² or a reaction time of 0.3 s, are choices of crashhunt.
"""

from __future__ import annotations

from dataclasses import dataclass

_INTERSTATE, _INTERSECTION = "Maierhofer et al. 2020", "Maierhofer et al. 2022"

# The gap in which both vehicles brake with 10 m/s², the rear one after 0.3 s.
_SAFE = "gap_m >= (speed * speed - leader_speed * leader_speed) / 20 + 0.3 * speed"


@dataclass(frozen=True, slots=True)
class TrafficRule:
    """A requirement that ``--require`` accepts by name."""

    name: str  # name for ``--require``
    title: str  # what the rule requires, in a sentence
    source: str  # publication and rule, and how the formula differs from it
    formula: str  # formula of the requirement


TRAFFIC_RULES = {
    rule.name: rule
    for rule in (
        TrafficRule(
            name="safe-distance",
            title=(
                "Keep the distance in which both vehicles can stop, except for 3 s after the vehicle ahead has changed."
            ),
            source=(
                f"{_INTERSTATE}, R_G1, with 10 m/s² and a reaction time of 0.3 s. A lane change of ego "
                "counts as a cut-in."
            ),
            formula=f"always (once[0:3] leader_changed or {_SAFE})",
        ),
        TrafficRule(
            name="unnecessary-braking",
            title="Do not brake harder than 2 m/s² without a reason.",
            source=(
                f"{_INTERSTATE}, R_G2: a vehicle ahead that is too near or brakes, too. Added: a red light, "
                "and priority."
            ),
            formula=(
                f"always (acceleration < -2 -> not ({_SAFE}) or acceleration - leader_acceleration >= -2 "
                "or red_light_m < 100 or priority_m < 100)"
            ),
        ),
        TrafficRule(
            name="maximum-speed",
            title="Do not drive faster than the speed limit of the lane.",
            source=f"{_INTERSTATE}, R_G3: the limit of the lane only. A tolerance of 0.01 m/s is added.",
            formula="always (speed <= speed_limit + 0.01)",
        ),
        TrafficRule(
            name="no-stopping",
            title="Do not stop without a reason.",
            source=(
                f"{_INTERSTATE}, R_I1: a slow vehicle ahead. Added: a red light, priority of others, a start at rest."
            ),
            formula=(
                "always (once (speed > 1) and speed < 0.1 -> (gap_m < 20 and leader_speed < 5) or red_light_m < 20 "
                "or priority_m < 20)"
            ),
        ),
        TrafficRule(
            name="right-of-way",
            title="Do not be in the path of an actor with the right of way that arrives within 1 s.",
            source=f"{_INTERSECTION}, priority: the arrival within a time replaces the braking of the other actor.",
            formula="always (priority_arrival_s > 1)",
        ),
        TrafficRule(
            name="red-light",
            title="Do not pass the stop line while the light is red.",
            source=f"{_INTERSECTION}, traffic lights: the event red_light of crashhunt.",
            formula="always (not red_light)",
        ),
    )
}
"""The rules by name."""
