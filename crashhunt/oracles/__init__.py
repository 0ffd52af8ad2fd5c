"""Oracles: whether a step is a crash, and how near to one it came."""

from crashhunt.oracles._approach import ApproachMeter, approaches, closest_approach
from crashhunt.oracles._contact import Touch, first_contact
from crashhunt.oracles._crashes import OffRoad, Overlap, ReportedCollision
from crashhunt.oracles._events import TrafficEvents
from crashhunt.oracles._geometry import outlines_overlap, rectangle_gap, time_to_contact
from crashhunt.oracles._protocol import Finding, Oracle, merge_findings

__all__ = [
    "ApproachMeter",
    "Finding",
    "OffRoad",
    "Oracle",
    "Overlap",
    "ReportedCollision",
    "Touch",
    "TrafficEvents",
    "approaches",
    "closest_approach",
    "first_contact",
    "merge_findings",
    "outlines_overlap",
    "rectangle_gap",
    "time_to_contact",
]
