"""The types that the plain data of a trial must have before anything is made of it."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from crashhunt.base.integrity import typed
from crashhunt.base.tolerance import typed_where_there

if TYPE_CHECKING:
    from collections.abc import Sequence

    from crashhunt.base.plain import Plain
    from crashhunt.trial._data import DisturbanceData, ResultData

__all__ = ["check_disturbances", "check_parts", "check_plain"]


_TEXT_OR_NUMBER = bool | float | str | None


_SPEC = {
    "arguments": dict[str, dict[str, _TEXT_OR_NUMBER]],
    "scenario_arguments": dict[str, _TEXT_OR_NUMBER],
}


_CLOSEST = dict.fromkeys(("time_to_collision_s", "gap_m", "required_deceleration"), float | None)


_COLLISION: Plain = {
    **dict.fromkeys(("agent", "role", "collider", "victim", "kind", "lane"), str),
    **dict.fromkeys(("x", "y", "collider_speed", "victim_speed", "time_s"), float | None),
    "seen_by": list[str],
}


_FAILURE = {**dict.fromkeys(("kind", "message", "traceback", "agent", "last_output"), str), "exit_code": int | None}


_ESCAPE = {"step": int | None, "too_late": int | None, "braking": float | None, "how": str}


_DISTURBANCE: Plain = {
    "step": int,
    **dict.fromkeys(("who", "what"), str),
    **dict.fromkeys(("how_strong", "how_long"), float),
}


_EVENT: Plain = {
    **dict.fromkeys(("kind", "agent", "what", "lane"), str),
    **dict.fromkeys(("x", "y", "speed"), float | None),
    "others": list[str],
}


_NEEDED = {"collision": ("agent", "role", "collider"), "event": ("kind", "agent", "what")}


def check_plain(data: ResultData) -> None:
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


def check_disturbances(disturbances: Sequence[DisturbanceData] | None) -> None:
    """See the same of a list of disturbances, where there is one.

    Raises:
        ValueError: with what is not as it should be.
    """
    typed({"disturbances": disturbances}, {"disturbances": list | None})
    for one in disturbances or ():
        typed({"disturbance": one}, {"disturbance": dict})
        typed(one, _DISTURBANCE)
        typed_where_there(one, dict.fromkeys(("agent", "vehicle"), str))
        if one["step"] < 1 or not math.isfinite(one["how_strong"]) or not 0 < one["how_long"] < math.inf:
            raise ValueError("a disturbance is out of its range")


def check_parts(
    closest: object, collision: object, failure: object, escape: object = None, event: object = None
) -> None:
    """See the same of what a trial ended with, where anything is there.

    Raises:
        ValueError: with what is not as it should be.
    """
    for name, part, types in (
        ("closest", closest, _CLOSEST), ("collision", collision, _COLLISION), ("failure", failure, _FAILURE),
        ("escape", escape, _ESCAPE),
        ("event", event, _EVENT),
    ):  # fmt: skip
        typed({name: part}, {name: dict if name == "closest" else dict | None})
        if isinstance(part, dict):
            typed(part, {key: types[key] for key in _NEEDED.get(name, ())})
            typed_where_there(part, types)
