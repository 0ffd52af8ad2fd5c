"""The last seconds of a crash, or the seconds around a near miss, as sentences and as a table."""

from __future__ import annotations

import math
from dataclasses import asdict
from functools import cached_property
from typing import TYPE_CHECKING

from crashhunt.base.errors import CrashhuntError
from crashhunt.base.text import aligned, count_of, format_number, format_time, in_lines, one_line
from crashhunt.crashes import (
    Encounter,
    contact_record,
    danger_course,
    fault_of,
    judgement_of,
    last_escape,
    most_dangerous,
    names_of_actions,
    read_notes,
    snapshot_of,
    subject_of,
)
from crashhunt.recording import describe_value, is_opaque
from crashhunt.report._argument_words import draw_signals, format_inputs, input_signals
from crashhunt.report._cause_words import about_why
from crashhunt.report._crash_summary import innermost_calls
from crashhunt.report._disturbance_words import about_disturbances
from crashhunt.report._encounter_words import (
    COLUMNS,
    MAX_STANDING_SPEED_MPS,
    about_danger,
    about_events,
    about_gap,
    about_nearest,
    about_place,
    danger_cells,
    danger_to_json,
    nearest_to_json,
    window_of,
)
from crashhunt.report._headline import verdict_of
from crashhunt.report._judgement_words import (
    NOT_DECIDED,
    about_changes,
    about_drivers,
    about_judgement,
    about_reference,
)
from crashhunt.report._step_table import NEAREST, TableCell, describe_action, is_wide, stacked, steps_table
from crashhunt.scenario import ACTIONS

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from crashhunt.base.binaries import BinaryFacts
    from crashhunt.crashes import Bundle, Moment, Note
    from crashhunt.recording import StepRecord

_MAX_TABLE_ROWS = 20  # of the table; of more steps, the table shows a selection
_BUILD_ID_DIGITS = 12
_WIDTH = 80  # characters of a line of the table, as on an ordinary terminal


class Story:
    """The last seconds of a crash, or the seconds around a near miss. No code of the bundle runs.

    Args:
        bundle: the crash or near miss.
        last_s: duration to describe, in s. For a near miss, half of this duration lies before the nearest moment and
            half after.
        braking: a deceleration, in m/s². The story then contains the calculated last step at which braking with this
            deceleration would have avoided the crash. Without a deceleration, the story contains the result of the
            hunt's own runs.
    """

    def __init__(self, bundle: Bundle, *, last_s: float = 5.0, braking: float | None = None) -> None:
        self.bundle = bundle
        self.recording = bundle.recording()
        self._braking = braking
        hit = bundle.result.collision
        self.nearest = most_dangerous(self.recording) if bundle.is_near_miss else None
        near = self.nearest
        self.agent, self.other = (near.agent, near.other) if near else (bundle.driver, hit.other if hit else "")
        compact = self.recording.compact
        self._is_whole = compact is None  # otherwise actors are missing that criticality and closest approach need
        self.danger = danger_course(self.recording, self.agent) if compact is None else None
        self._first, self._last = window_of(self.recording, last_s, near)
        self.encounter = Encounter(self.recording, self.agent, self.other) if self.other else None
        self.judgement = judgement_of(bundle)
        self.notes = read_notes(bundle.hunt, subject_of(bundle))
        self.contact = contact_record(bundle, self.recording)
        self.fault = fault_of(bundle, self.recording, self.contact)
        tried = bundle.result.escape
        self.escape = tried.step if tried is not None else None
        if braking is not None:
            drove_into = hit is not None and hit.role == "collider"
            self.escape = last_escape(self.recording, self.agent, self.other, braking=braking) if drove_into else None

    @cached_property
    def action_words(self) -> tuple[str, ...]:
        """The name of each discrete action of the agent, by number; empty if unknown."""
        return names_of_actions(self.bundle, self.agent)

    def to_json(self) -> dict[str, object]:
        """Return the story in the form that ``show --json`` prints."""
        nearest: list[Mapping[str, TableCell]] = [dict.fromkeys(NEAREST)] * (self.recording.steps + 1)
        if self.encounter and self._is_whole:
            nearest = list(steps_table(self.recording, NEAREST, self.agent))
        moments, tried = self.encounter.moments if self.encounter else [], self.bundle.result.escape
        why_not = tried.why_not if tried is not None else ""
        signals = input_signals(self.bundle.result)
        tried = None if why_not else tried
        return {
            "crash": self.bundle.id,
            "summary": self.bundle.result.summary,
            "verdict": verdict_of(self),
            "agent": self.agent,
            "other": self.other,
            "words": self.words(),
            "full_braking": self._braking or (tried.braking if tried else None),
            "last_escape_step": self.escape,
            "braking": {
                "by": "calculation" if self._braking else "running it" if tried else None,
                "how": tried.how if tried and not self._braking else None,
                "changed": list(tried.changed) if tried and not self._braking else [],
                "too_late_step": tried.too_late if tried and not self._braking else None,
                "why_not": (why_not or self.bundle.result.why_no_escape) if not self._braking else "",
            },
            "judged": self.judgement.to_json() if self.judgement is not None else None,
            "fault": self.fault.to_json(),
            "nearest": nearest_to_json(self.nearest),
            "danger": danger_to_json(self.danger, self.bundle, self._first, self._last),
            "moments": [
                {
                    name: None if isinstance(value, float) and not math.isfinite(value) else value
                    for name, value in _named(moment, nearest[moment.step]).items()
                }
                | {"action": self._opaque_action(moment.step) or self._action(moment.step)}
                for moment in moments
                if self._first <= moment.step <= self._last
            ],
            **({"signals": {name: asdict(signal) for name, signal in signals.items()}} if signals else {}),
            **({"notes": [note.to_json() for note in self.notes]} if self.notes else {}),
            **({"programs": programs} if (programs := programs_of(self.bundle)) else {}),
        }

    def words(self) -> list[str]:
        """Return a description of the events, one sentence each."""
        result, recording = self.bundle.result, self.recording
        end = recording.steps
        scenes = recording.scenes()
        lasted = recording.before_end_s(0) if scenes else 0.0
        sentences = [f"{result.summary}, {self._time(lasted)} after the episode began."]
        sentences += about_disturbances(recording, result, self._first)
        if self.encounter is not None and self.nearest is not None:
            sentences += about_nearest(self.encounter, self.nearest)
        elif self.encounter is not None and self.encounter.moments:
            sentences += self._about_encounter(self.encounter)
            sentences += self._about_fault()
        sentences += [f"{line}." for line in result.event.details] if result.event is not None else []
        sentences += about_events(recording, self._first, besides=result.event)
        hit = result.collision
        if result.event is not None or (hit is not None and hit.role == "alone"):
            before = self._action(end)
            whose = "Its" if result.event is None else f"{self.agent}'s"
            decision = self._opaque_action(end) or self._decided(before)
            sentences.append(f"{whose} last decision was {decision}.")
            sentences += self._about_fault() if self.fault.findings else []
        if self.danger is not None:
            words = about_danger(self.danger, partner=self.other if self.bundle.result.collision is not None else "")
            sentences += [words] if words else []
        if (compact := recording.compact) is not None:
            sentences.append(
                "The log is compact: it has the vehicles of the crash, and others up to "
                f"{compact.radius_m:g} m from an agent. Criticality is not reported."
            )
        if result.failure is not None:
            sentences += self._about_failure()
        if self.encounter is None:
            sentences += self.about_judgement()
        return sentences

    def describe(self) -> str:
        """Return the sentences and the table of the story."""
        lines = [f"{self.bundle.id}  ({self.bundle.result.outcome.category})"]
        lines.append(f"  {format_inputs(self.bundle.result)}")
        lines += [f"  {line}" for line in (*draw_signals(self.bundle.result), *describe_programs(self.bundle))]
        lines += _shrunk(self.bundle)
        lines += [f"  {describe_note(note)}" for note in self.notes]
        verdict = verdict_of(self)
        is_new = verdict != f"{self.bundle.result.summary}."  # the words begin with the summary
        lines += ["", verdict] if is_new else []
        lines += ["", *self.words(), "", *self.table()]
        shown, steps = len(self._steps_shown()), len(self._steps())
        lines += [f"{shown} of {steps} steps shown"] if shown < steps else []
        return in_lines(lines)

    def table(self) -> list[str]:
        """Return the last steps of the recording as a table."""
        names = self._names()
        hit = self.bundle.result.collision
        drives_into = hit is not None and hit.role == "collider"  # the agent had the other in front of it
        header = ["step", "time s", f"{self.agent} m/s", *names]
        if self.encounter is not None:
            header += [f"{self.other} m/s", "gap m", "closing m/s", "TTC s"]
            header += ["braking needed m/s²"] if drives_into else []
        header += COLUMNS if self.danger is not None else ()
        moments = {moment.step: moment for moment in self.encounter.moments} if self.encounter else {}
        rows = []
        for step in self._steps_shown():
            scene = step.scene
            row = scene.roster.index.get(self.agent) if scene is not None else None
            speed = f"{scene.speeds[row]:.1f}" if scene is not None and row is not None else "-"
            time_s = self._time(scene.time_s).removesuffix(" s") if scene is not None else "-"
            cells = [str(step.step), time_s, speed, *self._decision(step.step)]
            if self.encounter is not None:
                moment = moments.get(step.step)
                cells += ["-"] * 5 if moment is None else _cells(moment)
                cells = cells if drives_into else cells[:-1]
            cells += danger_cells(self.danger, step.step) if self.danger is not None else []
            rows.append([*cells, self._mark(step.step, moments.get(step.step))])
        return aligned([*stacked(header), *rows], width=_WIDTH)

    def _steps(self) -> list[StepRecord]:
        """Return the steps that are described."""
        return list(self.recording.all_steps[max(0, self._first) : self._last + 1])

    def _steps_shown(self) -> list[StepRecord]:
        """Return the steps that the table shows, a selection of the described steps."""
        steps, near = self._steps(), self.nearest
        return (
            _thinned(steps, _MAX_TABLE_ROWS, always=self.escape)
            if near is None
            else _steps_around(steps, _MAX_TABLE_ROWS, near.step)
        )

    def _mark(self, step: int, moment: Moment | None) -> str:
        """Return the remark at the end of a row of the table."""
        if step == self.escape:
            return "<- last avoidable step"
        if self.nearest is not None and step == self.nearest.step:
            return "<- nearest"
        hit = self.bundle.result.collision
        if hit is None or moment is None or step != self.recording.steps:
            return ""
        own, its = self._speeds_at_contact()
        same = (
            abs(own - moment.speed) < MAX_STANDING_SPEED_MPS and abs(its - moment.other_speed) < MAX_STANDING_SPEED_MPS
        )
        return "" if same or math.isnan(own) or math.isnan(its) else f"<- they touched at {own:.1f} and {its:.1f} m/s"

    def _speeds_at_contact(self) -> tuple[float, float]:
        """Return the speeds of the agent and of the other actor, in m/s; NaN if they are unknown."""
        hit = self.bundle.result.collision
        if hit is None:
            return math.nan, math.nan
        pair = hit.collider_speed, hit.victim_speed
        return pair if hit.role == "collider" else pair[::-1]

    def _about_encounter(self, encounter: Encounter) -> list[str]:
        agent, other = encounter.agent, encounter.other
        sentences = []
        # Moments after the contact do not explain how the crash came about.
        recording = self.recording
        before = [moment for moment in encounter.moments if moment.step < recording.steps]
        shown = [moment for moment in before if moment.step >= self._first]
        if shown:
            earlier = shown[0]
            ago_s = {moment.step: recording.before_end_s(moment.step) for moment in shown}
            middle = next((moment for moment in reversed(shown) if ago_s[moment.step] >= 1.0 - 1e-6), earlier)
            sentences = [
                f"{recording.ago(earlier.step)}, {about_gap(encounter, earlier)}.",
                f"{recording.ago(middle.step)}, {about_place(encounter, middle)}.",
            ]
        own, its = self._speeds_at_contact()
        if math.isfinite(own) and math.isfinite(its):
            sentences.append(f"When they touched, {agent} drove {own:.1f} m/s and {other} {its:.1f} m/s.")
        changed = self._last_lane_change()
        if changed is not None:
            step, side = changed
            sentences.append(f"{agent} decided to change lanes to the {side} at step {step}.")
        return [*sentences, *self._about_escape()]

    def _about_fault(self) -> list[str]:
        """Return a sentence on the vehicle at fault, and the rule that blames it."""
        verdict, found = self.fault.verdict, self.fault.findings
        if verdict == "nobody can tell":
            return [
                f"At fault: {NOT_DECIDED}, because {'rules contradict each other' if found else 'no rule applies'}."
            ]
        who = {"ego": self.agent, "the other": self.other, "both": f"both {self.agent} and {self.other}"}[verdict]
        rules = "; and ".join(f"by the rule {one.rule!r}: {one.words} ({one.source})" for one in found)
        return [f"At fault: {who}, {rules}."]

    def _about_escape(self) -> list[str]:
        """Return sentences on the last step from which braking avoids the crash; empty if that step is unknown."""
        tried = self.bundle.result.escape
        if self._braking is not None:
            return [self._calculated(self._braking)]
        if self.judgement is not None and self.judgement.runs:
            return self.about_judgement()
        if tried is None:
            why = self.bundle.result.why_no_escape
            return [f"The last step at which braking would have helped is unknown: {why}."] if why else []
        if tried.why_not:
            return [f"The last step at which braking would have helped is unknown: {tried.why_not}."]
        braking = f"Braking {tried.how}"
        if tried.step is None:
            assert tried.too_late is not None
            return [f"{braking} would not have avoided it even {self._ago(tried.too_late)}: that run crashes."]
        also, until = about_changes(tried.changed), self._ago(tried.step)
        if tried.too_late is None:
            return [f"{braking} could have avoided it until {until}: a run from this step avoids it.{also}"]
        runs = "a run from this step avoids it, and a run from one step later crashes"
        return [f"{braking} could have avoided it until {until}: {runs}.{also}"]

    def about_judgement(self) -> list[str]:
        """Return sentences on the last step from which the crash could be avoided, according to the runs of `judge`."""
        if self.judgement is None:
            return []
        why = about_why(self.judgement.why, self._at) if self.judgement.why is not None else []
        reference = self.judgement.reference
        blamed = self.fault.verdict in ("ego", "both")
        cause = about_reference(reference, self._ago, self.agent, had_to_yield=blamed) if reference is not None else []
        drivers = self.judgement.drivers
        prevented = about_drivers(drivers, self._ago, self.agent, self.other) if drivers is not None else []
        return [*cause, *about_judgement(self.judgement, self._ago, self.agent, self.other), *prevented, *why]

    def _calculated(self, braking: float) -> str:
        if self.escape is None:
            return f"The last step at which braking at {braking:g} m/s² would have helped cannot be calculated."
        tried = self.bundle.result.escape
        can = ""
        if tried is not None and tried.braking is not None and braking > 1.01 * tried.braking:
            can = f" (in the run, it braked with at most {tried.braking:.1f})"
        return (
            f"Braking at {braking:g} m/s²{can} could have avoided it until {self._ago(self.escape)}, if "
            f"{self.other} had moved as recorded. This is a calculation, not a run."
        )

    def _ago(self, step: int) -> str:
        return f"{self.recording.ago(step)}, after step {step}"

    def _at(self, step: int) -> str:
        return self._time(self.recording.scene(min(step, self.recording.steps)).time_s)

    def _time(self, seconds: float) -> str:
        return format_time(seconds, self.recording.prologue.step_length_s)

    def _last_lane_change(self) -> tuple[int, str] | None:
        names = self._names()
        if "lane_change" not in names:
            return None
        for step in range(self.recording.steps, max(0, self._first), -1):
            action = self._action(step)
            change = action[names.index("lane_change")] if action else 0.0
            if change:
                return step, "left" if change > 0 else "right"
        return None

    def _about_failure(self) -> list[str]:
        failure = self.bundle.result.failure
        assert failure is not None
        sentences = []
        if self.recording.all_steps and self.agent in self.recording.all_steps[-1].observations:
            last = self.recording.all_steps[-1]
            channel = next(agent for agent in self.recording.prologue.agents if agent.id == self.agent)
            seen = last.observations[self.agent]
            if is_opaque(channel.observation_shape):
                facts = describe_value(seen)
            else:
                values = channel.values_by_name(seen).items()
                facts = ", ".join(f"{name} {format_number(value)}" for name, value in values)
            sentences.append(f"Its last observation, in step {last.step}: {facts}.")
        frames = [line.strip() for line in innermost_calls(failure, 6, lines=6)]
        return [*sentences, "", *frames] if frames else sentences

    def _names(self) -> tuple[str, ...]:
        channel = next((agent for agent in self.recording.prologue.agents if agent.id == self.agent), None)
        if channel is None:
            return ()
        if is_wide(channel):
            return ("action",)
        return channel.action_names or tuple(f"action[{n}]" for n in range(math.prod(channel.action_shape)))

    def _opaque_action(self, step: int) -> str:
        """Return the text of an action with too many numbers for a table; empty for other actions."""
        channel = next((agent for agent in self.recording.prologue.agents if agent.id == self.agent), None)
        if channel is None or not 0 <= step < len(self.recording.all_steps):
            return ""
        array = self.recording.all_steps[step].actions.get(self.agent)
        return describe_action(array, channel) if array is not None and is_wide(channel) else ""

    def _action(self, step: int) -> list[float] | None:
        """Return the action of the agent in a step as text."""
        if not 0 <= step < len(self.recording.all_steps):
            return None
        array = self.recording.all_steps[step].actions.get(self.agent)
        if array is None or self._opaque_action(step):
            return None
        return [float(value) for value in array.reshape(-1)]

    def _decision(self, step: int) -> list[str]:
        if opaque := self._opaque_action(step):
            return [opaque]
        action = self._action(step)
        return ["-"] * len(self._names()) if action is None else self._formatted(action)

    def _decided(self, action: Sequence[float] | None) -> str:
        """Return an action with the name of each of its numbers."""
        if action is None:
            return "not recorded"
        pairs = zip(self._names(), self._formatted(action), strict=False)
        return ", ".join(f"{name} {value}" for name, value in pairs)

    def _formatted(self, action: Sequence[float]) -> list[str]:
        """Return the numbers of an action as text; the name of a discrete action, where it is known."""
        if len(action) == 1 and action[0] in range(len(self.action_words)):
            return [self.action_words[int(action[0])]]
        names = dict(enumerate(self._names()))  # of a table, only of the first row
        return [_number_of_action(names.get(number, ""), value) for number, value in enumerate(action)]


_NO_ACTION = 5e-4  # in m, m/s, m/s², rad or as a share: less is the rest of a calculation
_UNITS = {component.name: component.unit for form in ACTIONS.values() for component in form.components}


def _number_of_action(name: str, value: float) -> str:
    """Return a number of an action as text; a position has one decimal."""
    if name in _UNITS and abs(value) < _NO_ACTION:
        return "0"
    return f"{value:z.1f}" if _UNITS.get(name) == "m" else format_number(value)


_GAP_M = 0.05  # shown as 0.1; a smaller one needs any deceleration, up to millions of m/s²


def _cells(moment: Moment) -> list[str]:
    time_s = moment.time_to_collision_s
    return [
        f"{moment.other_speed:.1f}",
        f"{moment.gap_m:.1f}",
        f"{moment.closing_speed:+.1f}",
        f"{time_s:.1f}" if math.isfinite(time_s) else "-",
        # Without a time to collision, the calculated deceleration is 0, also before a bend of the road.
        f"{moment.required_deceleration:.1f}" if moment.gap_m >= _GAP_M and math.isfinite(time_s) else "-",
    ]


def _named(moment: Moment, nearest: Mapping[str, TableCell]) -> dict[str, object]:
    """Return the values of a moment under the column names of all tables.

    Some columns refer to the nearest actor, others to the collision partner.
    """
    facts = asdict(moment)
    return {
        **{name: facts[name] for name in ("step", "time_s", "speed", "other_speed", "closing_speed")},
        "gap_to_other_m": moment.gap_m,
        "time_to_other_s": moment.time_to_collision_s,
        **{name: nearest[name] for name in NEAREST},
    }


def programs_of(bundle: Bundle) -> dict[str, BinaryFacts]:
    """Return what identifies the programs and libraries of agents, by the word that names each."""
    try:
        return snapshot_of(bundle).environment.get("programs", {})
    except CrashhuntError:  # there is no snapshot, or it is damaged
        return {}


def describe_programs(bundle: Bundle) -> list[str]:
    """Return a line for each program or library of an agent: revision, architecture, build id."""
    lines = []
    for word, facts in programs_of(bundle).items():
        known = [
            f"revision {facts['revision']}" if facts.get("revision") else "",
            facts["machine"],
            f"build id {facts['build_id'][:_BUILD_ID_DIGITS]}" if facts["build_id"] else "",
        ]
        lines.append(f"program {word}: {', '.join(filter(None, known))}")
    return lines


def _shrunk(bundle: Bundle) -> list[str]:
    """Return lines on the crash from which `shrink` made the given crash; an empty list for crashes of other origin."""
    shrunk = bundle.added.get("shrunk")
    if not isinstance(shrunk, dict):
        return []
    gone, changed = (shrunk.get(name) or {} for name in ("removed", "changed"))
    lines = [f"  minimized from {shrunk.get('of')}: {len(gone)} elements removed, {len(changed)} arguments simplified"]
    script = bundle.result.spec.script
    if script is not None:
        cut = shrunk.get("steps_cut")
        who = ", ".join(script.names)
        moved = f"{who} moved along recorded paths, independent of the agent" if who else "without any traffic"
        lines.append(f"  scripted: {moved}" + (f"; it begins {count_of(cut, 'step')} later" if cut else ""))
    return lines


def _thinned(steps: list[StepRecord], rows: int, *, always: int | None) -> list[StepRecord]:
    """Return about `rows` of the steps: all of the last steps, and evenly spaced earlier steps."""
    if len(steps) <= rows:
        return steps
    recent = steps[-rows // 2 :]
    earlier = steps[: -rows // 2]
    every = math.ceil(len(earlier) / (rows - len(recent)))
    kept = {id(step) for step in earlier[::-every]}
    return [*(step for step in earlier if id(step) in kept or step.step == always), *recent]


def _steps_around(steps: list[StepRecord], rows: int, middle: int) -> list[StepRecord]:
    """Return about `rows` evenly spaced steps that include the step in the middle."""
    every = math.ceil(len(steps) / rows)
    return [step for step in steps if (step.step - middle) % every == 0]


_MAX_NOTE_CHARACTERS = 200  # of a note in one line


def describe_note(note: Note, *, whole: bool = True) -> str:
    """Return a note as one line; unless the whole note is wanted, the middle of a long text is omitted."""
    about = f" on {note.crash}" if note.crash else ""
    tags = "".join(f" #{tag}" for tag in note.tags)
    text = one_line(note.text)
    if not whole and len(text) > _MAX_NOTE_CHARACTERS:
        half = _MAX_NOTE_CHARACTERS // 2
        text = f"{text[:half]} … {text[-half:]}"
    return one_line(f"note {note.number}{about} ({note.by}, {note.at}):{' ' if text else ''}{text}{tags}")
