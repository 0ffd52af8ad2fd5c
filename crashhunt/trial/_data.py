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

# The types of the plain data of a trial, which are checked before objects are built.

_TEXT_OR_NUMBER = bool | float | str | None


_SPECIFICATION_TYPES = {
    "arguments": dict[str, dict[str, _TEXT_OR_NUMBER]],
    "scenario_arguments": dict[str, _TEXT_OR_NUMBER],
}


def check_plain(data: JsonObject) -> None:
    """Check that JSON data has the types that `TrialResult.from_json` needs.

    Raises:
        ValueError: A value has a wrong type or range; the message names the value.
    """
    typed(data, {"outcome": str, "steps": int, "spec": dict})
    typed_where_there(data, {"sim_time_s": float, "digest": str, "wall_s": float})
    spec = data["spec"]
    typed(spec, dict.fromkeys(("number", "seed", "max_steps"), int))
    typed_where_there(spec, _SPECIFICATION_TYPES)
    typed({"events": data.get("events")}, {"events": dict | None})
    typed(data.get("events") or {}, dict.fromkeys(data.get("events") or (), int))
    for planned in (data.get("disturbances"), spec.get("disturbances")):
        check_disturbances(planned)
    typed_where_there(
        data, dict.fromkeys(("log_likelihood", "danger", "driven_m", "driven_s", "step_length_s"), float | None)
    )
    typed_where_there(data, {"setup_steps": int | None})
    parts = (data.get("collision"), data.get("failure"), data.get("escape"), data.get("event"))
    check_parts(data.get("closest", {}), *parts)
    if min(data["steps"], data.get("setup_steps") or 0, spec["number"], spec["seed"], spec["max_steps"]) < 0:
        raise ValueError("a count of steps, a trial number or a seed is below 0")


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
