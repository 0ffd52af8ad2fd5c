"""The picture of a map: where roads are drawn, in which colour, and how traffic that does not flow is reported."""

from __future__ import annotations

import pytest

from crashhunt.sumo.maps._picture import (
    _GROUND,
    _MARGIN,
    _ROAD,
    _SIZE,
    _WAY,
    _color,
    _draw_labels,
    _draw_scale,
    _midpoint,
    draw_map,
)
from crashhunt.sumo.maps._road_network import Edge, NetworkLane, RoadNetwork
from crashhunt.sumo.maps._traffic import PlainRun

BLUE, ORANGE, RED = (146, 180, 214), (224, 138, 0), (198, 40, 40)


def road(name, *points, allows=("passenger",)):
    lane = NetworkLane(length_m=1000.0, speed_mps=13.9, allowed=frozenset(allows), disallowed=frozenset(), shape=points)
    return Edge(name, name, (lane,))


@pytest.fixture
def pixels(tmp_path):
    """Draw roads, and return a function from metres to the colour there."""
    image_of = pytest.importorskip("PIL.Image")

    def draw(edges, vehicles, *, busiest=(), origin=(0.0, 0.0), span_m=1000.0):
        found = RoadNetwork({edge.id: edge for edge in edges})
        draw_map(found, vehicles, tmp_path / "m.png", title="", hours=1.0, busiest=list(busiest))
        image = image_of.open(tmp_path / "m.png").convert("RGB")
        scale = (_SIZE - 2 * _MARGIN) / span_m
        bottom = image.height - 30 - _MARGIN

        def color(x, y):
            return image.getpixel((round(_MARGIN + (x - origin[0]) * scale), round(bottom - (y - origin[1]) * scale)))

        return color

    return draw


def near(one, other):
    return max(abs(a - b) for a, b in zip(one, other, strict=True)) <= 12


def test_roads_lie_where_the_map_has_them(pixels):
    square = [
        road("south", (2000.0, 3000.0), (3000.0, 3000.0)),
        road("west", (2000.0, 3000.0), (2000.0, 4000.0)),
        road("path", (2000.0, 4000.0), (3000.0, 4000.0), allows=("pedestrian",)),
        road("half", (2000.0, 3500.0), (2500.0, 3500.0)),
    ]
    color = pixels(square, {"south": 90.0, "half": 45.0}, origin=(2000.0, 3000.0))
    assert near(color(2400, 3000), RED)  # south is below, and carries most
    assert near(color(2200, 3500), ORANGE)  # half as many
    assert near(color(2000, 3700), _ROAD)  # no traffic
    assert near(color(2400, 4000), _WAY)  # no cars
    assert near(color(2700, 3500), _GROUND)
    assert near(color(3000, 3700), _GROUND)


def test_colors_go_from_little_traffic_to_the_most():
    assert [_color(share) for share in (-1.0, 0.0, 0.5, 1.0, 2.0)] == [BLUE, BLUE, ORANGE, RED, RED]
    assert _color(0.25) == tuple(round((a + b) / 2) for a, b in zip(BLUE, ORANGE, strict=True))


FLOWS = {
    "demand": 100.0, "wanted": 100, "entered": 100, "arrived": 80, "running": 20, "halting": 2, "teleports": 0,
    "collisions": 0, "mean_speed_mps": 9.0, "persons": 0,
}  # fmt: skip


@pytest.mark.parametrize(
    ("given", "jam"),
    [
        ({}, ""),
        ({"entered": 0}, "no vehicle enters"),
        ({"entered": 95}, ""),
        ({"entered": 40, "arrived": 20}, "60 of 100 vehicles cannot enter"),
        ({"wanted": 8, "entered": 2, "arrived": 1, "running": 1}, "6 of 8 vehicles cannot enter"),
        ({"wanted": 8, "entered": 3, "arrived": 1, "running": 2}, ""),
        ({"teleports": 2}, ""),
        ({"teleports": 60}, "60 of 100 vehicles stand for 300 s"),
        ({"halting": 20}, "20 of 20 vehicles stand still at the end"),
        ({"running": 9, "halting": 9}, ""),  # too few to say
        ({"arrived": 0, "entered": 10, "wanted": 10, "running": 9, "halting": 5, "mean_speed_mps": 0.0},
         "no vehicle arrives"),
        ({"arrived": 0, "entered": 10, "wanted": 10, "running": 9, "halting": 4, "mean_speed_mps": 0.0}, ""),
    ],
    ids=str,
)  # fmt: skip
def test_traffic_that_does_not_flow_has_a_reason(given, jam):
    assert PlainRun(**FLOWS | given).jam == jam


class Drawing:
    """In place of Pillow's drawing: it notes each call, and every letter is 7 pixels wide."""

    def __init__(self, calls, image=None):
        self.calls = calls
        if image is not None:
            calls.append(("image", image.size))

    def textlength(self, text, font):
        return 7.0 * len(text)

    def _note(self, what, shape, **more):
        flat = [number for point in shape for number in (point if isinstance(point, tuple) else (point,))]
        self.calls.append((what, *(number if isinstance(number, str) else round(number) for number in flat), more))

    def line(self, points, *, fill, width=1, joint=""):
        self._note("line", points, fill=fill, width=width)

    def polygon(self, points, *, fill):
        self._note("polygon", points, fill=fill)

    def rounded_rectangle(self, box, *, radius, fill, outline):
        self._note("box", box, radius=radius, fill=fill, outline=outline)

    def text(self, place, text, *, fill, font):
        self._note("text", (*place, text), fill=fill, size=font.size)


def lane(*shape, allows=("passenger",)):
    allowed = frozenset(allows)
    return NetworkLane(length_m=9.0, speed_mps=9.0, allowed=allowed, disallowed=frozenset(), shape=shape)


def test_picture_of_a_town_is_laid_out_in_one_scale(tmp_path, monkeypatch):
    """A kilometre has 1120 pixels between margins of 40; roads are drawn twice as large, the busiest one on top."""
    image_draw = pytest.importorskip("PIL.ImageDraw")
    from crashhunt.panels import FAINT, INK

    calls = []
    monkeypatch.setattr(image_draw, "Draw", lambda image: Drawing(calls, image))
    main = Edge("a", "Main Street", (
        lane((100.0, 200.0), (1100.0, 200.0)), lane((100.0, 203.0), (1100.0, 203.0), allows=("pedestrian",)),
    ))  # fmt: skip
    side = Edge("b", "", (lane((600.0, 200.0), (600.0, 400.0), (600.0, 700.0)),))
    quiet = Edge("c", "", (lane((600.0, 200.0), (700.0, 100.0)),))
    town = RoadNetwork(
        edges={"a": main, "b": side, "c": quiet}, areas=[((590.0, 190.0), (610.0, 190.0), (600.0, 210.0))]
    )
    draw_map(
        town,
        {"a": 60.0, "b": 30.0},
        tmp_path / "m.png",
        title="A town",
        hours=0.5,
        busiest=[("a", 1200.0), ("b", 60.0)],
    )
    ramp = [call for call in calls if call[0] == "line" and call[-1]["width"] == 1]
    assert [call[:-1] for call in ramp] == [("line", x, 46, x, 56) for x in range(920, 1140)]
    assert [call[-1]["fill"] for call in ramp] == [_color(number / 220) for number in range(220)]
    ink = {"fill": INK, "size": 14}
    box = {"radius": 4, "fill": (255, 255, 255), "outline": (200, 206, 214)}
    assert [call for call in calls if call not in ramp] == [
        ("image", (2400, 1704)),
        ("polygon", 1178, 1362, 1222, 1362, 1200, 1318, {"fill": (200, 206, 214)}),
        ("line", 1200, 1340, 1424, 1564, {"fill": (200, 206, 214), "width": 6}),
        ("line", 1200, 1340, 1200, 892, 1200, 220, {"fill": ORANGE, "width": 9}),
        ("line", 80, 1340, 2320, 1340, {"fill": RED, "width": 12}),
        ("line", 80, 1333, 2320, 1333, {"fill": (222, 226, 232), "width": 6}),
        ("image", (1200, 852)),
        ("text", 40, 18, "A town", {"fill": INK, "size": 22}),
        ("text", 904, 42, "0", ink),
        ("text", 1042, 24, "120 vehicles/h", ink),
        ("box", 605, 659, 751, 679, box),
        ("text", 608, 661, "Main Street: 1,200/h", ink),
        ("box", 605, 435, 660, 455, box),
        ("text", 608, 437, "b: 60/h", ink),
        ("line", 40, 828, 152, 828, {"fill": FAINT, "width": 3}),
        ("text", 160, 819, "100 m", {"fill": FAINT, "size": 14}),
    ]
    assert (_GROUND, _ROAD, _WAY) == ((246, 247, 249), (200, 206, 214), (222, 226, 232))


@pytest.mark.parametrize(
    ("edges", "size", "line"),
    [
        ([road("dot", (5.0, 5.0), (5.0, 5.0))], (780, 340), (390, 190, 390, 190)),
        ([road("high", (5.0, 0.0), (5.0, 500.0))], (780, 1300), (390, 1230, 390, 110)),
        ([road("wide", (0.0, 7.0), (500.0, 7.0))], (1200, 340), (40, 190, 1160, 190)),
    ],
)
def test_picture_of_a_small_place_has_room_for_its_texts(tmp_path, monkeypatch, edges, size, line):
    image_draw = pytest.importorskip("PIL.ImageDraw")
    calls = []
    monkeypatch.setattr(image_draw, "Draw", lambda image: Drawing(calls, image))
    draw_map(RoadNetwork({edge.id: edge for edge in edges}), {}, tmp_path / "m.png", title="", hours=1.0, busiest=[])
    assert calls[0] == ("image", (2 * size[0], 2 * size[1]))
    (drawn,) = [call for call in calls if call[0] == "line" and call[-1]["width"] > 3]
    assert drawn[1:-1] == tuple(2 * number for number in line)
    assert drawn[-1]["fill"] == _ROAD


@pytest.mark.parametrize(
    ("scale", "length", "text"),
    [(0.01, 5000, "5 km"), (0.11, 2000, "2 km"), (0.22, 1000, "1 km"), (0.23, 500, "500 m"),
     (1.09, 200, "200 m"), (2.19, 100, "100 m"), (4.39, 50, "50 m"), (10.9, 20, "20 m"), (22.0, 10, "10 m"),
     (99.0, 10, "10 m")],
)  # fmt: skip
def test_scale_is_a_round_length_of_at_most_220_pixels(scale, length, text):
    calls, letters = [], type("Font", (), {"size": 14})
    _draw_scale(Drawing(calls), scale, (1200, 900), (1, 2, 3), letters)
    assert calls == [
        ("line", 40, 876, round(40 + length * scale), 876, {"fill": (1, 2, 3), "width": 3}),
        ("text", round(48 + length * scale), 867, text, {"fill": (1, 2, 3), "size": 14}),
    ]


def test_label_of_a_road_is_in_its_middle_and_within_the_picture():
    pytest.importorskip("PIL")
    roads = {name: Edge(name, "", (lane((x, y), (x, y + 20)),)) for name, x, y in
             (("a", 5.0, 20.0), ("b", 300.0, 60.0), ("c", -40.0, 100.0), ("d", 100.0, 140.0), ("e", 100.0, 180.0),
              ("f", 100.0, 220.0))}  # fmt: skip
    calls = []
    busiest = [(name, 9.0) for name in roads]
    _draw_labels(Drawing(calls), RoadNetwork(edges=roads), busiest, lambda point: point, (320, 400))
    texts = [(call[3], call[1], call[2]) for call in calls if call[0] == "text"]
    assert texts == [
        ("a: 9/h", 13, 21), ("b: 9/h", 320 - 42 - 8, 61), ("c: 9/h", 4, 101), ("d: 9/h", 108, 141),
        ("e: 9/h", 108, 181),
    ]  # fmt: skip
    assert _midpoint(road("x", (0.0, 0.0), (10.0, 4.0))) == (5.0, 2.0)
    assert _midpoint(road("x", (0.0, 0.0), (1.0, 1.0), (10.0, 4.0))) == (1.0, 1.0)
    assert _midpoint(road("x", (0.0, 0.0), (1.0, 1.0), (2.0, 4.0), (10.0, 4.0))) == (2.0, 4.0)


@pytest.mark.parametrize(
    ("place", "labels"),
    [((47.0, 0.0), 1), ((49.0, 0.0), 2), ((-47.0, 0.0), 1), ((-49.0, 0.0), 2), ((0.0, 19.0), 1), ((0.0, 21.0), 2),
     ((0.0, -19.0), 1), ((0.0, -21.0), 2), ((40.0, 18.0), 1)],
)  # fmt: skip
def test_labels_stay_apart_in_every_direction(place, labels):
    pytest.importorskip("PIL")
    roads = {name: Edge(name, "", (lane((x, y), (x, y)),)) for name, x, y in
             (("a", 200.0, 200.0), ("b", 200.0 + place[0], 200.0 + place[1]))}  # fmt: skip
    calls = []
    _draw_labels(Drawing(calls), RoadNetwork(edges=roads), [("a", 9.0), ("b", 9.0)], lambda point: point, (900, 900))
    assert len([call for call in calls if call[0] == "text"]) == labels
