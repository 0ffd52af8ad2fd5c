"""Parts of observations that follow from a scene: rays against a brute-force caster, predictions, nearest actors."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from crashhunt.simulators import (
    ActorNumbers,
    ObstacleOutlines,
    Raster,
    RayCaster,
    center_of,
    covariances_of,
    nearest_actors,
    occluded,
    picture,
    predictions_of,
    with_range_noise,
    wrapped,
)
from crashhunt.world import Actor, Roster, Scene, corners

number = st.floats(-40.0, 40.0).map(lambda value: round(value, 3))
poses = st.tuples(number, number, st.floats(-4.0, 4.0), st.floats(0.3, 18.0), st.floats(0.3, 3.0), st.floats(0.0, 30.0))


def scene_of(*actors, heights=(), spines=None):
    """A scene with actors given as x, y and heading of the front, length, width and speed."""
    roster = Roster(tuple(Actor(f"a{number}", "passenger", one[3], one[4]) for number, one in enumerate(actors)))
    points, headings, speeds = [one[:2] for one in actors], [one[2] for one in actors], [one[5] for one in actors]
    return Scene(
        0.0, roster, points, headings, speeds, heights=heights, grades=[0.0] * len(heights), spines=spines or {}
    )


@st.composite
def obstacles(draw):
    """Corners around a point, which also make outlines with dents, in both directions, some of them closed."""
    (x, y), radii = draw(st.tuples(number, number)), draw(st.lists(st.floats(0.5, 25.0), min_size=3, max_size=7))
    angles = [math.tau * corner / len(radii) for corner in range(len(radii))]
    outline = [(x + r * math.cos(angle), y + r * math.sin(angle)) for r, angle in zip(radii, angles, strict=True)]
    return [*outline, *outline[: draw(st.integers(0, 1))]][:: draw(st.sampled_from([1, -1]))]


def slow_range(outline, x, y, angle, *, is_filled=True):
    """The distance of a ray to an outline by its edges: where the ray crosses one, or 0 inside a filled outline."""
    dx, dy = math.cos(angle), math.sin(angle)
    best, sides = math.inf, []
    points = np.asarray(outline).tolist()  # Python calculates with its own numbers three times as fast
    for (px, py), (qx, qy) in zip(points, [*points[1:], points[0]], strict=True):
        ex, ey = qx - px, qy - py
        sides.append(ex * (y - py) - ey * (x - px))
        turn = dx * ey - dy * ex
        if abs(turn) > 1e-12:
            along = ((px - x) * ey - (py - y) * ex) / turn
            on_edge = ((px - x) * dy - (py - y) * dx) / turn
            if along >= 0 and -1e-12 <= on_edge <= 1 + 1e-12:
                best = min(best, along)
    return 0.0 if is_filled and (min(sides) >= 0 or max(sides) <= 0) else best


@given(st.lists(poses, min_size=1, max_size=7), st.lists(obstacles(), max_size=3), st.sampled_from([1, 2, 7, 72, 361]))
def test_rays_end_where_a_slow_caster_finds_the_first_edge(actors, buildings, rays):
    scene = scene_of(*actors)
    known = ObstacleOutlines(buildings) if buildings else None
    found = RayCaster(rays, 50.0, known).cast(scene, 0, range(1, len(actors)))
    x, y = center_of(scene, 0)
    outlines = [corners(scene, other) for other in range(1, len(actors))]

    def nearest(angle):
        away = [slow_range(one, x, y, angle) for one in outlines]
        return min([50.0, *away, *(slow_range(one, x, y, angle, is_filled=False) for one in buildings)])

    for ray, distance in enumerate(found):
        angle = scene.headings[0] + math.tau * ray / rays
        if distance == pytest.approx(nearest(angle), abs=1e-6):
            continue
        # A ray along an edge or through a corner may hit or miss it by rounding.
        beside = [nearest(angle + turn) for turn in (-1e-7, 1e-7)]
        assert any(distance == pytest.approx(one, abs=1e-3) for one in beside)


@pytest.mark.parametrize("heading", [0.0, 0.3, math.pi / 2, 3.0])
def test_no_ray_leaves_a_closed_outline_through_a_corner(heading):
    """Every 16th ray passes through a corner of a polygon around the vehicle."""
    turns = [heading + math.tau * corner / 16 for corner in range(16)]
    ring = [(10 * math.cos(turn), 10 * math.sin(turn)) for turn in turns]
    scene = scene_of((2 * math.cos(heading), 2 * math.sin(heading), heading, 4.0, 2.0, 0.0))
    found = RayCaster(256, 50.0, ObstacleOutlines([ring])).cast(scene, 0, [])
    assert found == pytest.approx(10.0, abs=0.2)
    assert found[::16] == pytest.approx(10.0)


def test_first_ray_points_ahead_and_the_next_ones_to_the_left():
    # Ego drives to the north; another car is 10 m ahead, one to the left.
    scene = scene_of((0, 2, math.pi / 2, 4, 2, 0), (0, 14, math.pi / 2, 4, 2, 0), (-8, 2, math.pi / 2, 4, 2, 0))
    found = RayCaster(4, 30.0).cast(scene, 0, [1, 2])
    assert found == pytest.approx([10.0, 7.0, 30.0, 30.0])


def test_rays_hit_the_pieces_of_a_bent_vehicle():
    spine = ((10.0, 5.0, 0.0), (10.0, 0.0, 0.0), (20.0, 0.0, 0.0))
    scene = scene_of((1, 0, 0.0, 2, 2, 0), (10, 5, math.pi / 2, 15, 2, 0), spines={1: spine})
    found = RayCaster(4, 30.0).cast(scene, 0, [1])
    assert found[0] == pytest.approx(9.0)


@given(st.lists(poses, min_size=1, max_size=9), st.floats(1.0, 60.0), st.integers(1, 9))
def test_nearest_actors_are_all_within_the_radius_in_order(actors, radius, limit):
    scene = scene_of(*actors)
    found = nearest_actors(scene, 0, hidden=frozenset(["a1"]), radius=radius, limit=limit)
    away = np.hypot(*(scene.centers - scene.centers[0]).T)
    near = [(away[row], row) for row in range(2, len(actors)) if away[row] <= radius - 1e-9]
    assert len(found) >= min(len(near), limit)
    assert [math.sqrt(one.squared) for one in found] == pytest.approx(sorted(away[[one.row for one in found]]))
    assert all((one.x, one.y) == pytest.approx(tuple(scene.centers[one.row])) for one in found)
    if len(near) > limit:
        assert math.sqrt(found[-1].squared) <= sorted(near)[limit - 1][0] + 1e-9


def test_actor_on_a_bridge_above_is_not_seen():
    scene = scene_of((0, 0, 0, 4, 2, 9), (5, 0, 0, 4, 2, 9), (9, 0, 0, 4, 2, 9), heights=[0.0, 7.0, 0.1])
    assert [one.row for one in nearest_actors(scene, 0, hidden=frozenset(), radius=50.0)] == [2]


def test_predictions_go_straight_on_at_constant_speed():
    scene = scene_of((0, 0, 0, 4, 2, 0), (10, 0, 7.0, 4, 2, 5.0))
    near = nearest_actors(scene, 0, hidden=frozenset(), radius=50.0)
    found = predictions_of(scene, near, shape=(3, 4, 4), interval=0.5)
    x, y = scene.centers[1]
    for step in range(4):
        ahead = 5.0 * 0.5 * (step + 1)
        expected = x + ahead * math.cos(7.0), y + ahead * math.sin(7.0), 7.0 - math.tau, 5.0
        assert found[0, step] == pytest.approx(expected)
    assert not found[1:].any()


def test_angles_are_wrapped_to_half_a_turn():
    assert [wrapped(angle) for angle in (0.0, 4.0, -4.0, 20.0)] == pytest.approx(
        [0.0, 4.0 - math.tau, math.tau - 4.0, 20.0 - 3 * math.tau]
    )


def cell_center(scene, cell, shape, resolution):
    """The map position of the centre of a cell."""
    x, y = center_of(scene, 0)
    c, s = math.cos(scene.headings[0]), math.sin(scene.headings[0])
    ahead, left = ((shape[axis] / 2 - cell[axis] - 0.5) * resolution for axis in (0, 1))
    return x + ahead * c - left * s, y + ahead * s + left * c


@given(st.lists(poses, min_size=2, max_size=4), st.sampled_from([(8, 8), (13, 5)]), st.sampled_from([0.7, 3.0, 9.0]))
def test_cells_are_occupied_if_their_centre_is_inside_an_outline(actors, shape, resolution):
    scene = scene_of(*actors)
    found = Raster(*shape, resolution).occupied(scene, 0, range(1, len(actors)))
    outlines = [corners(scene, other) for other in range(1, len(actors))]
    for cell in np.ndindex(*shape):
        x, y = cell_center(scene, cell, shape, resolution)
        slow = [slow_range(one, x, y, 0.1) == 0.0 for one in outlines]
        nearly = [
            slow_range(one, x + dx, y + dy, 0.1) == 0.0
            for one in outlines for dx in (-1e-6, 1e-6) for dy in (-1e-6, 1e-6)
        ]  # fmt: skip
        if len(set(nearly)) == 1 or any(slow):
            assert found[cell] == any(slow) or len(set(nearly)) == 2


def turns_around(outline, x, y):
    """How often an outline winds around a point, by the angles at which its corners are seen."""
    angles = [math.atan2(b - y, a - x) for a, b in outline]
    steps = [after - before for before, after in itertools.pairwise([*angles, angles[0]])]
    return round(math.fsum((step + math.pi) % math.tau - math.pi for step in steps) / math.tau)


@given(poses, st.lists(obstacles(), max_size=4), st.sampled_from([(8, 8), (13, 5)]), st.sampled_from([0.7, 3.0, 9.0]))
def test_cells_are_obstructed_if_an_outline_winds_around_their_centre(ego, buildings, shape, resolution):
    scene = scene_of(ego)
    found = Raster(*shape, resolution).obstructed(scene, 0, ObstacleOutlines(buildings))
    for cell in np.ndindex(*shape):
        x, y = cell_center(scene, cell, shape, resolution)
        around = {
            any(turns_around(one, x + dx, y + dy) for one in buildings) for dx in (-1e-6, 1e-6) for dy in (-1e-6, 1e-6)
        }
        assert found[cell] in around


@given(
    poses,
    st.lists(st.lists(st.tuples(number, number), min_size=2, max_size=4), min_size=1, max_size=3),
    st.sampled_from([(8, 8), (13, 5)]),
    st.sampled_from([0.7, 3.0, 9.0]),
)
def test_cells_are_on_a_lane_if_they_are_near_its_centre_line(ego, lines, shape, resolution):
    scene, width = scene_of(ego), 3.2
    found = Raster(*shape, resolution).on_lanes(scene, 0, [(np.array(line), width) for line in lines])
    for cell in np.ndindex(*shape):
        place = complex(*cell_center(scene, cell, shape, resolution))
        away = math.inf
        for line in lines:
            for start, end in itertools.pairwise(complex(*point) for point in line):
                step = end - start
                share = ((place - start) * step.conjugate()).real / max(abs(step) ** 2, 1e-12)
                away = min(away, abs(place - start - min(max(share, 0.0), 1.0) * step))
        if abs(away - width / 2) > 1e-6:
            assert found[cell] == (away < width / 2)


def test_raster_without_lanes_is_empty_and_pictures_have_the_colours_of_films():
    scene = scene_of((2.5, 0.0, 0.0, 5.0, 2.0, 0.0), (12.5, 0.0, 0.0, 5.0, 2.0, 0.0))
    raster = Raster(30, 10, 1.0)
    assert not raster.on_lanes(scene, 0, []).any()
    assert not raster.on_lanes(scene, 0, [(np.array([[500.0, 0.0], [600.0, 0.0]]), 3.0)]).any()
    house = ObstacleOutlines([[(-20.0, -9.0), (-8.0, -9.0), (-8.0, 9.0), (-20.0, 9.0)]])
    drawn = picture(
        raster.on_lanes(scene, 0, [(np.array([[-50.0, 0.0], [50.0, 0.0]]), 4.0)]),
        raster.obstructed(scene, 0, house),
        raster.occupied(scene, 0, [1]),
        raster.occupied(scene, 0, [0]),
    )
    assert drawn.dtype == np.uint8
    assert drawn[15, 5].tolist() == [224, 138, 0]  # ego, in the middle
    assert drawn[5, 5].tolist() == [125, 139, 156]  # 10 m ahead
    assert drawn[0, 5].tolist() == [228, 232, 237]  # the road
    assert drawn[15, 0].tolist() == [246, 247, 249]
    assert drawn[25, 5].tolist() == drawn[25, 0].tolist() == [196, 186, 176]  # a building, also on the road


@settings(max_examples=15)
@given(st.lists(poses, min_size=2, max_size=6), st.lists(obstacles(), max_size=2))
def test_actor_is_hidden_if_and_only_if_every_slow_ray_hits_something_else_first(actors, buildings):
    scene, rays = scene_of(*actors), 60
    hidden = occluded(scene, 0, RayCaster(rays, 120.0, ObstacleOutlines(buildings) if buildings else None))
    x, y = center_of(scene, 0)
    outlines = [corners(scene, other) for other in range(1, len(actors))]
    surely, nearly = set(), set()
    for ray in range(rays):
        winners = []
        for turn in (0.0, -1e-7, 1e-7):  # a ray along an edge or through a corner may hit or miss it by rounding
            angle = scene.headings[0] + math.tau * ray / rays + turn
            away = [slow_range(one, x, y, angle) for one in outlines]
            away += [slow_range(one, x, y, angle, is_filled=False) for one in buildings]
            winners.append({other for other, one in enumerate(away, 1) if one <= min([*away, 120.0]) + 1e-3})
        nearly |= set().union(*winners)
        surely |= winners[0] if winners[0] == winners[1] == winners[2] and len(winners[0]) == 1 else set()
    cars = set(range(1, len(actors)))  # the numbers behind are those of obstacles
    assert surely & cars <= {other for other in cars if scene.roster.actors[other].id not in hidden} <= nearly


@pytest.mark.parametrize(("seed", "agent", "step"), [(2, "ego", 3), (1, "other", 3), (1, "ego", 4)])
def test_noise_of_ranges_differs_between_seeds_agents_and_steps(seed, agent, step):
    settings = {"noise": 0.5, "range": 50.0}
    ranges = np.array([20.0, 50.0, 0.0, 49.999])
    first = with_range_noise(ranges, settings, seed=1, agent="ego", step=3)
    assert first.tobytes() == with_range_noise(ranges, settings, seed=1, agent="ego", step=3).tobytes()
    assert first[0] != with_range_noise(ranges, settings, seed=seed, agent=agent, step=step)[0]
    assert first[1] == 50.0  # no outline
    assert (first >= 0.0).all()
    assert (first <= 50.0).all()
    assert with_range_noise(ranges, {**settings, "noise": 0.0}, seed=1, agent="ego", step=3) is ranges


def test_covariances_are_those_of_actors_with_random_accelerations():
    scene = scene_of((0.0, 0.0, 0.0, 4.0, 1.8, 0.0), (20.0, 0.0, 0.7, 4.0, 1.8, 6.0), (9.0, 9.0, 0.0, 4.0, 1.8, 6.0))
    near = nearest_actors(scene, 0, hidden=frozenset(), radius=50.0)
    asked = {"interval": 0.5, "along": 2.0, "across": 0.4}
    found = covariances_of(scene, near, asked, shape=(3, 4, 3))
    assert not found[2].any()
    draw = np.random.default_rng(1)
    accelerations = draw.normal(0.0, (2.0, 0.4), (60_000, 2))
    for row, heading in ((0, 0.0), (1, 0.7)):  # the nearest first
        turn = np.array([[math.cos(heading), -math.sin(heading)], [math.sin(heading), math.cos(heading)]])
        for step in range(4):
            places = accelerations @ turn.T * (0.5 * (step + 1)) ** 2 / 2
            (var_x, cov_xy), (_, var_y) = np.cov(places.T)
            assert found[row, step] == pytest.approx([var_x, var_y, cov_xy], rel=0.03, abs=0.03)


def test_actor_keeps_its_number_when_others_come_and_go():
    numbers, seen = ActorNumbers(), {}
    for places in ((5.0, 9.0, 60.0), (70.0, 3.0, 4.0), (5.0, 90.0, 6.0)):
        actors = [(x, 0.0, 0.0, 4.0, 1.8, 0.0) for x in (0.0, *places)]
        scene = scene_of(*actors)
        near = nearest_actors(scene, 0, hidden=frozenset(), radius=50.0)
        found = numbers.of(scene, near, 4)
        assert not found[len(near) :].any()
        for one, number_ in zip(near, found.tolist(), strict=False):
            assert seen.setdefault(one.row, number_) == number_ > 0
    assert len(set(seen.values())) == len(seen) == 3


def test_predictions_of_another_reference_point_are_shifted_along_the_heading():
    scene = scene_of((0.0, 0.0, 0.0, 4.0, 1.8, 0.0), (20.0, 0.0, 0.7, 4.0, 1.8, 6.0))
    near = nearest_actors(scene, 0, hidden=frozenset(), radius=50.0)
    plain, front = (
        predictions_of(scene, near, shape=(1, 3, 4), interval=0.1, reference_share=share) for share in (0.0, 0.5)
    )
    assert (front - plain)[0, :, :2] == pytest.approx(np.full((3, 2), [2.0 * math.cos(0.7), 2.0 * math.sin(0.7)]))
    assert (front[..., 2:] == plain[..., 2:]).all()
