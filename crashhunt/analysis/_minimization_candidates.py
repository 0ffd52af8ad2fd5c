"""The candidates of a minimization in their order, and the smallest candidate that still crashes."""

from __future__ import annotations

import math
from contextlib import contextmanager
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Literal

from crashhunt.analysis._delta_debugging import as_type_of, fewest, plainest, with_argument
from crashhunt.base.errors import CrashhuntError
from crashhunt.trial import ALL_AGENTS, SENSOR_KINDS, with_fewer_points
from crashhunt.trial_reruns import OutOfTimeError, StoppedError
from crashhunt.world import paths_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from crashhunt.analysis._minimization_runs import Runs
    from crashhunt.recording import Recording
    from crashhunt.replays import Rerun
    from crashhunt.trial import Disturbance, TrialSpec, Value


# The scripted form of a crash: other actors follow recorded paths, so removing one actor changes no other actor.


_BEFORE_S = (1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 20.0, 40.0)
"""How long before the crash it may begin, in s: tried in this order. A lane change is looked for 3 s back."""

_SEEN_LONGER_S = 1.0  # by which the crash may come later than it did: the others are seen no longer than that


@dataclass(frozen=True, slots=True)
class RemainingActors:
    """The actors of a crash that remain in a candidate."""

    agents: tuple[str, ...]  # identifiers of the agents that drive themselves
    others: tuple[str, ...]  # identifiers of the actors that follow recorded paths; they may include agents
    begin: int = 0  # the step of the recording at which the candidate begins

    @property
    def count(self) -> int:
        """The number of actors that take part."""
        return len(self.agents) + len(self.others)


class Scripting:
    """Creates trials with parts of a recorded crash."""

    def __init__(self, rerun: Rerun) -> None:
        recorded = rerun.recorded
        self._spec = rerun.spec
        self._step_s = recorded.prologue.step_length_s
        self._paths = paths_of(recorded.scenes(), recorded.agents)
        escape = rerun.bundle.result.escape
        # An agent that cannot avoid it any more is not tested: however it is mended, it crashes.
        self._latest = recorded.steps if escape is None or escape.step is None else escape.step
        self.whole = RemainingActors(recorded.agents, self._paths.names)

    @property
    def steps(self) -> int:
        """The number of recorded steps."""
        return self._paths.steps

    def spec(self, part: RemainingActors) -> TrialSpec:
        """Return the trial for the remaining actors, with the recorded arguments."""
        paths = self._paths.driven_by(part.agents).only(part.others)
        paths = paths.cut(part.begin, paths.steps, self._step_s).placing()
        disturbed = (one for one in self._spec.disturbances if one.what in SENSOR_KINDS and one.step > part.begin)
        return replace(
            self._spec,
            arguments={agent: given for agent, given in self._spec.arguments.items() if agent in part.agents},
            # What befell the others is in their ways.
            disturbances=tuple(replace(one, step=one.step - part.begin) for one in disturbed),
            only=None,
            script=paths,
            max_steps=paths.steps + max(1, round(_SEEN_LONGER_S / self._step_s)),
        )

    def begins(self, agents: Sequence[str]) -> list[int]:
        """Return the possible later starts, the latest first; no start is later than the last avoidable step."""
        known = [{step for step, _ in path.lanes} for path in self._paths.agents if path.actor.id in agents]
        steps = sorted(set.intersection(*known)) if known else []
        found = []
        for before_s in _BEFORE_S:
            latest = min(self._latest, self.steps - round(before_s / self._step_s))
            found += [step for step in steps if 0 < step <= latest][-1:]
        return list(dict.fromkeys(found))


def can_be_scripted(rerun: Rerun) -> bool:
    """Return whether the simulator can move other actors along recorded paths."""
    return rerun.worker.scenario.backend.plays_paths


Ended = Literal["done", "budget", "time", "interrupted", "error"]
Form = Literal["either", "traffic", "scripted"]
_MAX_RUNS = 3  # of a crash that does not come again at once
_MAX_FLAKY_RUNS = 10  # of one of which that is known
_NEAREST_TOGETHER = 6  # of the others, so many that are nearest in the end are tried together
_MAX_SINGLE_REMOVALS = 40  # and so many one by one
_MAX_SINGLE_REMOVALS_WITH_SCRIPT = 6  # where there is another way
_MAX_PAIRED_REMOVALS = 24  # so many that were near in the end are tried together with the other one
_LONGER_S = 5.0  # simulation time by which it may become longer, besides twice as long, where fewer take part
_FEW_ACTORS = 3  # actors; a crash with at most this number keeps the form in which the other actors drive


class Minimizer:
    """Minimizes a crash in several stages.

    Args:
        rerun: the crash to minimize.
        runs: object that runs the candidates.
        form: Whether the other actors drive; with ``either``, they drive if few of them remain.
        constructor_defaults: The defaults in the agents' own code, by agent and name. The defaults in the code take
            precedence over the defaults of the scenario, because the user sees them where the agent is fixed.
    """

    def __init__(
        self,
        rerun: Rerun,
        runs: Runs,
        form: Form,
        constructor_defaults: Mapping[tuple[str, str], Value] = MappingProxyType({}),
    ) -> None:
        self.best = rerun.spec  # the smallest candidate that crashed in the same manner
        # the minimized candidates that still crash, in the order in which they were found
        self.smaller: list[TrialSpec] = []
        self.reproduced = False  # whether the original crash itself reproduced
        self.notes: list[str] = []  # notes on stages that were not possible, as text
        self._rerun, self._runs, self._form = rerun, runs, form
        self._everybody: tuple[str, ...] = ()
        self._left_out = True
        self._shortest = self._steps = runs.most_steps
        self._defaults = {**rerun.defaults, **constructor_defaults}
        self._scripting = Scripting(rerun) if form != "traffic" and can_be_scripted(rerun) else None

    def run(self, stopped: Callable[[], bool]) -> tuple[Ended, str]:
        """Minimize until no stage helps; return why the search ended."""
        tries = _MAX_FLAKY_RUNS if self._rerun.bundle.confirmed is False else _MAX_RUNS
        try:
            for _ in range(tries):
                self.reproduced = self.reproduced or self._runs.first([self.best], again=True) is not None
            if not self.reproduced:
                return "done", f"it did not come again in {tries} runs"
            if self._form == "scripted" and self._scripting is None:
                title = self._rerun.worker.scenario.backend.title or "its simulator"
                return "done", f"{title} cannot move others along recorded ways, or not in the version of the snapshot"
            if self._scripting is None:
                self._smaller_traffic()
            else:
                self._smaller_in_either_form(self._scripting)
        except StoppedError as error:
            if stopped():
                return "interrupted", ""
            if isinstance(error, OutOfTimeError):
                return "time", "give --for more time to continue from here"
            return "budget", "give a larger --budget to continue from here"
        except CrashhuntError as error:
            if not self.reproduced:
                raise
            return "error", str(error)
        return "done", ""

    def _smaller_traffic(self) -> None:
        """Simplify arguments first, which takes few trials, then remove actors, which may take hundreds of trials."""
        self._everybody = self._runs.entered(replace(self.best, only=(ALL_AGENTS,)))  # of the crash as it was
        self._left_out = bool(self._everybody)
        if not self._left_out and _actors(self._rerun.recorded) - set(self._rerun.recorded.agents):
            self.notes.append("all others stay: the simulator, or the crashhunt of the snapshot, cannot exclude actors")
        self._plainer_arguments()
        self._until_nothing_helps(self._fewer_others)

    def _smaller_in_either_form(self, scripting: Scripting) -> None:
        if self._form == "either":
            self._fewer_others()
            if self.best.only is not None:
                self._until_nothing_helps(self._fewer_others)
        if self._wants_script():
            self._script(scripting)
        elif self._form == "either" and self._steps > self._shortest:
            self._begin_later(scripting)
        if self.best.only is None and self.best.script is None and self._form == "either":
            self._scripting = None
            self._until_nothing_helps(self._fewer_others)

    def _until_nothing_helps(self, fewer_others: Callable[[], None]) -> None:
        before = None
        while before != self.best:
            before = self.best
            fewer_others()
            self._fewer_disturbances()
            self._plainer_arguments()

    def _try(self, specs: Sequence[TrialSpec]) -> int | None:
        good = self._runs.first(specs)
        if good is not None:
            self.best = specs[good]
            self.smaller.append(self.best)
            self._steps = self._runs.found_steps
        return good

    @contextmanager
    def _no_longer(self) -> Iterator[None]:
        """Refuse candidates that crash later than the best candidate; steps count more than arguments."""
        before, self._runs.most_steps = self._runs.most_steps, min(self._runs.most_steps, self._steps)
        try:
            yield
        finally:
            self._runs.most_steps = before

    # With the traffic driving

    def _fewer_others(self) -> None:
        best = self.best

        def tried(some: Sequence[tuple[str, ...]]) -> int | None:
            return self._try([replace(best, only=one) for one in some])

        if best.only is not None:
            fewest(best.only, tried)
            return
        if not self._left_out:
            return
        if not self._everybody:
            self._everybody = self._runs.entered(replace(best, only=(ALL_AGENTS,)))
        if not self._everybody:
            self._left_out = False  # the simulator cannot do it
            return
        shortest, likely = self._shortest, self._first_groups()
        middle = min(best.max_steps, round(2 * shortest + _LONGER_S / self._rerun.recorded.prologue.step_length_s))
        lengths = dict.fromkeys((shortest, middle, best.max_steps))
        for most in lengths if self._scripting is None else (shortest, middle):
            self._runs.most_steps = most
            if (good := tried(likely)) is not None:
                fewest(likely[good], tried)
                return
        self._runs.most_steps = middle
        if self._scripting is None:
            fewest(self._everybody, tried)

    def _first_groups(self) -> list[tuple[str, ...]]:
        """Return groups of actors to keep at first: none, the collision partner, the nearest actors, single actors."""
        recording, known = self._rerun.recorded, set(self._everybody)
        near = [name for name in _nearest(recording, self._rerun.bundle.driver) if name in known]
        other = [name for name in self._others_of_the_crash() if name in known]
        single = near[: _MAX_SINGLE_REMOVALS if self._scripting is None else _MAX_SINGLE_REMOVALS_WITH_SCRIPT]
        groups = [(), tuple(other), tuple(near[:2]), *((name,) for name in single), tuple(near[:_NEAREST_TOGETHER])]
        return list(dict.fromkeys(groups))

    def _others_of_the_crash(self) -> list[str]:
        result = self._rerun.bundle.result
        named = (result.collision.other,) if result.collision else result.event.others if result.event else ()
        return [name for name in named if name]

    # With the others scripted

    def _wants_script(self) -> bool:
        best, agents = self.best, self._rerun.recorded.agents
        if self._form == "scripted" or best.only is None or len(agents) > 1:
            return True
        # Without other actors the scripted form loses nothing, and its beginning can be cut off.
        return not best.only or len(best.only) + len(agents) > _FEW_ACTORS

    def _script(self, scripting: Scripting) -> None:
        self._runs.most_steps = max(self._runs.most_steps, 2 * scripting.steps + 100)
        best, before = self.best, len(self.smaller)
        try:
            part = self._fewest_moved(scripting)
            if part is not None:
                later = [replace(part, begin=begin) for begin in scripting.begins(part.agents)]
                if (good := self._try([scripting.spec(one) for one in later])) is not None:
                    part = later[good]
                if part.count > _FEW_ACTORS:
                    self._fewer_from_later_on(scripting, part)
        finally:  # also where it is interrupted: the first that came again may have everybody in it
            if self.best is not best and not self._is_smaller(best):
                self.best = best
                del self.smaller[before:]
        if self.best.script is not None:  # where it begins later, or with plainer arguments, fewer may do
            self._until_nothing_helps(self._fewer_moved)

    def _begin_later(self, scripting: Scripting) -> None:
        """Move the few remaining actors along recorded paths, and begin as late as possible.

        Without the removed actors, the crash may take longer; a later beginning avoids that.
        """
        others = tuple(name for name in scripting.whole.others if name in (self.best.only or ()))
        agents = scripting.whole.agents
        whole = RemainingActors(agents, others)
        parts = [*(replace(whole, begin=begin) for begin in scripting.begins(agents)), whole]
        before, self._runs.most_steps = self._runs.most_steps, self._shortest
        try:
            if self._try([scripting.spec(part) for part in parts]) is not None:
                self._until_nothing_helps(self._fewer_moved)
        finally:
            self._runs.most_steps = before

    def _is_smaller(self, than: TrialSpec) -> bool:
        """Return whether the best specification is smaller than another one."""
        script = self.best.script
        if self._form == "scripted" or script is None or than.only is None:
            return True
        agents, others = len(script.agents), len(script.names)
        if agents < len(than.arguments) or agents + others < len(than.arguments) + len(than.only):
            return True
        return not than.only and self.steps_cut > 0

    def _fewer_moved(self) -> None:
        """Remove the actors without which the crash still reproduces."""
        best, script = self.best, self.best.script
        assert script is not None
        hit = self._rerun.bundle.result.collision
        if len(script.agents) == len(script.names) == 1 and hit is not None and hit.other:
            return  # without other actors there is no collision

        def tried(some: Sequence[tuple[str, ...]]) -> int | None:
            return self._try([replace(best, script=script.only(one)) for one in some])

        fewest(script.names, tried)

    def _fewest_moved(self, scripting: Scripting) -> RemainingActors | None:
        """Remove all unnecessary actors in scripted form; return None if the crash does not reproduce in this form."""
        whole, about = scripting.whole, self._rerun.bundle.driver
        near = [name for name in _nearest(self._rerun.recorded, about) if name not in whole.agents]
        other = tuple(self._others_of_the_crash())
        alone = (about,) if len(whole.agents) > 1 and about in whole.agents else ()
        likely: list[RemainingActors] = []
        for agents in dict.fromkeys((alone, whole.agents) if alone else (whole.agents,)):
            moved = [name for name in whole.agents if name not in agents]
            groups = [
                (),
                other,
                tuple(near[:1]),
                tuple(near[:2]),
                tuple(moved),
                tuple(near[:_NEAREST_TOGETHER]),
                (*moved, *near),
            ]
            groups = [tuple(name for name in group if name not in agents) for group in groups]
            likely += [RemainingActors(agents, group) for group in dict.fromkeys(groups)]
        likely.append(whole)
        good = self._try([scripting.spec(part) for part in likely])
        if good is None:
            return None
        found = likely[good]

        def tried(some: Sequence[tuple[str, ...]]) -> int | None:
            return self._try([scripting.spec(replace(found, others=one)) for one in some])

        return replace(found, others=fewest(found.others, tried))

    def _fewer_from_later_on(self, scripting: Scripting, part: RemainingActors) -> None:
        """Remove more actors with a later beginning; actors that mattered only before it are then unnecessary.

        The method first tries each other actor alone, and in a pair with the collision partner. Then the method starts
        again from all actors and removes all unnecessary actors. An agent that reacts to all visible actors may need
        other actors than with the original beginning.
        """
        begins = list(dict.fromkeys((part.begin, *scripting.begins(part.agents), 0)))
        whole = scripting.whole
        everybody = tuple(name for name in (*whole.agents, *whole.others) if name not in part.agents)
        near = _nearest(self._rerun.recorded, self._rerun.bundle.driver)
        near = [name for name in near if name in everybody][:_MAX_PAIRED_REMOVALS]
        other = tuple(name for name in self._others_of_the_crash() if name not in part.agents)
        groups = dict.fromkeys([(), other, *((*other, name) for name in near if name not in other)])
        few = [replace(part, others=group, begin=begin) for begin in begins for group in groups]
        few = [one for one in few if one.count <= _FEW_ACTORS]
        if self._try([scripting.spec(one) for one in few]) is not None:
            return
        best = part
        for begin in begins:
            crowd = part if begin == part.begin else replace(part, others=everybody, begin=begin)
            found = self._without_any(scripting, crowd)
            if found is not None and found.count < best.count:
                best = found
                self._try([scripting.spec(best)])
            if best.count <= _FEW_ACTORS:
                break

    def _without_any(self, scripting: Scripting, part: RemainingActors) -> RemainingActors | None:
        """Remove the unnecessary actors of a part; return None if the crash does not reproduce with the whole part."""
        if self._runs.first([scripting.spec(part)]) is None:
            return None

        def tried(some: Sequence[tuple[str, ...]]) -> int | None:
            return self._runs.first([scripting.spec(replace(part, others=one)) for one in some])

        return replace(part, others=fewest(part.others, tried))

    # What both have

    def _fewer_disturbances(self) -> None:
        best = self.best

        def tried(some: Sequence[tuple[Disturbance, ...]]) -> int | None:
            return self._try([replace(best, disturbances=one) for one in some])

        with self._no_longer():
            fewest(best.disturbances, tried)

    def _plainer_arguments(self) -> None:
        with self._no_longer():
            self._plain_arguments()

    def _plain_arguments(self) -> None:
        defaults = self._defaults
        at_default = self.best
        for key in _keys(self.best):
            default = defaults.get(key)
            if default is not None:
                at_default = with_argument(at_default, key, as_type_of(_value(self.best, key), default))
        if at_default != self.best:
            self._try([at_default])
        for agent, name in _keys(self.best):
            given = self.best.arguments[agent] if agent else self.best.scenario_arguments
            fewer = with_fewer_points(given, name)
            if agent:
                agents = self.best.arguments
                self._try([replace(self.best, arguments={**agents, agent: one}) for one in fewer])
            else:
                self._try([replace(self.best, scenario_arguments=one) for one in fewer])
        for key in _keys(self.best):
            best = self.best
            values = plainest(_value(best, key), defaults.get(key))
            if values:
                self._try([with_argument(best, key, value) for value in values])

    # What came of it

    def actors(self, after: Recording | None) -> tuple[int, int]:
        """Return the number of actors before and after the minimization, with the agents."""
        before = _actors(self._rerun.recorded)
        return len(before), len(before if after is None else _actors(after))

    def agents(self, after: Recording | None) -> tuple[int, int]:
        """Return the number of agents in the scenes before and after, because an agent may be removed like others."""
        agents, before = {*self._rerun.recorded.agents}, _actors(self._rerun.recorded)
        return len(before & agents), len((before if after is None else _actors(after)) & agents)

    @property
    def steps_cut(self) -> int:
        """The number of steps that were removed from the beginning."""
        script = self.best.script
        if script is None:
            return 0
        recorded = self._rerun.recorded
        return round((script.time_s - recorded.scene(0).time_s) / recorded.prologue.step_length_s)

    def removed(self) -> tuple[str, ...]:
        """The removed actors and disturbances."""
        was, best = self._rerun.spec, self.best
        everybody = self._everybody
        if best.script is not None:
            stay = {*best.script.names, *(path.actor.id for path in best.script.agents)}
            everybody = tuple(actor.id for actor in self._rerun.recorded.actors)
        elif best.only is not None:
            stay = {*best.only, *was.arguments, *self._rerun.worker.scenario.agents}
        else:
            stay = set(everybody)
        others = [name for name in dict.fromkeys(everybody) if name not in stay]
        gone = [one for one in was.disturbances if not self._has(one)]
        if best.script is not None:  # what befell the others is in their ways
            gone = [one for one in gone if one.what in SENSOR_KINDS]
        return (*others, *(one.words for one in gone))

    def _has(self, disturbance: Disturbance) -> bool:
        """Return whether the remaining trial has a disturbance, whose step is earlier if the beginning was removed."""
        shifted = replace(disturbance, step=disturbance.step - self.steps_cut)
        return shifted in self.best.disturbances

    def changed(self) -> dict[str, tuple[Value | None, Value | None]]:
        """The arguments whose value was changed."""
        was, now = self._rerun.spec, self.best
        pairs = {
            f"{agent}.{name}" if agent else name: (_value(was, (agent, name)), _value(now, (agent, name)))
            for agent, name in _keys(now)
        }
        return {name: (left, right) for name, (left, right) in pairs.items() if left != right}


def _actors(recording: Recording) -> set[str]:
    return {actor.id for scene in recording.scenes() for actor in scene.roster.actors}


def _nearest(recording: Recording, agent: str) -> list[str]:
    """Return the other actors in the last scene, the nearest actor first."""
    scenes = recording.scenes()
    if not scenes or agent not in scenes[-1].roster.index:
        return []
    scene = scenes[-1]
    here = scene.points[scene.roster.index[agent]]
    away = {
        actor.id: math.dist(point, here)
        for actor, point in zip(scene.roster.actors, scene.points, strict=True)
        if actor.id != agent
    }
    return sorted(away, key=lambda name: (away[name], name))


def _keys(spec: TrialSpec) -> list[tuple[str, str]]:
    names = [("", name) for name in spec.scenario_arguments]
    return names + [(agent, name) for agent, given in spec.arguments.items() for name in given]


def _value(spec: TrialSpec, key: tuple[str, str]) -> Value:
    agent, name = key
    return spec.arguments[agent][name] if agent else spec.scenario_arguments[name]
