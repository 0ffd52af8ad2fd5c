"""The output of each command with ``--json`` as JSON Schema, in one file per command in ``reference/schemas``.

Types that other modules declare are imported from these modules. All further types are declared here; tests validate
all real outputs.
"""

from __future__ import annotations

import json
from typing import Any, Literal, TypedDict

from crashhunt.analysis import Counts, Shrunk
from crashhunt.base.binaries import BinaryFacts
from crashhunt.base.codec import JsonObject
from crashhunt.base.json_schema import json_schema
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
