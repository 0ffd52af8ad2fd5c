"""Observations in the default layout, made by hand."""

from __future__ import annotations

import math

import numpy as np

CAR_M = 5.0


def seen(speed, *others, heading=0.0, lane_y=0.0, rows=8):
    """Return what a vehicle is shown: each other one by x ahead, y to the right, vx, vy relative, and its heading."""
    shown = np.zeros((rows, 7), np.float32)
    shown[0] = 1, 300, lane_y, speed, 0, math.cos(heading), math.sin(heading)
    for number, other in enumerate(others, start=1):
        turned = other.get("heading", 0.0)
        moves = other.get("vx", 0.0), other.get("vy", 0.0)
        shown[number] = 1, other["x"], other.get("y", 0.0), *moves, math.cos(turned), math.sin(turned)
    return shown
