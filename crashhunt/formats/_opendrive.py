"""The lanes of a crash as a road network in OpenDRIVE 1.6."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING
from xml.etree import ElementTree as ET

import numpy as np

from crashhunt.formats._xml import add, number, plain_text

if TYPE_CHECKING:
    from crashhunt.formats._recorded import Recorded, Road

__all__ = ["opendrive_of"]

_FLAT = {"b": "0", "c": "0", "d": "0"}  # of a polynomial that is a constant


def opendrive_of(recorded: Recorded) -> ET.Element:
    """Return the road network: each lane as a road with one lane, along its centre line, of straight pieces.

    Lengths are in m, headings in rad. A road is linked with the one that goes on where it ends, where there is one
    alone and it comes from nowhere else; several are a junction, of which none is in the file. The ground is flat.
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
    """Add the one lane, which lies to the right of a line half its width to the left."""
    add(lanes, "laneOffset", s="0", a=number(road.width / 2), **_FLAT)
    section = add(lanes, "laneSection", s="0")
    add(add(section, "center"), "lane", id="0", type="none", level="false")
    lane = add(add(section, "right"), "lane", id="-1", type="driving", level="false")
    link = add(lane, "link")
    for tag, there in (("predecessor", before), ("successor", after)):
        if there:
            add(link, tag, id="-1")
    add(lane, "width", sOffset="0", a=number(road.width), **_FLAT)
