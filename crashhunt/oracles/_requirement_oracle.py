"""The oracle of requirements, which detects that a formula of temporal logic is violated."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING, Annotated

from crashhunt.base.errors import CrashhuntError, FormulaError, UnusableValueError, UsageError
from crashhunt.base.text import did_you_mean, format_time
from crashhunt.oracles._protocol import REQUIREMENT, Finding, SignalSource
from crashhunt.requirements import TRAFFIC_RULES, Monitor, parse
from crashhunt.trial import MAX_ROBUSTNESS, Argument, Outcome
from crashhunt.world import Event

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    import numpy as np
    from numpy.typing import NDArray

    from crashhunt.requirements import Violation
    from crashhunt.trial import Category, TrialResult
    from crashhunt.world import Scene

_TITLE = re.compile(r"\s*([^\W\d]\w*)\s*=(?!=)\s*(.*)", re.DOTALL)
_parsed = cache(parse)  # once per process, because each trial creates the oracle


class RequirementOracle:
    """Detects that a requirement is violated, at the step at which this is certain, or at the end of the trial.

    Each controlled vehicle has to satisfy the requirement, unless all of its signals name a vehicle.
    """

    name = REQUIREMENT
    outcomes: Mapping[str, Category] = {REQUIREMENT: "traffic event"}

    def __init__(
        self,
        title: Annotated[str, Argument("title", help="name of the requirement")] = REQUIREMENT,
        formula: Annotated[str, Argument("formula", help="what must hold, in temporal logic")] = "true",
    ) -> None:
        self._title = title
        self._requirement = _parsed(formula)
        self._watched: list[_Watched] = []
        self._has_begun = self._is_held = False
        self._violated: list[_Watched] = []  # in this step
        self._at_start: list[Finding] = []  # a trial cannot end before its first step, so they are returned after it

    def read_signals(self, source: SignalSource, agents: Sequence[str]) -> None:
        """Begin to monitor the requirement for each agent."""
        names = self._requirement.signals
        named = {agent for agent in agents for name in names if name.startswith(f"{agent}.")}
        alone = bool(names) and all(any(name.startswith(f"{agent}.") for agent in named) for name in names)
        try:
            self._watched = [
                _Watched(agent, Monitor(self._requirement, source.step_length_s), source.reader(names, agent))
                for agent in (agents[:1] if alone else agents)
            ]
        except (FormulaError, UnusableValueError) as error:
            raise self._unusable(error) from None

    def check(self, scene: Scene, agents: Sequence[str]) -> list[Finding]:
        """Return a finding for each agent whose requirement is certainly violated."""
        found, self._at_start = self._at_start, []
        if not self._is_held:
            self._advance()
        self._is_held = False
        found += [self._finding(watched, scene) for watched in self._violated]
        self._violated.clear()
        if not self._has_begun:
            self._has_begun, self._at_start, found = True, found, []
        return found

    def watch(self) -> bool:
        """Read the signals of a step instead of `check`; return whether `check` must follow `hold` in this step."""
        self._advance()
        return bool(self._violated or self._at_start)

    def hold(self) -> None:
        """Keep the next `check` from reading the signals of the step, which `watch` has read."""
        self._is_held = True

    def _advance(self) -> None:
        for watched in self._watched:
            try:
                row = watched.read()
                if row is None or watched.is_violated:
                    continue
                watched.is_violated = watched.monitor.add(row)
            except (FormulaError, UnusableValueError) as error:
                raise self._unusable(error) from None
            if watched.is_violated:
                self._violated.append(watched)

    def check_end(self, scene: Scene, agents: Sequence[str]) -> list[Finding]:
        """Return a finding for each agent whose requirement is violated because the trial ends here."""
        found = []
        for watched in self._watched:
            if watched.monitor.count and not watched.is_violated:
                monitor = watched.monitor
                watched.is_violated = not self._requirement.satisfied(monitor.trace(), monitor.step_length_s)
                if watched.is_violated:
                    found.append(self._finding(watched, scene))
        return found

    def complete(self, result: TrialResult) -> TrialResult:
        """Add the least robustness of all agents to the result, and let it take the place of criticality."""
        traces = [(one.monitor.trace(), one.monitor.step_length_s) for one in self._watched if one.monitor.count]
        rows = [row for trace, step_s in traces for row in self._requirement.parts(trace, step_s)]
        if result.outcome is Outcome.INVALID or not rows:
            return result
        least = min(map(max, rows))
        danger = 1.0 if least <= 0 else 1 / (1 + least)
        if result.robustness is not None:  # of another requirement, which may be nearer to its violation
            danger = max(danger, result.danger or 0.0)
        robustness = {**(result.robustness or {}), self._title: least if math.isfinite(least) else None}
        slack_s = [one for trace, step_s in traces for one in self._requirement.slack_s(trace, step_s)]
        conjuncts = {**(result.conjuncts or {}), self._title: tuple(map(_limited, rows))}
        slacks = {**(result.slack_s or {}), self._title: _limited(slack_s)}
        return replace(result, robustness=robustness, danger=danger, conjuncts=conjuncts, slack_s=slacks)

    def comparisons(self) -> dict[str, tuple[int, dict[str, NDArray[np.float64]]]]:
        """Return the comparisons of the formula: by their text, the step of the first value, and both sides.

        With several agents, the name of the agent precedes the text.
        """
        return {
            f"{watched.agent}: {text}" if len(self._watched) > 1 else text: (watched.first, sides)
            for watched in self._watched
            if watched.monitor.count
            for text, sides in self._requirement.comparisons(
                watched.monitor.trace(), watched.monitor.step_length_s
            ).items()
        }

    def _unusable(self, error: CrashhuntError) -> UnusableValueError:
        what = "the requirement" if self._title == REQUIREMENT else f"the requirement {self._title}"
        return UnusableValueError(f"{what} cannot be evaluated: {error.message}", fix=error.fix)

    def _finding(self, watched: _Watched, scene: Scene) -> Finding:
        monitor, agent = watched.monitor, watched.agent
        trace, step_s = monitor.trace(), monitor.step_length_s
        robustness = self._requirement.robustness(trace, step_s)
        parts = self._requirement.explain(trace, step_s)
        text = " ".join(self._requirement.text.split())
        row = scene.roster.index.get(agent)
        x, y = (math.nan, math.nan) if row is None else scene.points[row]
        speed = math.nan if row is None else scene.speeds[row]
        event = Event(
            REQUIREMENT, agent, f"{agent} violates {self._title}: {text}",
            lane=scene.agent_lanes.get(agent, ""), x=x, y=y, speed=speed, name=self._title,
            details=(f"robustness {robustness:.4g}", *(_described(part, watched.first, step_s) for part in parts)),
        )  # fmt: skip
        return Finding(Outcome(REQUIREMENT), event=event)


def _limited(values: Iterable[float]) -> tuple[float, ...]:
    return tuple(max(-MAX_ROBUSTNESS, min(MAX_ROBUSTNESS, one)) for one in values)


class _Watched:
    """The requirement of one agent in a running trial."""

    def __init__(self, agent: str, monitor: Monitor, read: Callable[[], Sequence[float] | None]) -> None:
        self.agent, self.monitor, self._read = agent, monitor, read
        self.first = 0
        """Step of the first sample: 1 if a signal has no value before the first step."""
        self.is_violated = False

    def read(self) -> Sequence[float] | None:
        row = self._read()
        if row is None and not self.monitor.count:
            self.first += 1
        return row


def _described(part: Violation, first: int, step_s: float) -> str:
    """Return a line about a part of a violated formula."""
    begin, end, worst = part.first + first, part.last + first, part.worst + first
    when = f"at step {begin}" if begin == end else f"from step {begin} to {end}"
    when += f" ({format_time(begin * step_s, step_s)}" + (")" if begin == end else f" to {end * step_s:g} s)")
    values = ", ".join(f"{name} = {value:.6g}" for name, value in part.values.items())
    nearest = f"{'' if begin == end else f', at step {worst}'}: {values}" if values else ""
    return f"{' '.join(part.text.split())} is {'true' if part.holds else 'false'} {when}{nearest}"


def requirement_oracles(texts: Iterable[str], option: str = "--require") -> list[str]:
    """Return requirements in the form of oracles, ``requirement:TITLE=FORMULA``.

    Args:
        texts: requirements as ``TITLE=FORMULA``, a formula alone (which is called ``requirement``), or the name of a
            traffic rule.
        option: the option or key of the texts, for errors.

    Raises:
        FormulaError: a formula is invalid.
        UsageError: two requirements have the same name.
    """
    found: dict[str, str] = {}
    for text in texts:
        match = _TITLE.fullmatch(str(text))
        title, formula = (match[1], match[2]) if match else (REQUIREMENT, str(text))
        rule = TRAFFIC_RULES.get(formula.strip())
        if rule is not None:
            title, formula = title if match else rule.name.replace("-", "_"), rule.formula
        if match is None and rule is None and title in found:
            title = f"{REQUIREMENT}_{len(found) + 1}"
        if title in found:
            raise UsageError(f"{option}: {title!r} is given twice", fix="give each requirement another name")
        try:
            parse(formula)
        except FormulaError as error:
            error.where = f"{option} {title}" if match else option
            if similar := did_you_mean(formula.strip(), TRAFFIC_RULES):
                error.fix = f"{error.fix}; of the rules of crashhunt list requirements, {similar}"
            raise
        found[title] = " ".join(formula.split())
    return [f"{REQUIREMENT}:{title}={formula}" for title, formula in found.items()]


def check_requirement(oracle: str, step_length_s: float, max_steps: int, option: str = "--require") -> None:
    """Check that a requirement can be decided in a trial.

    The requirement is in the form of `requirement_oracles`. Errors name the option or key.

    Raises:
        FormulaError: a window does not fit the step length.
        UsageError: a window begins or ends after the last step, so the trial never decides the requirement.
    """
    title, _, formula = oracle.partition(":")[2].partition("=")
    requirement = parse(formula)
    try:
        requirement.require_windows(step_length_s)
    except FormulaError as error:
        error.where = f"{option} {title}"
        raise
    needed = requirement.horizon_s / step_length_s
    if needed > max_steps + 1e-6:
        raise UsageError(
            f"a trial never decides this requirement: its windows end {requirement.horizon_s:g} s after a sample, and "
            f"{max_steps} steps take {max_steps * step_length_s:g} s",
            fix=f"give MAX_STEPS of at least {math.ceil(needed - 1e-6)}, or shorter windows",
            where=f"{option} {title}",
        )
