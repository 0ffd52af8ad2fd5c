"""Checks the JSON data of trials, which processes exchange and which ledgers and bundles contain.

Keys that an earlier version did not write may be missing. Keys that a later version has added are accepted.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from crashhunt.base.codec import plain_types, typed_where_there
from crashhunt.base.integrity import typed
from crashhunt.trial._disturbance import Disturbance
from crashhunt.trial._evidence import Collision, Escape, Failure
from crashhunt.world import ClosestApproach, Event

if TYPE_CHECKING:
    from collections.abc import Sequence

    from crashhunt.base.codec import JsonObject


def check_disturbances(disturbances: Sequence[JsonObject] | None) -> None:
    """Check the types and ranges of a list of disturbances; None is valid.

    Raises:
        ValueError: A value has a wrong type or range; the message names the value.
    """
    typed({"disturbances": disturbances}, {"disturbances": list | None})
    for one in disturbances or ():
        typed({"disturbance": one}, {"disturbance": dict})
        _check(one, Disturbance)
        if one["step"] < 1 or not math.isfinite(one["how_strong"]) or not 0 < one["how_long"] < math.inf:
            raise ValueError("the step, strength or duration of a disturbance is out of its range")


def check_parts(
    closest: object, collision: object, failure: object, escape: object = None, event: object = None
) -> None:
    """Check the types of the evidence on the end of a trial; None is valid.

    Raises:
        ValueError: A value has a wrong type; the message names the value.
    """
    for name, part, kind in (
        ("closest", closest, ClosestApproach), ("collision", collision, Collision), ("failure", failure, Failure),
        ("escape", escape, Escape), ("event", event, Event),
    ):  # fmt: skip
        typed({name: part}, {name: dict if name == "closest" else dict | None})
        if isinstance(part, dict):
            _check(part, kind)


def _check(part: JsonObject, kind: Any) -> None:
    needed, known = plain_types(kind)
    typed(part, needed)
    typed_where_there(part, known)
