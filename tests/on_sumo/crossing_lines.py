"""Where two lines of points cross, for tests that read the right of way a second time."""

from __future__ import annotations

import math
from itertools import pairwise


def crossing(one, other):
    """Return the distances along two lines to their first common point; None without one."""
    along = 0.0
    for (ax, ay), (bx, by) in pairwise(one):
        beyond = 0.0
        for (cx, cy), (dx, dy) in pairwise(other):
            turn = (bx - ax) * (dy - cy) - (by - ay) * (dx - cx)
            if abs(turn) > 1e-9:
                s = ((cx - ax) * (dy - cy) - (cy - ay) * (dx - cx)) / turn
                u = ((cx - ax) * (by - ay) - (cy - ay) * (bx - ax)) / turn
                if -1e-6 <= s <= 1 + 1e-6 and -1e-6 <= u <= 1 + 1e-6:
                    return along + s * math.dist((ax, ay), (bx, by)), beyond + u * math.dist((cx, cy), (dx, dy))
            beyond += math.dist((cx, cy), (dx, dy))
        along += math.dist((ax, ay), (bx, by))
    return None
