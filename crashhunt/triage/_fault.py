"""Whose fault a collision was: what rules with names and sources say, or that nobody can tell."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, TypedDict

from crashhunt.base import layout
from crashhunt.base.errors import BundleError, CrashhuntError
from crashhunt.snapshots import Snapshot
from crashhunt.triage._case import Case
from crashhunt.triage._fault_rules import RULES, Finding
from crashhunt.triage._lanes import LaneMap
from crashhunt.trial import Outcome

if TYPE_CHECKING:
    from collections.abc import Iterable

    from crashhunt.crashes import Bundle
    from crashhunt.recording import Recording
    from crashhunt.world import RightOfWay

__all__ = ["Fault", "FaultData", "Verdict", "fault_in", "fault_of"]

Verdict = Literal["ego", "the other", "both", "nobody can tell"]
_VERDICTS: dict[str, Verdict] = {"ego": "ego", "other": "the other", "both": "both"}
_FIRST = ("red light", "wrong way")
_EVENTS_S = 10.0  # before the crash


class FindingData(TypedDict):
    """What a rule says, as JSON."""

    rule: str
    blames: str
    words: str
    source: str


class FaultData(TypedDict):
    """A `Fault` as JSON."""

    verdict: Verdict
    findings: list[FindingData]


@dataclass(frozen=True, slots=True)
class Fault:
    """Whose fault a crash was.

    Args:
        verdict: ``ego`` is the controlled vehicle that it happened to.
        findings: of the rules that said something; they may contradict each other where nobody can tell.
    """

    verdict: Verdict
    findings: tuple[Finding, ...] = ()

    @property
    def is_egos(self) -> bool:
        """Whether it was the agent's fault, or both's."""
        return self.verdict in ("ego", "both")

    def to_json(self) -> FaultData:
        """Return plain data."""
        return {
            "verdict": self.verdict,
            "findings": [
                {"rule": one.rule, "blames": _VERDICTS[one.blames], "words": one.words, "source": one.source}
                for one in self.findings
            ],
        }


def fault_of(bundle: Bundle, recording: Recording | None = None) -> Fault:
    """Return whose fault a crash was; no code of the bundle is run.

    Args:
        bundle: the crash.
        recording: of it, where it has been read already.

    Raises:
        BundleError: its log is missing or damaged.
    """
    result = bundle.result
    hit = result.collision
    if result.outcome is Outcome.AGENT_ERROR:
        words = "the code of the agent failed"
        return Fault("ego", (Finding("agent error", "ego", words, "whoever drives answers for it"),))
    if result.outcome is Outcome.OFF_ROAD and hit is not None and not hit.other:
        words = "it left the road, and nobody touched it"
        return Fault("ego", (Finding("off the road", "ego", words, "Vienna, article 13 (1); StVO § 3 (1)"),))
    if result.outcome is not Outcome.COLLISION or hit is None or not hit.other:
        return Fault("nobody can tell")
    from crashhunt.recording import read_lanes  # MCAP takes longer than a list of software faults

    found = recording or bundle.recording()
    scenes = found.scenes()
    if not scenes or not all(name in scenes[-1].roster.index for name in (hit.agent, hit.other)):
        return Fault("nobody can tell")
    end_s = scenes[-1].time_s
    events = tuple(
        (step.scene.time_s, event)
        for step in found.all_steps
        if step.scene is not None and step.scene.time_s >= end_s - _EVENTS_S
        for event in step.scene.events
    )
    lanes = LaneMap(read_lanes(bundle.path / layout.LOG), (hit.x, hit.y))
    time_s = hit.time_s if end_s - found.prologue.step_length_s <= hit.time_s <= end_s else end_s
    return fault_in(
        Case(
            hit.agent, hit.other, scenes, time_s, scenes[0].time_s, lanes, events, _right_of_way(bundle), lane=hit.lane
        )
    )


def fault_in(case: Case) -> Fault:
    """Return what the rules say of a collision."""
    if case.time_s - case.began_s < 1.0 or len(case.before) < 2:
        return Fault("nobody can tell")  # it was put there
    findings = tuple(finding for rule in RULES if (finding := rule(case)) is not None)
    return Fault(_verdict(findings), findings)


def _verdict(findings: Iterable[Finding]) -> Verdict:
    found = list(findings)
    first = [one for one in found if one.rule in _FIRST]
    if first:
        found = [one for one in found if one.rule != "right of way"]
    blamed = {one.blames for one in found}
    return _VERDICTS[blamed.pop()] if len(blamed) == 1 else "nobody can tell"


def _right_of_way(bundle: Bundle) -> RightOfWay | None:
    try:
        scenario = Snapshot(bundle.hunt / layout.SNAPSHOTS / bundle.snapshot).scenario()
        ask = scenario.backend.right_of_way
        return ask(scenario) if ask is not None else None
    except (BundleError, CrashhuntError, OSError):
        return None
