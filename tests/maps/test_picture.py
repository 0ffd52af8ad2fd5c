"""The picture of a map: where roads are drawn, in which colour, and how traffic that does not flow is reported."""

from __future__ import annotations

import pytest

from crashhunt.maps import _picture
from crashhunt.maps._network import Edge, NetworkLane, RoadNetwork
from crashhunt.maps._picture import _GROUND, _MARGIN, _ROAD, _SIZE, _WAY, _color, _draw_labels, draw_map
from crashhunt.maps._traffic_flow import PlainRun

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


def test_busiest_roads_are_labelled_at_their_middle(pixels):
    edges = [road("long", (0.0, 0.0), (1000.0, 0.0)), road("north", (0.0, 1000.0), (1000.0, 1000.0))]
    plain = pixels(edges, {"long": 9.0})
    assert plain(505.0, 0.0) != (255, 255, 255)
    labelled = pixels(edges, {"long": 9.0}, busiest=[("long", 900.0), ("north", 1.0)])
    white = [x for x in range(500, 640) if labelled(float(x), 0.0) == (255, 255, 255)]
    assert len(white) > 10
    assert min(white) < 515


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


def test_legend_has_the_most_vehicles_of_a_road_per_hour(tmp_path, monkeypatch):
    pytest.importorskip("PIL")
    seen = []
    monkeypatch.setattr(_picture, "_draw_ramp", lambda draw, width, most, letters, ink: seen.append(most))
    found = RoadNetwork({"a": road("a", (0.0, 0.0), (1000.0, 0.0))})
    _picture.draw_map(found, {"a": 90.0}, tmp_path / "m.png", title="", hours=0.5, busiest=[])
    assert seen == [180.0]


@pytest.mark.parametrize(("apart_m", "labels"), [((0.0, 1.0), 1), ((0.0, 60.0), 2), ((70.0, 0.0), 2)])
def test_names_of_roads_that_would_cover_each_other_are_excluded(monkeypatch, apart_m, labels):
    pytest.importorskip("PIL")
    from PIL import Image, ImageDraw

    roads = {
        name: Edge(name, "", (NetworkLane(length_m=2.0, speed_mps=9.0, allowed=None, disallowed=frozenset(),
                                          shape=((x, y), (x + 2, y))),))
        for name, (x, y) in (("a", (10.0, 10.0)), ("b", (10.0 + apart_m[0], 10.0 + apart_m[1])))
    }  # fmt: skip
    draw = ImageDraw.Draw(Image.new("RGB", (400, 400), (255, 255, 255)))
    drawn = []
    monkeypatch.setattr(draw, "text", lambda place, text, **more: drawn.append(text))
    _draw_labels(draw, RoadNetwork(edges=roads), [("a", 9.0), ("b", 8.0)], lambda point: point, (400, 400))
    assert drawn == ["a: 9/h", "b: 8/h"][:labels]
