"""How near an episode came, in scenes whose answer is known, and against measuring every pair."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scenes import in_line, scene

from crashhunt.world import (
    ApproachMeter,
    approaches,
    closest_approach,
    rectangle_gap,
    time_to_contact,
)  # fmt: skip


def nearest(*views, agent="ego"):
    return [values.tolist() for values in approaches([view.frame for view in views], agent)]


@pytest.mark.parametrize("turned", [0.0, 1.1, -2.5])
def test_every_side_has_its_gap(turned):
    c, s = math.cos(turned), math.sin(turned)

    def at(x, y, heading=0.0):
        return scene(("ego", 3, 4, turned, 10), ("other", 3 + x * c - y * s, 4 + x * s + y * c, turned + heading, 10))

    views = [at(8, 0), at(-9, 0), at(0, 5), at(0, -6), at(8, 5), at(3, 0, math.pi), at(6, 0, -math.pi / 2)]
    expected = [3, 4, 3, 4, math.hypot(3, 3), 0, 5]
    expected[5], expected[6] = 3, math.hypot(6 - 1, 0)
    assert nearest(*views)[1] == pytest.approx(expected, abs=1e-9)


def test_a_meter_keeps_the_worst_of_all_scenes_and_all_agents():
    views = [in_line(30, 20, 10), in_line(12, 10, 10), in_line(40, 30, 10)]
    whole = closest_approach(views, ["other", "ego"])
    assert (whole.time_to_collision_s, whole.gap_m, whole.required_deceleration) == pytest.approx((2.0, 12.0, 5.0))
    meter = ApproachMeter(["ego"])
    for view in views:
        meter.measure([view.frame])
    assert meter.closest == closest_approach(views, ["ego"]) == whole
    assert closest_approach(views[:1] * 300 + views[1:], ["ego"]) == whole  # more than are measured at a time


def test_actors_that_come_and_go_are_measured_in_their_own_steps():
    alone = scene(("ego", 0, 0, 0, 20))
    without = scene(("a", 0, 0, 0, 1), ("b", 7, 0, 0, 1))
    two = scene(("third", 60, 0, 0, 20), ("ego", 0, 0, 0, 20), ("other", 15, 0, 0, 10))
    times, gaps, _ = nearest(alone, in_line(20, 20, 10), without, two, in_line(5, 20, 10))
    assert times == pytest.approx([math.inf, 2.0, math.inf, 1.0, 0.5])
    assert gaps == pytest.approx([math.inf, 20.0, math.inf, 10.0, 5.0])


def test_everybody_is_measured_as_if_alone():
    """What is left out because it cannot be the nearest was not the nearest: long, wide, turned and fast ones."""
    random = np.random.default_rng(7)
    views, times, gaps, brakes = [], [], [], []
    for number in range(90):
        count = int(random.integers(2, 8))
        order = 1 if number % 3 else -1  # a person is wider than long
        sizes = {f"v{n}": (random.uniform(0.5, 18), random.uniform(0.4, 3))[::order] for n in range(count)}
        reach = 15 if number % 2 else 70
        rows = [
            (f"v{n}", *random.uniform(-reach, reach, 2), random.uniform(-4, 4), random.uniform(0, 35))
            for n in range(count)
        ]
        view = scene(*rows, sizes=sizes)
        found = [measured(view, 0, other) for other in range(1, count)]
        views.append(view)
        times.append(min(time for time, _, _ in found))
        gaps.append(min(gap for _, gap, _ in found))
        brakes.append(max(brake for _, _, brake in found))
    together = nearest(*views, agent="v0")
    assert sum(math.isfinite(time) for time in times) > 20
    assert together[0] == pytest.approx(times)
    near = [gap if gap < 50 else math.inf for gap in together[1]]
    assert near == pytest.approx([gap if gap < 50 else math.inf for gap in gaps])
    assert together[2] == pytest.approx(brakes)


def measured(view, row, other):
    """Time to collision, gap and required deceleration of two, from their definitions."""
    heading = view.headings[row]
    c, s = math.cos(heading), math.sin(heading)

    def turned(x, y):
        return np.array([[x * c + y * s, y * c - x * s]])

    def velocity(who):
        return view.speeds[who] * np.array([math.cos(view.headings[who]), math.sin(view.headings[who])])

    offset, relative = view.centers[other] - view.centers[row], velocity(other) - velocity(row)
    shape = np.array([view.headings[other] - heading]), *(view.roster.half_sizes[[who]] for who in (row, other))
    gap = float(rectangle_gap(turned(*offset), *shape)[0])
    time = float(time_to_contact(turned(*offset), turned(*relative), *shape)[0])
    if not time <= 10:
        return math.inf, gap, 0.0
    return time, gap, float(np.hypot(*relative)) / (2 * time) if time else 0.0


def test_who_is_on_a_bridge_above_is_no_danger():
    crossing = ("ego", 0, 0, 0, 10), ("other", 20, 15, -math.pi / 2, 10)
    below = scene(*crossing, heights=(0.0, 5.0))
    assert nearest(scene(*crossing))[0][0] < 2
    assert nearest(below) == [[math.inf], [math.inf], [0.0]]
    assert nearest(scene(*crossing, heights=(0.0, 2.9))) == nearest(scene(*crossing))
    assert nearest(scene(*crossing, heights=(0.0, 3.0)))[0] == [math.inf]
    assert nearest(below, scene(*crossing))[0] == [math.inf, *nearest(scene(*crossing))[0]]
    # A lorry of 5.2 m does not fit below; which of the two is tall matters only of the lower one.
    assert nearest(scene(*crossing, heights=(0.0, 5.0), tall={"ego": 5.2}))[0][0] < 2
    assert nearest(scene(*crossing, heights=(0.0, 5.0), tall={"other": 5.2}))[0] == [math.inf]
    assert nearest(scene(*crossing, heights=(5.0, 0.0), tall={"other": 5.2}))[0][0] < 2
    assert nearest(scene(*crossing, heights=(5.0, 0.0), tall={"ego": 5.2}))[0] == [math.inf]


def test_a_bent_vehicle_is_where_its_parts_are():
    def bus(*spine, heights=(), **more):
        views = ("ego", 0, 0, 0, 10), ("bus", 30, 0, 0, 5)
        return scene(*views, sizes={"bus": (18.0, 2.5)}, spines={1: spine} if spine else {}, heights=heights, **more)

    straight = bus((30.0, 0.0, 0.0), (21.0, 0.0, 0.0), (12.0, 0.0, 0.0))
    assert nearest(straight) == [pytest.approx([12 / 5]), pytest.approx([12.0]), pytest.approx([5 / 4.8])]
    assert nearest(straight) == [pytest.approx(values) for values in nearest(bus())]
    # Its rear is still in the side street: 20 m ahead, a front part that crosses.
    aside = bus((30.0, 0.0, 0.0), (21.0, 0.0, 0.0), (21.0, -9.0, 0.0))
    assert nearest(aside)[1] == pytest.approx([21 - 1.25])
    # The ego may be bent too; row and order do not matter.
    swapped = nearest(aside, agent="bus")
    assert swapped[1] == pytest.approx([21 - 1.25])
    assert nearest(bus(), aside, straight, in_line(3, 9, 9))[1] == pytest.approx([12.0, 19.75, 12.0, 3.0])
    ramp = bus((30.0, 0.0, 5.0), (21.0, 0.0, 4.1), (12.0, 0.0, 3.2), heights=(0.0, 5.0), grades=(0.1, 0.1))
    assert nearest(ramp)[1] == pytest.approx([12.0])
    assert nearest(bus((30.0, 0.0, 5.0), (21.0, 0.0, 5.0), (12.0, 0.0, 5.0), heights=(0.0, 5.0), tall={"ego": 5.1}))[
        1
    ] == pytest.approx([12.0])
    bridge = bus((30.0, 0.0, 9.0), (21.0, 0.0, 9.0), (12.0, 0.0, 9.0), heights=(0.0, 9.0))
    assert nearest(bridge) == [[math.inf], [math.inf], [0.0]]
