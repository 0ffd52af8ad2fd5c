"""A crash as a CommonRoad scenario, version 2020a: https://commonroad.in.tum.de."""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING
from xml.etree import ElementTree as ET

from crashhunt.base.version import __version__
from crashhunt.formats._recorded import recorded_of
from crashhunt.formats._xml import add, comment, number, plain_text, write_xml
from crashhunt.world import is_person

if TYPE_CHECKING:
    from pathlib import Path

    from crashhunt.crashes import Bundle
    from crashhunt.formats._recorded import Pose, RecordedCrash, RecordedPath, Road

_TYPES = {
    "taxi": "taxi", "bus": "bus", "coach": "bus", "truck": "truck", "trailer": "truck", "bicycle": "bicycle",
    "motorcycle": "motorcycle", "moped": "motorcycle", "pedestrian": "pedestrian", "emergency": "priorityVehicle",
    "tram": "train", "rail": "train", "rail_urban": "train", "rail_electric": "train", "rail_fast": "train",
    "subway": "train", "passenger": "car", "private": "car", "evehicle": "car", "hov": "car", "delivery": "car",
}  # fmt: skip
_UNKNOWN_LOCATION = {"geoNameId": "-999", "gpsLatitude": "999", "gpsLongitude": "999"}  # how the format says "unknown"


def write_commonroad(bundle: Bundle, target: Path, *, with_agents: bool = False) -> dict[str, list[int]]:
    """Write a crash as a CommonRoad scenario of version 2020a; the file is never incomplete.

    Lengths are in m, angles in rad, speeds in m/s, times in steps of ``timeStepSize`` s; step 0 is before the first
    step. A position is the centre of a vehicle. Each lane that the agent came near is a lanelet; the order of lanelets
    follows from the shapes. Every other actor is a dynamic obstacle from the step in which it was first seen. Each
    agent is a planning problem, which consists of its start and the goal of still driving at the end of the recording.
    A planner that avoids the crash solves the planning problem. The yaw rate is that of the first step. The slip angle
    is unknown and written as 0. An existing file is replaced. With ``with_agents``, the recorded paths of the agents
    are obstacles as well.

    Returns:
        The number of each actor in the file, including planning problems.

    Raises:
        BundleError: the crash has no recorded actors or lanes, or its log is damaged.
        HuntDirectoryError: the file cannot be written.
    """
    recorded = recorded_of(bundle)
    root = _root(recorded)
    for index, road in enumerate(recorded.roads):
        _add_lanelet(root, index, road)
    numbers: dict[str, list[int]] = {}
    ways = (*recorded.agents, *recorded.others) if with_agents else recorded.others
    first = len(recorded.roads) + 1
    for index, way in enumerate(ways, first):
        comment(root, way.path.actor.id)
        _add_obstacle(root, index, way)
        numbers.setdefault(way.path.actor.id, []).append(index)
    starts = {way.path.actor.id: way for way in reversed(recorded.agents)}  # of one who came back, the first
    for index, (agent, way) in enumerate(reversed(starts.items()), first + len(ways)):
        comment(root, agent)
        _add_problem(root, index, way, recorded)
        numbers.setdefault(agent, []).append(index)
    write_xml(root, target)
    return numbers


def _root(recorded: RecordedCrash) -> ET.Element:
    together = "C-" if len({way.path.actor.id for way in recorded.agents}) > 1 else ""
    root = ET.Element(
        "commonRoad",
        {
            "commonRoadVersion": "2020a",
            "benchmarkID": f"{together}ZAM_Crashhunt-1_{recorded.number + 1}_T-1",  # ZAM: no country that there is
            "date": time.strftime("%Y-%m-%d", time.gmtime()),
            "author": f"crashhunt {__version__}",
            "affiliation": "",
            "source": plain_text(recorded.title),
            "timeStepSize": number(recorded.step_length_s),
        },
    )
    location = add(root, "location")
    for tag, text in _UNKNOWN_LOCATION.items():
        add(location, tag, text)
    tags = add(root, "scenarioTags")
    for tag in ("critical", "simulated"):
        add(tags, tag)
    return root


def _add_lanelet(root: ET.Element, index: int, road: Road) -> None:
    lanelet = add(root, "lanelet", id=str(index + 1))
    for tag, border in (("leftBound", road.left), ("rightBound", road.right)):
        bound = add(lanelet, tag)
        for x, y in border.tolist():
            _add_point(bound, x, y)
    for tag, ends in (("predecessor", road.before), ("successor", road.after)):
        for other in ends:
            add(lanelet, tag, ref=str(other + 1))
    add(lanelet, "laneletType", "unknown")


def _add_obstacle(root: ET.Element, index: int, way: RecordedPath) -> None:
    obstacle = add(root, "dynamicObstacle", id=str(index))
    actor = way.path.actor
    add(obstacle, "type", "pedestrian" if is_person(actor.id) else _type(actor.kind))
    rectangle = add(add(obstacle, "shape"), "rectangle")
    add(rectangle, "length", number(actor.length))
    add(rectangle, "width", number(actor.width))
    first, *rest = way.poses
    _add_state(obstacle, "initialState", first)
    if rest:  # else it was seen once, and the format has no trajectory of no states
        trajectory = add(obstacle, "trajectory")
        for pose in rest:
            _add_state(trajectory, "state", pose)


def _add_problem(root: ET.Element, index: int, way: RecordedPath, recorded: RecordedCrash) -> None:
    problem = add(root, "planningProblem", id=str(index))
    first, *rest = way.poses
    state = _add_state(problem, "initialState", first)
    turned = math.remainder(rest[0].heading - first.heading, math.tau) if rest else 0.0
    _add_exact(state, "yawRate", number(turned / recorded.step_length_s))
    _add_exact(state, "slipAngle", "0.0")
    when = add(add(problem, "goalState"), "time")
    last = str(max(1, recorded.steps))  # the format wants an end above 0
    add(when, "intervalStart", last)
    add(when, "intervalEnd", last)


def _type(kind: str) -> str:
    """Return the format's word for a class of actor; highway-env names its cars after their driver model."""
    return _TYPES.get(kind) or ("car" if kind.endswith("Vehicle") else "unknown")


def _add_state(parent: ET.Element, tag: str, pose: Pose) -> ET.Element:
    state = add(parent, tag)
    _add_point(add(state, "position"), pose.x, pose.y)
    _add_exact(state, "orientation", number(pose.heading))
    _add_exact(state, "time", str(pose.step))
    _add_exact(state, "velocity", number(pose.speed))
    return state


def _add_point(parent: ET.Element, x: float, y: float) -> None:
    point = add(parent, "point")
    add(point, "x", number(x))
    add(point, "y", number(y))


def _add_exact(state: ET.Element, tag: str, text: str) -> None:
    add(add(state, tag), "exact", text)
