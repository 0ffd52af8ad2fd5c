"""The output of each command with ``--json`` as JSON Schema, in one file per command in ``reference/schemas``.

Types that other modules declare are imported from these modules. All further types are declared here; tests validate
all real outputs.
"""

from __future__ import annotations

import ast
import inspect
import json
import sys
from collections.abc import Mapping, Sequence, Set as AbstractSet
from dataclasses import fields, is_dataclass
from enum import Enum
from functools import cache, cached_property
from pathlib import Path
from types import NoneType, UnionType
from typing import (
    Any,
    ForwardRef,
    Literal,
    NotRequired,
    Required,
    TypedDict,
    Union,
    get_args,
    get_origin,
    get_type_hints,
    is_typeddict,
)

from crashhunt.analysis import Counts, Shrunk
from crashhunt.base.binaries import BinaryFacts
from crashhunt.base.codec import JsonObject, Serializable, names_of_tuple, written_keys
from crashhunt.base.json_types import ErrorData, Plain
from crashhunt.base.program_message_types import ProgramAnswer, ProgramRequest, RoadMapData
from crashhunt.corpus import Bisected, CaseReport
from crashhunt.crashes import COMPETENT_DRIVERS, CrashSummary, Fault, Group, Judgement, Note, TrustedOrigin
from crashhunt.hunts import AuditReport, Checked, SignalList, StoppedBecause
from crashhunt.ledger import KindData
from crashhunt.replays import ReplayReport
from crashhunt.report import ListingEntry
from crashhunt.results import HuntState
from crashhunt.statistics import Comparison, CrashRate, Interval, PairVerdict
from crashhunt.sumo.maps import PlainRun
from crashhunt.training import Split

# JSON Schema (draft 2020-12) for the dataclasses that `crashhunt.base.codec` writes, and for typed dictionaries.
#
# Additional keys are allowed everywhere, because later versions may add keys.


_JSON_TYPES = {bool: "boolean", int: "integer", float: "number", str: "string", NoneType: "null"}


def json_schema(kind: object, title: str) -> JsonObject:
    """Return the JSON schema of a type, with its title and the schema dialect.

    Args:
        kind: a `Serializable` dataclass, a `TypedDict`, or a type made of these. A dict of types describes an object:
            a key with a question mark is not always there, and the key ``**`` adds the keys of its type. A list of one
            type describes an array, and a tuple a choice of types.
        title: title of the schema.

    Raises:
        NameError: an annotation uses a name that its module lacks.
    """
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": title, **describe_type(kind)}


def describe_type(hint: Any) -> JsonObject:
    """Return the JSON schema of a type; ``{}``, which allows everything, if the type has several forms in JSON."""
    origin, inner = get_origin(hint), get_args(hint)
    if origin in (Required, NotRequired):
        return describe_type(inner[0])
    if origin in (Union, UnionType):
        return _any_of([describe_type(choice) for choice in inner])
    if origin is Literal:
        return {"enum": list(inner)}
    if isinstance(hint, tuple):
        return _any_of([describe_type(choice) for choice in hint])
    if isinstance(hint, list):
        return {"type": "array", "items": describe_type(hint[0])}
    if isinstance(hint, dict):
        return _of_keys(hint)
    if is_typeddict(hint):
        hints = get_type_hints(hint, *_names(hint), include_extras=True)
        # `__required_keys__` has every key where annotations are strings.
        optional = {key for key in hints if get_origin(hints[key]) is NotRequired or not hint.__total__}
        return _of_keys({f"{key}?" if key in optional else key: hints[key] for key in hints})
    kind = hint if origin is None else origin
    if kind is None:
        return {"type": "null"}
    if not isinstance(kind, type):
        return {}
    if kind in _JSON_TYPES:
        return {"type": _JSON_TYPES[kind]}
    if issubclass(kind, Enum):  # one that makes members of unknown values has no list of all
        return {"type": "string"} if "_missing_" in vars(kind) else {"enum": [str(member) for member in kind]}
    if issubclass(kind, Path):
        return {"type": "string"}
    if issubclass(kind, Serializable) and is_dataclass(kind):
        return _of_dataclass(kind)
    if issubclass(kind, Mapping):
        return {"type": "object", "additionalProperties": describe_type(inner[-1])} if inner else {"type": "object"}
    if names := names_of_tuple(kind):
        hints = {name: _type_at(kind, name) for name in names}
        return _of_keys({name: one | None if one is float else one for name, one in hints.items()})
    if issubclass(kind, tuple) and inner and inner[-1] is not Ellipsis:
        items = [describe_type(item) for item in inner]
        return {"type": "array", "prefixItems": items, "minItems": len(items), "maxItems": len(items)}
    if issubclass(kind, Sequence | AbstractSet):
        return {"type": "array", "items": describe_type(inner[0])} if inner else {"type": "array"}
    return {}


def _of_keys(keys: Mapping[str, object]) -> JsonObject:
    """Return the schema of an object from the type of each key; see `json_schema`."""
    properties: JsonObject = {}
    required: list[str] = []
    for key, hint in keys.items():
        described = describe_type(hint)
        if key == "**":
            properties |= described["properties"]
            required += described.get("required", ())
        else:
            properties[key.removesuffix("?")] = described
            required += [key] if not key.endswith("?") else []
    found: JsonObject = {"type": "object", "properties": properties}
    return {**found, "required": sorted({*required})} if required else found


def _of_dataclass(kind: Any) -> JsonObject:
    if kind.to_json is not Serializable.to_json:  # writes other keys than its fields
        return {"type": "object"}
    known, keys = {item.name: item for item in fields(kind)}, {}
    for key, path, is_optional in written_keys(kind):
        metadata = known[key].metadata if key == path and key in known else {}
        hint = _type_at(kind, path)
        if is_optional:
            hint = Union[tuple(choice for choice in get_args(hint) if choice is not NoneType)]  # noqa: UP007
        is_optional = is_optional or bool({"omit_default", "written_if"} & {*metadata})
        keys[f"{key}?" if is_optional else key] = hint
    return _of_keys(keys)


def _type_at(kind: Any, path: str) -> Any:
    """Return the type of an attribute of a class, or of an object inside it such as ``bundle.id``."""
    name, _, rest = path.partition(".")
    owner = next(base for base in kind.__mro__ if name in {**vars(base), **vars(base).get("__annotations__", {})})
    held = vars(owner).get(name)
    getter = held.fget if isinstance(held, property) else held.func if isinstance(held, cached_property) else None
    annotation = vars(owner)["__annotations__"][name] if getter is None else getter.__annotations__.get("return", Any)
    if isinstance(annotation, ForwardRef):  # of a named tuple
        annotation = annotation.__forward_arg__
    hint = eval(annotation, *_names(owner)) if isinstance(annotation, str) else annotation
    if is_dataclass(owner) and any(item.name == name and "null" in item.metadata for item in fields(owner)):
        hint |= None
    if not rest:
        return hint
    if rest.isdigit():
        return get_args(hint)[int(rest)]
    choices = [choice for choice in get_args(hint) or [hint] if choice is not NoneType]
    inner = _type_at(choices[0], rest)
    return inner | None if NoneType in get_args(hint) else inner


def _names(kind: Any) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the names of the module of a class, with those that it imports for the type checker only."""
    return vars(sys.modules[kind.__module__]), _names_for_type_checkers(kind.__module__)


@cache
def _names_for_type_checkers(module: str) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for node in ast.parse(inspect.getsource(sys.modules[module])).body:
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            exec(ast.unparse(ast.Module(node.body, [])), found)
    return found


def _any_of(choices: list[JsonObject]) -> JsonObject:
    if {} in choices:
        return {}
    plain = [choice["type"] for choice in choices if choice.keys() == {"type"} and choice["type"] != "object"]
    others = [choice for choice in choices if choice.keys() != {"type"} or choice["type"] == "object"]
    merged = [{"type": plain[0] if len(plain) == 1 else plain}] if plain else []
    return others[0] if len(others) == 1 and not merged else merged[0] if not others else {"anyOf": [*others, *merged]}


class EventCount(TypedDict):
    """The number of traffic events of a type, and of trials with such an event."""

    count: int
    trials: int


_RUN = {
    "dir": str,
    "hunt_seed": int,
    "trials_planned": int,
    "trials_run": int,
    "outcomes": dict[str, int],
    "stopped_because": StoppedBecause,
    "wall_s": float,
    "steps_total": int,
    "events": dict[str, EventCount],
    "crashes_found": int,
    "crashes": list[CrashSummary],
    "notes": list[str],
    "audit": AuditReport | None,
    "unanswered": int,
    "unconfirmed": int,
    "probes?": JsonObject,
    "branches?": JsonObject,
    "kinds?": list[KindData],
    "near_misses?": list[CrashSummary],
    "at_fault?": list[int],
    "copied?": str,
    "rare?": JsonObject,
    "rate?": CrashRate,
    "code_versions?": list[JsonObject],
}
_CRASH_GROUP = {
    "**": Group,
    "known?": str | None,
    "known_by?": Literal["cause", "type"] | None,
    "new_causes?": list[str],
    "causes?": list[JsonObject],
}
_INIT = {
    "dir": str,
    "map": str,
    "lanes_km": float,
    "roads": int,
    "junctions": int,
    "traffic_lights": int,
    "crossings": int,
    "routes": int,
    "ego_routes": int,
    "vehicles_per_hour": float,
    "plain": list[PlainRun],
    "trial": ({"outcome": str, "steps": int, "wall_s": float}, None),
    "max_steps": int,
    "notes": list[str],
    "next": list[str],
}
_MOMENT = {
    "step": int,
    "time_s": float,
    "speed": float | None,
    "other_speed": float | None,
    "closing_speed": float | None,
    "gap_to_other_m": float | None,
    "time_to_other_s": float | None,
    "time_to_collision_s": float | None,
    "gap_m": float | None,
    "required_deceleration": float | None,
    "action": list[float] | str | None,
}
_GREATEST_DANGER = {"over_the_trial": float, "greatest": float, "step": int | None, "other": str | None}
_DANGER = {
    "ranked_by": float,
    "own": _GREATEST_DANGER,
    "from_behind": _GREATEST_DANGER,
    "steps": [{"step": int, "own": float | None, "from_behind": float | None}],
}
_SHOW = {
    "crash": str,
    "summary": str,
    "agent": str,
    "other": str,
    "words": list[str],
    "full_braking": float | None,
    "last_escape_step": int | None,
    "braking": {
        "by": Literal["running it", "calculation"] | None,
        "how": str | None,
        "too_late_step": int | None,
        "why_not": str,
    },
    "judged": Judgement | None,
    "fault": Fault,
    "nearest": ({"step": int, "danger": float, "agent": str, "other": str}, None),
    "danger": (_DANGER, None),
    "moments": [_MOMENT],
    "signals?": dict[str, JsonObject],
    "notes?": list[Note],
    "programs?": dict[str, BinaryFacts],
}
_BOTH = {"base": int, "head": int}
_INVALID_PAIRS = {"invalid": int, "not_started": _BOTH, "killed": _BOTH, "unknown": _BOTH}
_GATE = {
    **_INVALID_PAIRS,
    "verdict": PairVerdict,
    "pairs": int,
    "base": CrashRate | None,
    "head": CrashRate | None,
    "difference": Interval | None,
    "corpus": ({"ok": bool, "cases": int, "failed": list[str], "cannot_run": list[str]}, None),
    "compared": {"base": str, "head": str},
    "only_base": int,
    "only_head": int,
    "both": int,
    "evidence": float | None,
    "margin": float,
    "confidence": float,
    "seed": int | None,
    "scenarios": [{**_INVALID_PAIRS, "name": str, "pairs": int, "only_base": int, "only_head": int, "both": int}],
    "crash_types": [{**_BOTH, "type": str}],
    "cautions": list[str],
    "why": str,
    "interrupted": bool,
    "dir": str | None,
    "trained_on": int,
    "preventable?": dict[str, int],
}
_CASES = {
    "cases": [
        {
            "path": str,
            "expected": Literal["still", "fixed"],
            "note": str,
            "crash": str,
            "bytes": int,
            "log": bool,
            "new?": bool,
        }
    ]
}
_SCORED = {
    "cases": int,
    "share": float | None,
    "interval": list[float] | None,
    "random_cases": int,
    "found": int,
}
_SCORED_BY_MODEL = dict.fromkeys(COMPETENT_DRIVERS, (_SCORED, None))
_AXIS = {"name": str, "unit": str, "values": list[Any]}
_SCORECARD_MAP = {
    "fixed": JsonObject,
    "x": _AXIS,
    "y": _AXIS,
    "ran": list[list[bool]],
    "agent": list[list[bool]] | None,
    "drivers": dict[str, list[list[bool]]],
}
_SCORECARD_HUNT = {
    "dir": str,
    "state": str,
    "seed": int,
    "scenario_digest": str,
    "snapshot": str,
    "trials": int,
    "trials_digest": str,
    "versions": dict[str, str],
}
_SCORECARD = {
    "suite": str,
    "agent": str,
    "crashhunt": str,
    "method": Literal["grid", "boundary"],
    "steps": int,
    "complete": bool,
    "cases": int,
    "ran": int,
    "preventable_by": _SCORED_BY_MODEL,
    "groups": [
        {
            "id": str,
            "scenario": str,
            "paragraph": str,
            "cases": int,
            "ran": int,
            "invalid": int,
            "crashes": int | None,
            "crashes_of_drivers": dict[str, int | None],
            "preventable_by": _SCORED_BY_MODEL,
            "why_not": str,
            "hunts": [_SCORECARD_HUNT],
            "maps": [_SCORECARD_MAP],
        }
    ],
}
_LISTED_CRASHES = {
    "crashes": list[str],
    "crashes_found": int,
    "crashes_saved": int,
    "near_misses?": list[str],
    "near_misses_saved?": int,
}
_NOTE = {"hunt": str, "**": Note}
_TOPIC = {"topic": str, "section": str, "title": str}
_DIVERGENCE = {"step": int, "agent": str, "field": str, "recorded": Any, "replayed": Any}
_REPLAY = {"**": ReplayReport, "divergence": (_DIVERGENCE, None), "table?": list[Plain]}

SCHEMAS: dict[str, object] = {
    "run": _RUN,
    "init": (_INIT, {"dir": str, "scenario": str, "read": dict[str, str], "not_read": list[str]}),
    "replay": ({**_REPLAY, "written?": dict[str, int]}, {"crashes": [_REPLAY], "written": dict[str, int]}),
    "show": _SHOW,
    "report": {"file": str, "bytes": int, **_LISTED_CRASHES},
    "dashboard": {"url": str, "host": str, "port": int, "token": str},
    "export": {
        "crash": str,
        "file": str,
        "bytes": int,
        "as?": Literal["openscenario", "commonroad"],
        "actors?": dict[str, list[str | int]],
    },
    "suite-run": {"hunts": list[HuntState], "groups?": [_CRASH_GROUP], "not_compared?": list[str]},
    "status": {"hunts": list[HuntState]},
    "rerun": {"hunts": list[HuntState], "replaced": list[str]},
    "crashes": {
        "groups": [_CRASH_GROUP],
        "types_by_cause?": int,
        "by_cause?": list[JsonObject],
        "left_out": list[str],
        "code_versions?": dict[str, dict[str, dict[str, int]]],
        "notes?": [_NOTE],
    },
    "judge": {"judged": [{"**": Judgement, "crash": str}]},
    "whatif": Counts,
    "shrink": Shrunk,
    "corpus-add": _CASES,
    "corpus-run": {"cases": list[CaseReport]},
    "corpus-list": _CASES,
    "bisect": Bisected,
    "trust": ({"trusted": list[TrustedOrigin]}, {"removed": list[TrustedOrigin]}),
    "note": ({"notes": [_NOTE]}, {"added": [_NOTE]}, {"removed": [_NOTE]}),
    "check": {"fine": bool, "hunts": list[Checked], "salvaged": ({"trials": int, "crashes": int}, None)},
    "split": Split,
    "compare": Comparison,
    "gate": _GATE,
    "rate": {"rates": list[CrashRate]},
    "scorecard": _SCORECARD,
    "list": {
        "agents?": list[ListingEntry],
        "disturbances?": list[ListingEntry],
        "observations?": list[ListingEntry],
        "oracles?": list[ListingEntry],
        "requirements?": list[ListingEntry],
        "scenarios?": list[ListingEntry],
    },
    "signals": SignalList,
    "guide": ({"topics": [{**_TOPIC, "heading?": str}]}, {**_TOPIC, "text": str}),
    "error": ErrorData,
}
"""Every command that has ``--json``, with the type of its output; ``error`` is the output of each if it fails."""


MESSAGES: dict[str, tuple[str, object]] = {
    "messages/exec-request": ("Message of crashhunt to the program of an agent (protocol 1)", ProgramRequest),
    "messages/exec-answer": ("Message of the program of an agent to crashhunt (protocol 1)", ProgramAnswer),
    "messages/road-map": ("Road map for agents that are not Python", RoadMapData),
}
"""The messages that crashhunt exchanges with other programs, each with the title of its schema."""


def describe_schemas() -> dict[str, str]:
    """Return the text of each schema file, by the file's name without its ending."""
    titled = {name: (f"crashhunt {name.replace('-', ' ')} --json", kind) for name, kind in SCHEMAS.items()}
    return {
        name: json.dumps(json_schema(kind, title), indent=1) + "\n"
        for name, (title, kind) in (titled | MESSAGES).items()
    }
