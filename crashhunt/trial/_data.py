"""Checks of a trial's plain data, as it crosses between processes and stands in ledgers and bundles.

What an earlier version did not write need not be there, and what a later one has added may be there as well.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from crashhunt.base.codec import plain_types
from crashhunt.base.integrity import typed
from crashhunt.base.tolerance import typed_where_there
from crashhunt.trial._disturbance import Disturbance
from crashhunt.trial._evidence import Collision, Escape, Failure
from crashhunt.world import ClosestApproach, Event

if TYPE_CHECKING:
    from collections.abc import Sequence

    from crashhunt.base.codec import JsonObject

__all__ = ["check_disturbances", "check_parts", "check_plain"]


# The types that the plain data of a trial must have before anything is made of it.

_TEXT_OR_NUMBER = bool | float | str | None


_SPEC = {
    "arguments": dict[str, dict[str, _TEXT_OR_NUMBER]],
    "scenario_arguments": dict[str, _TEXT_OR_NUMBER],
}


def check_plain(data: JsonObject) -> None:
    """See that plain data has the types that `TrialResult.from_json` takes for granted.

    Raises:
        ValueError: with what is not as it should be.
    """
    typed(data, {"outcome": str, "steps": int, "spec": dict})
    typed_where_there(data, {"sim_time_s": float, "digest": str, "wall_s": float})
    spec = data["spec"]
    typed(spec, dict.fromkeys(("number", "seed", "max_steps"), int))
    typed_where_there(spec, _SPEC)
    typed({"events": data.get("events")}, {"events": dict | None})
    typed(data.get("events") or {}, dict.fromkeys(data.get("events") or (), int))
    for planned in (data.get("disturbances"), spec.get("disturbances")):
        check_disturbances(planned)
    typed_where_there(data, dict.fromkeys(("log_likelihood", "danger"), float | None))
    typed_where_there(data, {"setup_steps": int | None})
    parts = (data.get("collision"), data.get("failure"), data.get("escape"), data.get("event"))
    check_parts(data.get("closest", {}), *parts)
    if min(data["steps"], data.get("setup_steps") or 0, spec["number"], spec["seed"], spec["max_steps"]) < 0:
        raise ValueError("a number is below 0")


def check_disturbances(disturbances: Sequence[JsonObject] | None) -> None:
    """See the same of a list of disturbances, where there is one.

    Raises:
        ValueError: with what is not as it should be.
    """
    typed({"disturbances": disturbances}, {"disturbances": list | None})
    for one in disturbances or ():
        typed({"disturbance": one}, {"disturbance": dict})
        _check(one, Disturbance)
        if one["step"] < 1 or not math.isfinite(one["how_strong"]) or not 0 < one["how_long"] < math.inf:
            raise ValueError("a disturbance is out of its range")


def check_parts(
    closest: object, collision: object, failure: object, escape: object = None, event: object = None
) -> None:
    """See the same of what a trial ended with, where anything is there.

    Raises:
        ValueError: with what is not as it should be.
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
