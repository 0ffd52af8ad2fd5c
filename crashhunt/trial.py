"""What a trial is asked, and what it answers: plain, frozen, small, expressible as JSON."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING, Any

from crashhunt.events import EVENT_WORDS, Event
from crashhunt.integrity import typed
from crashhunt.text import encodable

if TYPE_CHECKING:
    from collections.abc import Mapping

    from crashhunt.space import Value

__all__ = [
    "CRASHES",
    "EVENTS",
    "ClosestApproach",
    "Collision",
    "Escape",
    "Failure",
    "Outcome",
    "Overruled",
    "TrialResult",
    "TrialSpec",
    "check_parts",
    "check_plain",
    "finite",
]


class Outcome(StrEnum):
    """How a trial ended."""

    SURVIVED = "survived"
    FINISHED = "finished"
    COLLISION = "collision"
    OFF_ROAD = "off_road"
    RED_LIGHT = "red_light"
    WRONG_WAY = "wrong_way"
    OFF_ROUTE = "off_route"
    NOT_MOVING = "not_moving"
    OTHERS_COLLIDED = "others_collided"
    HARD_BRAKING = "hard_braking"
    TELEPORT = "teleport"
    AGENT_ERROR = "agent_error"
    SIMULATOR_ERROR = "simulator_error"
    PROCESS_DIED = "process_died"
    HANG = "hang"
    INVALID = "invalid"

    @property
    def is_traffic_crash(self) -> bool:
        """Whether the vehicle did harm on the road."""
        return self in (Outcome.COLLISION, Outcome.OFF_ROAD)

    @property
    def is_traffic_event(self) -> bool:
        """Whether it is something of the traffic that ends a trial only where somebody asked for it."""
        return str(self) in EVENT_WORDS

    @property
    def is_software_fault(self) -> bool:
        """Whether a program failed, not the driving."""
        return self in (Outcome.AGENT_ERROR, Outcome.SIMULATOR_ERROR, Outcome.PROCESS_DIED, Outcome.HANG)

    @property
    def category(self) -> str:
        """What a report calls it: ``traffic crash``, ``traffic event``, ``software fault`` or ``no crash``."""
        if self.is_traffic_crash:
            return "traffic crash"
        if self.is_traffic_event:
            return "traffic event"
        return "software fault" if self.is_software_fault else "no crash"


CRASHES = tuple(outcome for outcome in Outcome if outcome.is_traffic_crash or outcome.is_software_fault)
"""The outcomes that count as a crash unless ``--crash-on`` says otherwise."""

EVENTS = tuple(outcome for outcome in Outcome if outcome.is_traffic_event)
"""The outcomes that count as a crash only where ``--crash-on`` names them; they are recorded in any case."""


@dataclass(frozen=True, slots=True)
class Overruled:
    """A trial in which the code of an agent is no longer asked: its vehicle brakes as hard as it can.

    Args:
        agent: whose.
        after: the step after which it brakes; its first decision that is not its own is the one of the next step.
    """

    agent: str
    after: int


@dataclass(frozen=True, slots=True)
class TrialSpec:
    """Everything that determines one trial.

    Args:
        number: its place in the hunt, from 0.
        seed: for the simulator, the agents and the global generators; 0 to 2**31 - 1.
        arguments: agent id to argument name to value.
        scenario_arguments: name to value.
        max_steps: the bound on its length, in steps.
        overruled: which agent is not asked any more, and from when on; None where all drive to the end.
    """

    number: int
    seed: int
    arguments: Mapping[str, Mapping[str, Value]]
    scenario_arguments: Mapping[str, Value]
    max_steps: int
    overruled: Overruled | None = None

    def to_json(self) -> dict[str, Any]:
        """Return plain dicts and numbers."""
        return {
            "number": self.number,
            "seed": self.seed,
            "arguments": {agent: dict(values) for agent, values in self.arguments.items()},
            "scenario_arguments": dict(self.scenario_arguments),
            "max_steps": self.max_steps,
            **({"overruled": asdict(self.overruled)} if self.overruled else {}),
        }

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> TrialSpec:
        """Rebuild what `to_json` returned."""
        overruled = data.get("overruled")
        return cls(
            data["number"],
            data["seed"],
            data["arguments"],
            data["scenario_arguments"],
            max_steps=data["max_steps"],
            overruled=Overruled(**overruled) if overruled else None,
        )


@dataclass(frozen=True, slots=True)
class ClosestApproach:
    """How near to a crash a trial came, each over all steps, controlled vehicles and other actors.

    Args:
        time_to_collision_s: the least, at constant velocities; infinite where no course ever crossed.
        gap_m: the least distance to the outline of any other actor, the nearest gap; 0 where they touched.
        required_deceleration: the greatest needed to avoid a collision, in m/s².
    """

    time_to_collision_s: float = math.inf
    gap_m: float = math.inf
    required_deceleration: float = 0.0

    def to_json(self) -> dict[str, float | None]:
        """Return plain numbers; JSON has no infinity, so an approach that never happened is null."""
        return {name: value if math.isfinite(value) else None for name, value in asdict(self).items()}

    @classmethod
    def from_json(cls, data: Mapping[str, float | None]) -> ClosestApproach:
        """Rebuild what `to_json` returned."""
        return cls(**{name: math.inf if value is None else value for name, value in data.items()})


@dataclass(frozen=True, slots=True)
class Collision:
    """Who hit whom, or who left the road.

    Args:
        agent: the controlled vehicle that it happened to.
        role: its part: ``collider`` (it drove into the other), ``victim``, or ``alone``.
        collider: the actor that drove into the other.
        victim: the actor that was hit; empty where there was none.
        seen_by: the oracles that saw it, in order of their names. Where one of the simulator's own
            report and the overlap of outlines is missing, the two disagree.
        kind: the simulator's word for it, such as ``collision`` or ``junction``.
        x: of the controlled vehicle's front bumper, in m.
        y: likewise.
        lane: where the controlled vehicle was.
        collider_speed: at the first contact, in m/s.
        victim_speed: likewise.
        time_s: simulation time of the first contact, which lies within the step; NaN where nobody knows.
    """

    agent: str
    role: str
    collider: str
    victim: str = ""
    seen_by: tuple[str, ...] = ()
    kind: str = ""
    x: float = math.nan
    y: float = math.nan
    lane: str = ""
    collider_speed: float = math.nan
    victim_speed: float = math.nan
    time_s: float = math.nan

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Collision:
        """Rebuild it from plain data, in which null stands for a number that nobody knows."""
        values: dict[str, Any] = {name: math.nan if value is None else value for name, value in data.items()}
        return cls(**values | {"seen_by": tuple(data["seen_by"])})


@dataclass(frozen=True, slots=True)
class Escape:
    """Until when the agent's brakes would have avoided a collision, found out by running the trial again.

    Args:
        step: braking as hard as it can after this step avoids the collision; None where no such step was found.
        too_late: after this step it does not; it is the next one, unless there is no such step.
        braking: the greatest deceleration of those runs, in m/s²; None where it never slowed down.
        how: how it brakes, in words; one of `FullBraking`.
    """

    step: int | None
    too_late: int | None
    braking: float | None
    how: str


@dataclass(frozen=True, slots=True)
class Failure:
    """What a program did wrong.

    Args:
        kind: the exception's type, ``exit code``, ``signal`` or ``timeout``.
        message: in one line.
        traceback: of the exception, or the stack of the stuck thread.
        agent: the agent in whose code it happened; empty where it was not an agent's.
        exit_code: of a process that died; negative for a signal, as in `subprocess`.
        last_output: what the process printed last.
    """

    kind: str
    message: str
    traceback: str = ""
    agent: str = ""
    exit_code: int | None = None
    last_output: str = ""

    def __post_init__(self) -> None:
        # It goes into JSON, a log and onto terminals, and what an exception says may be no valid text.
        for name in ("kind", "message", "traceback", "last_output"):
            object.__setattr__(self, name, encodable(getattr(self, name)))


@dataclass(frozen=True, slots=True)
class TrialResult:
    """What came of one trial.

    Args:
        spec: what was asked.
        outcome: how it ended.
        steps: how many steps were completed; for a crash, the step at which it happened.
        sim_time_s: simulation time at the end, in s.
        digest: BLAKE2b over everything recorded, in hexadecimal; equal digests mean runs equal to the bit.
        closest: how near to a crash it came.
        collision: the evidence of a traffic crash.
        event: the evidence of a traffic event that somebody asked for.
        failure: the evidence of a software fault, or why the episode is invalid.
        wall_s: how long it took, in s of wall time.
        setup_s: the part of it before the first step.
        worker: the process id.
        kept: whether the worker left its scratch folder for the hunt to collect.
        escape: until when braking would have avoided it; None where nobody tried, or where it cannot be told.
        events: how many traffic events of which kind there were; None where nobody looked.
    """

    spec: TrialSpec
    outcome: Outcome
    steps: int = 0
    sim_time_s: float = 0.0
    digest: str = ""
    closest: ClosestApproach = field(default_factory=ClosestApproach)
    collision: Collision | None = None
    failure: Failure | None = None
    wall_s: float = 0.0
    setup_s: float = 0.0
    worker: int = 0
    kept: bool = False
    escape: Escape | None = None
    event: Event | None = None
    events: Mapping[str, int] | None = None

    def to_json(self) -> dict[str, Any]:
        """Return plain dicts, strings and numbers; what is not a finite number is null."""
        data = {name: getattr(self, name) for name in _PLAIN}
        return {
            **data,
            "outcome": str(self.outcome),
            "spec": self.spec.to_json(),
            "closest": self.closest.to_json(),
            "collision": finite(asdict(self.collision)) if self.collision else None,
            "failure": asdict(self.failure) if self.failure else None,
            "escape": asdict(self.escape) if self.escape else None,
            "event": self.event.to_json() if self.event else None,
            "events": dict(self.events) if self.events is not None else None,
        }

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> TrialResult:
        """Rebuild what `to_json` returned."""
        hit, failure, event, escape = data["collision"], data["failure"], data.get("event"), data.get("escape")
        return cls(
            spec=TrialSpec.from_json(data["spec"]),
            outcome=Outcome(data["outcome"]),
            closest=ClosestApproach.from_json(data["closest"]),
            collision=Collision.from_json(hit) if hit else None,
            failure=Failure(**failure) if failure else None,
            escape=Escape(**escape) if escape else None,
            event=Event.from_json(event) if event else None,
            events=data.get("events"),
            **{name: data[name] for name in _PLAIN},
        )

    @property
    def summary(self) -> str:
        """The outcome in one line, for people."""
        if self.collision is not None:
            hit = self.collision
            other = hit.victim if hit.role == "collider" else hit.collider
            if hit.role == "alone":
                what = "left the road" if self.outcome is Outcome.OFF_ROAD else f"crashed ({hit.kind})"
                return f"{hit.agent} {what} at step {self.steps}"
            verb = "drove into" if hit.role == "collider" else "was hit by"
            return f"{hit.agent} {verb} {other} at step {self.steps}"
        if self.event is not None:
            return f"{self.event.what}, at step {self.steps}"
        if self.failure is not None:
            failure = self.failure
            if failure.traceback and failure.exit_code is None and failure.kind != "timeout":
                whose = f"{failure.agent}: " if failure.agent else ""
                return f"{whose}{failure.kind}: {failure.message}"
            return failure.message
        return f"{self.outcome} after {self.steps} steps"


_PLAIN = ("steps", "sim_time_s", "digest", "wall_s", "setup_s", "worker", "kept")


def finite(data: dict[str, Any]) -> dict[str, Any]:
    """Return plain data for JSON, which has no infinity and no NaN: null instead."""
    return {
        name: None if isinstance(value, float) and not math.isfinite(value) else value for name, value in data.items()
    }


_TEXT_OR_NUMBER = bool | float | str | None
_SPEC = {
    "number": int,
    "seed": int,
    "max_steps": int,
    "arguments": dict[str, dict[str, _TEXT_OR_NUMBER]],
    "scenario_arguments": dict[str, _TEXT_OR_NUMBER],
}
_CLOSEST = dict.fromkeys(("time_to_collision_s", "gap_m", "required_deceleration"), float | None)
_COLLISION: dict[str, Any] = {
    **dict.fromkeys(("agent", "role", "collider", "victim", "kind", "lane"), str),
    **dict.fromkeys(("x", "y", "collider_speed", "victim_speed"), float | None),
    "seen_by": list[str],
}
_LATER = {"time_s": float | None}  # what earlier versions did not write
_FAILURE = {**dict.fromkeys(("kind", "message", "traceback", "agent", "last_output"), str), "exit_code": int | None}
_ESCAPE = {"step": int | None, "too_late": int | None, "braking": float | None, "how": str}
_EVENT: dict[str, Any] = {
    **dict.fromkeys(("kind", "agent", "what", "lane"), str),
    **dict.fromkeys(("x", "y", "speed"), float | None),
    "others": list[str],
}


def check_plain(data: Mapping[str, Any]) -> None:
    """See that plain data has the types that `TrialResult.from_json` takes for granted.

    Raises:
        ValueError: with what is not as it should be.
    """
    typed(data, {"outcome": str, "steps": int, "sim_time_s": float, "digest": str, "wall_s": float, "spec": dict})
    typed(data["spec"], _SPEC)
    typed({"events": data.get("events")}, {"events": dict | None})  # which there was not always
    typed(data.get("events") or {}, dict.fromkeys(data.get("events") or (), int))
    check_parts(data["closest"], data["collision"], data["failure"], data.get("escape"), data.get("event"))
    if min(data["steps"], *(data["spec"][name] for name in ("number", "seed", "max_steps"))) < 0:
        raise ValueError("a number is below 0")


def check_parts(closest: Any, collision: Any, failure: Any, escape: Any = None, event: Any = None) -> None:
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
        if part is not None:
            typed(part, types)
            typed(part, {key: kind for key, kind in _LATER.items() if key in part})
