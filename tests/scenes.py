"""Scenes made by hand."""

from __future__ import annotations

from crashhunt.world import Actor, Roster, Scene

CAR = (5.0, 2.0)


def scene(*vehicles, time_s=0.0, sizes=None, heights=(), grades=(), tall=None, **more):
    """Each vehicle is (id, x, y, heading, speed), of 5 m by 2 m where no size is given for its id."""
    sizes, tall = sizes or {}, tall or {}
    actors = [Actor(name, "passenger", *sizes.get(name, CAR), height=tall.get(name, 0.0)) for name, *_ in vehicles]
    points = [(float(x), float(y)) for _, x, y, _, _ in vehicles]
    headings, speeds = [float(v[3]) for v in vehicles], [float(v[4]) for v in vehicles]
    grades = grades or (0.0,) * len(heights)
    return Scene(time_s, Roster(tuple(actors)), points, headings, speeds, heights=heights, grades=grades, **more)


def in_line(gap_m, speed, other_speed):
    """The ego behind another car, both heading along x."""
    return scene(("ego", 0, 0, 0, speed), ("other", gap_m + CAR[0], 0, 0, other_speed))
