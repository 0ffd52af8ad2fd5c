"""A crash as a scenario in OpenSCENARIO 1.0 (XML), with its roads in OpenDRIVE: https://www.asam.net."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING
from xml.etree import ElementTree as ET

from crashhunt.base.version import __version__
from crashhunt.formats._opendrive import opendrive_of
from crashhunt.formats._recorded import recorded_of
from crashhunt.formats._xml import add, number, plain_text, write_xml
from crashhunt.world import is_person

if TYPE_CHECKING:
    from pathlib import Path

    from crashhunt.crashes import Bundle
    from crashhunt.formats._recorded import Pose, Recorded, Way

__all__ = ["write_openscenario"]

_CATEGORIES = {
    "bus": "bus", "coach": "bus", "truck": "truck", "trailer": "semitrailer", "delivery": "van", "tram": "tram",
    "bicycle": "bicycle", "motorcycle": "motorbike", "moped": "motorbike", "rail": "train", "rail_urban": "train",
    "rail_electric": "train", "rail_fast": "train", "subway": "train",
}  # fmt: skip
_NO_LIMIT = "100"  # of speed and acceleration, which the format wants: nobody is to be held back on a recorded way
_HEIGHT_M = 1.5  # where none was recorded
_AXLES = 0.6  # of the length, from one axle to the other


def write_openscenario(bundle: Bundle, target: Path, *, with_agents: bool = False) -> dict[str, list[str]]:
    """Write a crash in OpenSCENARIO 1.0, and beside it its roads in OpenDRIVE 1.6, each all of it or nothing.

    Lengths are in m, angles in rad, speeds in m/s, times in s, 0 before the first recorded step. Everybody follows the
    recorded way, a vertex for each step at its time, from when it was first seen until it was last seen. The reference
    point of a vehicle is its middle, and there its rear axle is said to be: nobody has recorded where that is, and an
    axle behind the point of reference has esmini shift the vehicle ahead. Performance, axles and a height that was not
    recorded are made up.

    Args:
        bundle: the crash.
        target: the scenario, ``….xosc``; the roads are in ``….xodr``. What is there is replaced.
        with_agents: whether the agents follow their recorded ways, too; else they are placed where they began, with the
            speed that they had, for whatever is to drive them.

    Returns:
        The names under which each actor is in the file.

    Raises:
        BundleError: there is nothing that could be written, or it is damaged.
        HuntDirectoryError: a file cannot be written.
    """
    recorded = recorded_of(bundle)
    free = {} if with_agents else {way.path.actor.id: way for way in reversed(recorded.agents)}
    agents = recorded.agents if with_agents else tuple(reversed(free.values()))
    roads = target.with_suffix(".xodr")
    root = _root(recorded, roads.name)
    ways = (*agents, *recorded.others)
    entities = add(root, "Entities")
    board = add(root, "Storyboard")
    actions = add(add(board, "Init"), "Actions")
    act = add(
        add(
            board,
            "Story",
            name="recorded",
        ),
        "Act",
        name="recorded",
    )
    names: dict[str, list[str]] = {}
    for way in ways:
        names.setdefault(way.path.actor.id, []).append(way.name)
        _add_entity(entities, way)
        _add_start(actions, way)
        _add_story(act, way, recorded, drives=way.path.actor.id not in free)
    # The format wants what is global first.
    actions[:] = sorted(actions, key=lambda action: action.tag != "GlobalAction")
    _add_trigger(act, "StartTrigger", -recorded.step_length_s / 2)
    _add_trigger(board, "StopTrigger", (recorded.steps + 0.5) * recorded.step_length_s)
    write_xml(opendrive_of(recorded), roads)
    write_xml(root, target)
    return names


def _root(recorded: Recorded, roads: str) -> ET.Element:
    root = ET.Element("OpenSCENARIO")
    add(
        root, "FileHeader", revMajor="1", revMinor="0", date=time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime()),
        description=plain_text(recorded.title), author=f"crashhunt {__version__}",
    )  # fmt: skip
    add(root, "ParameterDeclarations")
    add(root, "CatalogLocations")
    add(add(root, "RoadNetwork"), "LogicFile", filepath=plain_text(roads))
    return root


def _add_entity(entities: ET.Element, way: Way) -> None:
    entity, actor = add(entities, "ScenarioObject", name=way.name), way.path.actor
    if is_person(actor.id) or actor.kind == "pedestrian":
        thing = add(entity, "Pedestrian", name=way.name, model=way.name, mass="80", pedestrianCategory="pedestrian")
    else:
        thing = add(entity, "Vehicle", name=way.name, vehicleCategory=_CATEGORIES.get(actor.kind, "car"))
    height = actor.height or _HEIGHT_M
    box = add(thing, "BoundingBox")
    add(box, "Center", x="0", y="0", z=number(height / 2))
    add(box, "Dimensions", width=number(actor.width), length=number(actor.length), height=number(height))
    if thing.tag == "Vehicle":
        add(thing, "Performance", maxSpeed=_NO_LIMIT, maxAcceleration=_NO_LIMIT, maxDeceleration=_NO_LIMIT)
        axles = add(thing, "Axles")
        for tag, ahead in (
            ("FrontAxle", _AXLES),
            ("RearAxle", 0.0),
        ):  # whoever reads it takes the rear one for the middle
            add(
                axles, tag, maxSteering="0.5", wheelDiameter="0.6", trackWidth=number(actor.width),
                positionX=number(ahead * actor.length), positionZ="0.3",
            )  # fmt: skip
    add(thing, "Properties")


def _add_start(actions: ET.Element, way: Way) -> None:
    first = way.poses[0]
    if way.path.first:  # whoever comes later is not there yet
        add(add(add(actions, "GlobalAction"), "EntityAction", entityRef=way.name), "DeleteEntityAction")
        return
    private = add(actions, "Private", entityRef=way.name)
    _add_position(add(add(private, "PrivateAction"), "TeleportAction"), first)
    _add_speed(add(private, "PrivateAction"), first.speed)


def _add_story(act: ET.Element, way: Way, recorded: Recorded, *, drives: bool) -> None:
    group = add(act, "ManeuverGroup", name=way.name, maximumExecutionCount="1")
    add(add(group, "Actors", selectTriggeringEntities="false"), "EntityRef", entityRef=way.name)
    dt, path, poses = recorded.step_length_s, way.path, way.poses
    maneuver = ET.Element("Maneuver", name=way.name)
    if path.first:
        action = _add_event(maneuver, f"{way.name} comes", (path.first - 0.5) * dt)
        _add_position(add(_add_of_entity(action, way), "AddEntityAction"), poses[0])
        if not drives or len(poses) == 1:
            action = _add_event(maneuver, f"{way.name} moves", (path.first - 0.5) * dt)
            _add_speed(add(action, "PrivateAction"), poses[0].speed)
    if drives and len(poses) > 1:
        action = _add_event(maneuver, f"{way.name} drives", (path.first - 0.5) * dt)
        _add_way(action, way.name, poses, dt)
    if drives and path.last < recorded.steps:
        action = _add_event(maneuver, f"{way.name} leaves", (path.last + 0.5) * dt)
        add(_add_of_entity(action, way), "DeleteEntityAction")
    if len(maneuver):
        group.append(maneuver)


def _add_of_entity(action: ET.Element, way: Way) -> ET.Element:
    return add(add(action, "GlobalAction"), "EntityAction", entityRef=way.name)


def _add_way(action: ET.Element, name: str, poses: list[Pose], dt: float) -> None:
    follow = add(add(add(action, "PrivateAction"), "RoutingAction"), "FollowTrajectoryAction")
    line = add(add(add(follow, "Trajectory", name=name, closed="false"), "Shape"), "Polyline")
    for pose in poses:
        _add_position(add(line, "Vertex", time=number(pose.step * dt)), pose)
    add(add(follow, "TimeReference"), "Timing", domainAbsoluteRelative="absolute", scale="1", offset="0")
    add(follow, "TrajectoryFollowingMode", followingMode="position")


def _add_event(maneuver: ET.Element, name: str, time_s: float) -> ET.Element:
    """Add what happens at a time, half a step before which it is set off; return its action, which comes first."""
    event = add(maneuver, "Event", name=name, priority="parallel", maximumExecutionCount="1")
    action = add(event, "Action", name=name)
    _add_trigger(event, "StartTrigger", time_s)
    return action


def _add_trigger(parent: ET.Element, tag: str, time_s: float) -> None:
    group = add(add(parent, tag), "ConditionGroup")
    condition = add(group, "Condition", name="time", delay="0", conditionEdge="none")
    add(add(condition, "ByValueCondition"), "SimulationTimeCondition", value=number(time_s), rule="greaterThan")


def _add_speed(action: ET.Element, speed: float) -> None:
    wanted = add(add(action, "LongitudinalAction"), "SpeedAction")
    add(wanted, "SpeedActionDynamics", dynamicsShape="step", dynamicsDimension="time", value="0")
    add(add(wanted, "SpeedActionTarget"), "AbsoluteTargetSpeed", value=number(speed))


def _add_position(parent: ET.Element, pose: Pose) -> None:
    place = {"x": pose.x, "y": pose.y, "z": pose.z, "h": pose.heading}
    add(add(parent, "Position"), "WorldPosition", **{name: number(value) for name, value in place.items()})
