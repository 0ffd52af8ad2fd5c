"""A crash as a scenario in OpenSCENARIO 1.0 (XML), with its roads in OpenDRIVE: https://www.asam.net."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING
from xml.etree import ElementTree as ET

import numpy as np

from crashhunt.base.version import __version__
from crashhunt.formats._recorded import recorded_of
from crashhunt.formats._xml import add, number, plain_text, write_xml
from crashhunt.world import is_person

if TYPE_CHECKING:
    from pathlib import Path

    from crashhunt.crashes import Bundle
    from crashhunt.formats._recorded import Pose, RecordedCrash, RecordedPath, Road


# The lanes of a crash as a road network in OpenDRIVE 1.6.

_CONSTANT_POLYNOMIAL = {"b": "0", "c": "0", "d": "0"}  # of a polynomial that is a constant


def opendrive_of(recorded: RecordedCrash) -> ET.Element:
    """Return the road network: each lane is a road with one lane along its centre line, made of straight pieces.

    Lengths are in m, headings in rad. A road is linked with its only successor, if this successor has no other
    predecessor. Several successors would need a junction, and the file has no junctions. The ground is flat.
    """
    root = ET.Element("OpenDRIVE")
    points = np.concatenate([road.centre for road in recorded.roads])
    (west, south), (east, north) = points.min(axis=0), points.max(axis=0)
    bounds = {"north": north, "south": south, "east": east, "west": west}
    add(
        root, "header", revMajor="1", revMinor="6", name=plain_text(recorded.title), version="1.00",
        date=time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime()), vendor="crashhunt",
        **{side: number(value) for side, value in bounds.items()},
    )  # fmt: skip
    for index in range(len(recorded.roads)):
        _add_road(root, index, recorded.roads)
    return root


def _add_road(root: ET.Element, index: int, roads: tuple[Road, ...]) -> None:
    road = roads[index]
    centre = road.centre
    along = np.diff(centre, axis=0)
    lengths = np.hypot(along[:, 0], along[:, 1])
    begins = np.concatenate([[0.0], np.cumsum(lengths)])
    element = add(root, "road", id=str(index + 1), name="", junction="-1", length=number(begins[-1]))
    after = [other for other in road.after if roads[other].before == (index,)] if len(road.after) == 1 else []
    before = [other for other in road.before if roads[other].after == (index,)] if len(road.before) == 1 else []
    link = add(element, "link")
    for tag, others, point in (("predecessor", before, "end"), ("successor", after, "start")):
        for other in others:
            add(link, tag, elementType="road", elementId=str(other + 1), contactPoint=point)
    view = add(element, "planView")
    headings = np.arctan2(along[:, 1], along[:, 0])
    for (x, y), s, heading, length in zip(centre[:-1].tolist(), begins, headings, lengths, strict=False):
        place = {"x": x, "y": y, "s": s, "hdg": heading, "length": length}
        add(add(view, "geometry", **{name: number(value) for name, value in place.items()}), "line")
    _add_lane(add(element, "lanes"), road, before=bool(before), after=bool(after))


def _add_lane(lanes: ET.Element, road: Road, *, before: bool, after: bool) -> None:
    """Add the only lane of a road, to the right of a line that is shifted to the left by half the lane's width."""
    add(lanes, "laneOffset", s="0", a=number(road.width / 2), **_CONSTANT_POLYNOMIAL)
    section = add(lanes, "laneSection", s="0")
    add(add(section, "center"), "lane", id="0", type="none", level="false")
    lane = add(add(section, "right"), "lane", id="-1", type="driving", level="false")
    link = add(lane, "link")
    for tag, there in (("predecessor", before), ("successor", after)):
        if there:
            add(link, tag, id="-1")
    add(lane, "width", sOffset="0", a=number(road.width), **_CONSTANT_POLYNOMIAL)


_CATEGORIES = {
    "bus": "bus", "coach": "bus", "truck": "truck", "trailer": "semitrailer", "delivery": "van", "tram": "tram",
    "bicycle": "bicycle", "motorcycle": "motorbike", "moped": "motorbike", "rail": "train", "rail_urban": "train",
    "rail_electric": "train", "rail_fast": "train", "subway": "train",
}  # fmt: skip
_NO_LIMIT = "100"  # of speed and acceleration, which the format wants: no limit may slow an actor on its recorded way
_HEIGHT_M = 1.5  # where none was recorded
_AXLE_DISTANCE_SHARE = 0.6  # of the length, from one axle to the other


def write_openscenario(bundle: Bundle, target: Path, *, with_agents: bool = False) -> dict[str, list[str]]:
    """Write a crash in OpenSCENARIO 1.0, and its roads in OpenDRIVE 1.6; each file is complete or absent.

    Lengths are in m, angles in rad, speeds in m/s, times in s, 0 before the first recorded step. Every actor follows
    its recorded path, with a vertex per step, from the first to the last step in which it was seen. The reference point
    of a vehicle is its centre, and the file places its rear axle there. The real position of the axle was not recorded,
    and esmini shifts a vehicle ahead if its axle is behind the reference point. Performance, axles and missing heights
    are invented.

    Args:
        bundle: the crash to write.
        target: path of the scenario, ``….xosc``; the roads are written to ``….xodr``. Existing files are replaced.
        with_agents: whether the agents follow their recorded paths as well. Otherwise, they are placed at their start
            with their initial speed, so that another program can drive them.

    Returns:
        The names under which each actor is in the file.

    Raises:
        BundleError: the crash has no recorded actors or lanes, or its log is damaged.
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


def _root(recorded: RecordedCrash, roads: str) -> ET.Element:
    root = ET.Element("OpenSCENARIO")
    add(
        root, "FileHeader", revMajor="1", revMinor="0", date=time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime()),
        description=plain_text(recorded.title), author=f"crashhunt {__version__}",
    )  # fmt: skip
    add(root, "ParameterDeclarations")
    add(root, "CatalogLocations")
    add(add(root, "RoadNetwork"), "LogicFile", filepath=plain_text(roads))
    return root


def _add_entity(entities: ET.Element, way: RecordedPath) -> None:
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
            ("FrontAxle", _AXLE_DISTANCE_SHARE),
            ("RearAxle", 0.0),
        ):  # readers use the rear axle as the middle
            add(
                axles, tag, maxSteering="0.5", wheelDiameter="0.6", trackWidth=number(actor.width),
                positionX=number(ahead * actor.length), positionZ="0.3",
            )  # fmt: skip
    add(thing, "Properties")


def _add_start(actions: ET.Element, way: RecordedPath) -> None:
    first = way.poses[0]
    if way.path.first:  # an actor that appears later is absent at first
        add(add(add(actions, "GlobalAction"), "EntityAction", entityRef=way.name), "DeleteEntityAction")
        return
    private = add(actions, "Private", entityRef=way.name)
    _add_position(add(add(private, "PrivateAction"), "TeleportAction"), first)
    _add_speed(add(private, "PrivateAction"), first.speed)


def _add_story(act: ET.Element, way: RecordedPath, recorded: RecordedCrash, *, drives: bool) -> None:
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


def _add_of_entity(action: ET.Element, way: RecordedPath) -> ET.Element:
    return add(add(action, "GlobalAction"), "EntityAction", entityRef=way.name)


def _add_way(action: ET.Element, name: str, poses: list[Pose], dt: float) -> None:
    follow = add(add(add(action, "PrivateAction"), "RoutingAction"), "FollowTrajectoryAction")
    line = add(add(add(follow, "Trajectory", name=name, closed="false"), "Shape"), "Polyline")
    for pose in poses:
        _add_position(add(line, "Vertex", time=number(pose.step * dt)), pose)
    add(add(follow, "TimeReference"), "Timing", domainAbsoluteRelative="absolute", scale="1", offset="0")
    add(follow, "TrajectoryFollowingMode", followingMode="position")


def _add_event(maneuver: ET.Element, name: str, time_s: float) -> ET.Element:
    """Add an event at a time, with a trigger half a step earlier; return its first action."""
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
