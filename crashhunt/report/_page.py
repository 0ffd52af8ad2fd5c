"""The data of the report: one HTML file that shows a hunt and animates its crashes. The layout is in `page.html`.

The dashboard uses the same player: `player_parts` returns its style, controls and script, and `player_data` the data of
one crash.
"""

from __future__ import annotations

import json
import math
from contextlib import closing
from dataclasses import asdict
from importlib import resources
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from crashhunt.base import layout
from crashhunt.base.files import output_file
from crashhunt.base.progress import Watch, watched
from crashhunt.base.text import format_clock
from crashhunt.base.version import __version__
from crashhunt.crashes import closest_actors, read_notes, signature_of
from crashhunt.ledger import Ledger, has_begun
from crashhunt.plans import read_settings
from crashhunt.recording import is_opaque, read_lanes, read_obstacles
from crashhunt.report._argument_importance import MOST_WEIGHED, importance_of
from crashhunt.report._argument_words import argument_units, format_arguments
from crashhunt.report._crash_text import Story, describe_note
from crashhunt.report._disturbance_words import by_likelihood, may_be_disturbed, traffic_of
from crashhunt.report._headline import last_avoidable, verdict_of
from crashhunt.report._judgement_words import NOT_DECIDED, fault_words
from crashhunt.report._player_layers import packed_floats, player_layers
from crashhunt.report._rate_text import describe_running
from crashhunt.report._version_words import describe_versions
from crashhunt.results import CodeVersions, TrialRow, count_versions, find_crashes
from crashhunt.simulators import TRAJECTORY_SHAPE
from crashhunt.trial import Outcome, steps_of
from crashhunt.world import approaches, join_frames

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from crashhunt.base.codec import JsonObject
    from crashhunt.crashes import Bundle, Encounter
    from crashhunt.ledger import RunningRate
    from crashhunt.plans import HuntSettings
    from crashhunt.recording import Recording
    from crashhunt.results import FoundCrashes
    from crashhunt.trial import TrialResult, Value
    from crashhunt.world import Actor, Scene


# The search on the page: the trials, and those that a crash was derived from.

UNCHOSEN = ("", "random", "start", "halton")
"""Origins of trials that were chosen without learning, so that they cover the whole space."""

_MAX_GENERATIONS = 50  # of a lineage; more are unreadable


def values_of(row: TrialRow) -> dict[str, Value]:
    """Return all arguments of a trial by the names that the page uses for them."""
    values = {
        f"{agent}.{name}" if len(row.arguments) > 1 else name: value
        for agent, given in row.arguments.items()
        for name, value in given.items()
    }
    return {**values, **row.scenario_arguments}


def trial_point(row: TrialRow) -> dict[str, object]:
    """Return a trial as a point of the plots of the report and of the dashboard."""
    return {
        "number": row.number,
        "outcome": str(row.outcome),
        "category": row.outcome.category,
        "danger": _rounded(row.danger),
        "ttc": _rounded(row.time_to_collision_s),
        "origin": row.origin,
        "parent": row.parent,
        "values": values_of(row),
    }


def _rounded(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else round(value, 4)


def lineage_of(number: int, trial: Callable[[int], JsonObject | None]) -> list[list[object]]:
    """Return the ancestors of a trial, the parent first, each with its number, origin and criticality."""
    found: list[list[object]] = []
    row = TrialRow(data) if (data := trial(number)) is not None else None
    while row is not None and row.parent is not None and row.parent < row.number and len(found) < _MAX_GENERATIONS:
        row = TrialRow(data) if (data := trial(row.parent)) is not None else None
        found += [[row.number, row.origin, row.danger]] if row is not None else []
    return found


_MAX_SHOWN_ACTIONS = 12  # numbers of an action
_MAX_PLOTTED_TRIALS = 4000  # trials in a plot; more cannot be distinguished
GOLDEN_RATIO = (math.sqrt(5.0) - 1.0) / 2.0
"""Multiples of it, without their whole parts, are spread evenly over 0 to 1."""


def write_report(
    directory: Path,
    bundles: Sequence[Bundle],
    target: Path,
    *,
    found: FoundCrashes | None = None,
    near_misses: int = 0,
    name: str = "",
    watch: Watch | None = None,
) -> int:
    """Write the report of a hunt. The file is never incomplete.

    Args:
        directory: directory of the hunt; its ledger may be missing, as in an exported crash.
        bundles: the crashes and near misses to animate.
        target: path of the report; an existing file is replaced.
        found: groups of all crashes of the hunt; by default those of the crashes in the directory.
        near_misses: total number of near misses of the hunt; `bundles` contains some of them.
        name: name of the hunt for the title; by default the name of its directory.
        watch: function called after each crash, with the number of finished crashes and the number of all crashes.

    Returns:
        The size of the report in bytes.

    Raises:
        BundleError: a crash is damaged.
        HuntDirectoryError: the file cannot be written.
    """
    data = report_data(
        directory,
        bundles,
        found=found or find_crashes(directory, 0),
        near_misses=near_misses,
        name=name or directory.resolve().name,
        watch=watch,
    )
    player = player_parts()
    page = _read("page.html").replace("/*STYLE*/", player.style).replace("<!--PLAYER-->\n", player.controls)
    page = page.replace("/*NUMBERS*/\n", player.numbers).replace("/*PLAYER*/\n", player.script)
    # Inside a script element, only "</" and "<!--" mean something to HTML.
    text = page.replace("/*DATA*/", json.dumps(data, ensure_ascii=True, allow_nan=False).replace("<", "\\u003c"))
    with output_file(target) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return target.stat().st_size


class PlayerParts(NamedTuple):
    """The parts of pages that the report and the dashboard share."""

    style: str  # CSS: the colours of both colour schemes, and the style of the controls
    controls: str  # HTML of the scene, the controls and the curves
    # JavaScript for the end of the page; its functions ``load`` and ``show`` take the data that `player_data` returns
    script: str
    numbers: str  # JavaScript with ``formatNumber``, ``formatPercent`` and ``importanceBars``, the nodes of a chart


def player_parts() -> PlayerParts:
    """Return the player that the report and the dashboard use."""
    return PlayerParts(*map(_read, ("page.css", "player.html", "player.js", "numbers.js")))


def _read(name: str) -> str:
    return resources.files("crashhunt.report").joinpath(name).read_text(encoding="utf-8")


def player_data(bundle: Bundle, story: Story | None = None) -> dict[str, object]:
    """Return the data and the texts of a crash or near miss for the player.

    Raises:
        BundleError: the crash is damaged.
    """
    return _crash(bundle, story or Story(bundle))


def report_data(
    directory: Path,
    bundles: Sequence[Bundle],
    *,
    found: FoundCrashes,
    near_misses: int,
    name: str,
    watch: Watch | None = None,
) -> dict[str, object]:
    """Return everything that the page shows."""
    settings = read_settings(directory / layout.HUNT)
    return {
        "version": __version__,
        "name": name,
        "scenario": settings.scenario,
        "agents": {agent: chosen.agent for agent, chosen in settings.agents.items()},
        "seed": settings.seed,
        "planned": settings.trials,
        "maxSteps": settings.max_steps,
        "scenarioArguments": list(settings.scenario_arguments),
        "disturb": ",".join(settings.disturb),
        "units": {
            f"{agent}.{name}" if agent and len(settings.agents) > 1 else name: unit
            for (agent, name), unit in argument_units(directory, settings).items()
        },
        **_trials(directory, settings),
        **_crashes(bundles, found, watch),
        "nearMisses": near_misses,
        "notes": [describe_note(note) for note in read_notes(directory, "")],
        "lineages": _lineages(directory, bundles),
    }


def _lineages(directory: Path, bundles: Sequence[Bundle]) -> dict[str, list[list[object]]]:
    """Return for each crash the trials from which the sampler derived it, with their number, origin and criticality."""
    path = directory / layout.LEDGER
    if not bundles or not has_begun(path):
        return {}
    with closing(Ledger(path)) as ledger:
        lines = {bundle.id: lineage_of(bundle.result.spec.number, ledger.plain_trial) for bundle in bundles}
    return {crash: line for crash, line in lines.items() if line}


def _crashes(bundles: Sequence[Bundle], found: FoundCrashes, watch: Watch | None) -> dict[str, object]:
    """Return the crashes in the order of the page, and all crash types with the positions of the crashes shown."""
    crashes: list[dict[str, object]] = []
    members: dict[str, list[int]] = {}
    crashed = [bundle for bundle in bundles if not bundle.is_near_miss]
    shown = [*by_likelihood(crashed), *(bundle for bundle in bundles if bundle.is_near_miss)]
    for number, bundle in enumerate(watched(shown, len(shown), watch)):
        story = Story(bundle)
        near = (
            f"near miss at step {story.nearest.step}, criticality {story.nearest.danger:.2f}" if story.nearest else ""
        )
        traffic = near if bundle.is_near_miss else traffic_of(bundle, found.tally.likeliest)
        crashes.append({**_crash(bundle, story), "traffic": traffic})
        if not bundle.is_near_miss:
            members.setdefault(str(signature_of(bundle, story.recording)), []).append(number)
    kinds = [
        {
            "words": words,
            "category": _category(found.shortest.get(words, "")),
            "count": count,
            "first": found.first.get(words),
            "members": members.pop(words, []),
        }
        for words, count in found.types.items()
    ]
    kinds += [{"words": "type not determined", "category": "traffic crash", "count": found.untyped, "members": []}] * (
        found.untyped > 0
    )
    return {"kinds": kinds, "crashes": crashes, "found": found.tally.found, "saved": found.saved}


def _category(crash: str) -> str:
    """Return the category of the outcome that the identifier of a crash contains."""
    try:
        return Outcome(crash.partition("-")[2]).category
    except ValueError:
        return "traffic crash"


def _trials(directory: Path, settings: HuntSettings) -> dict[str, object]:
    """Return the outcomes of all trials; for the plots, also the arguments and the criticality of trials.

    A plot shows at most 4,000 crashes and 4,000 other trials, selected evenly over the hunt.
    """
    path = directory / layout.LEDGER
    if not has_begun(path):
        nothing = {"outcomes": {}, "categories": {}, "steps": 0, "trials": [], "stress": None, "drawn": None}
        return {**nothing, "importance": [], "weighed": None, "not_fully_asked": 0, "rate": None}
    with closing(Ledger(path)) as ledger:
        outcomes, facts = ledger.outcomes(), ledger.facts()
        versions = count_versions(ledger, facts, settings.crash_on)
        apart = ledger.numbers_from(CodeVersions.of(facts).earlier)
        total = sum(outcomes.values())
        crashes = sum(outcomes.get(str(name), 0) for name in settings.crash_on)
        share, share_of_crashes = _MAX_PLOTTED_TRIALS / max(total - crashes, 1), _MAX_PLOTTED_TRIALS / max(crashes, 1)
        trials, stress, not_fully_asked, unchosen_in_all = [], None, 0, 0
        unchosen: list[tuple[Mapping[str, Value], float]] = []
        for number, row in enumerate(map(TrialRow, ledger.plain_results())):
            outcome, margin = row.outcome, row.stress_margin
            if margin is not None and (stress is None or margin < stress["margin"]):
                stress = {"margin": margin, "trial": row.number}
            not_fully_asked += not row.is_fully_asked
            crashed = outcome.category != "no crash"
            danger = 1.0 if crashed else row.danger
            counts = outcome in settings.crash_on
            if row.origin in UNCHOSEN and row.parent is None and danger is not None and row.number not in apart:
                unchosen_in_all += 1
                if is_drawn(number, 2 * MOST_WEIGHED / max(total, 1)):
                    unchosen.append((values_of(row), danger))
            if is_drawn(number, share_of_crashes if counts else share):
                trials.append(trial_point(row))
        return {
            "outcomes": outcomes,
            "categories": {name: Outcome(name).category for name in outcomes},
            "steps": ledger.trial_steps(),
            "trials": trials,
            "stress": stress,
            "not_fully_asked": not_fully_asked,
            "drawn": _plot_counts(trials, total, crashes, settings) if len(trials) < total else None,
            "importance": importance_of(unchosen),
            "rate": _rate(facts.get("running_rate"), describe_versions(map(asdict, versions)) if versions else ""),
            "notices": facts.get("notices") or [],
            "typesByCause": facts.get("types_by_cause"),
            "weighed": [min(len(unchosen), MOST_WEIGHED), unchosen_in_all] if unchosen_in_all > MOST_WEIGHED else None,
        }


def _rate(rate: RunningRate | None, versions: str) -> dict[str, object] | None:
    """Return the crash rate that the hunt has recorded; None if there is no rate, as in hunts of earlier versions."""
    if rate is None:
        return None if not versions else {"answer": "not known", "words": versions, "certain": None, "estimated": None}
    words = f"The bounds have {rate['confidence']:g} % confidence, valid whenever you look."
    if rate["method"] == "rare":
        words += " The estimate omits failures that no copy has met. The bounds include these failures."
    if versions:
        words += f" Here, {versions}."
    return {
        "answer": describe_running(rate).removeprefix("crash rate: "),
        "words": words,
        "certain": rate["certain"],
        "estimated": rate["estimated"],
    }


def _plot_counts(
    trials: Sequence[Mapping[str, object]], total: int, crashes: int, settings: HuntSettings
) -> dict[str, int]:
    """Return how many crashes and other trials the plots show, and how many the hunt has."""
    shown = sum(trial["outcome"] in settings.crash_on for trial in trials)
    return {"crashes": shown, "allCrashes": crashes, "others": len(trials) - shown, "allOthers": total - crashes}


def is_drawn(number: int, share: float) -> bool:
    """Return whether a trial belongs to a given share of all trials, selected evenly over the hunt.

    A smaller share is a subset of a greater one. The selection is not periodic, because every fifth trial of a guided
    hunt is random, so that a periodic selection would be biased.
    """
    return number * GOLDEN_RATIO % 1.0 < share


def _crash(bundle: Bundle, story: Story) -> dict[str, object]:
    recording, result = story.recording, bundle.result
    return {
        "id": bundle.id,
        "summary": result.summary,
        "outcome": str(result.outcome),
        "category": result.outcome.category,
        "verdict": verdict_of(story),
        "badges": _badges(story),
        "words": story.words(),
        **({"notes": [describe_note(note) for note in story.notes]} if story.notes else {}),
        "table_lines": story.table(),
        "arguments": format_arguments(result),
        "facts": {
            "trial": str(result.spec.number),
            "seed": str(result.spec.seed),
            "steps": str(result.steps),
            "simulation time": format_clock(result.sim_time_s),
            **(
                {"at fault": fault_words(story.fault.verdict)}
                if story.encounter is not None and story.nearest is None
                else {}
            ),
            **({"criticality": f"{result.danger:.2f}"} if bundle.is_near_miss and result.danger is not None else {}),
            "digest": result.digest,
            "snapshot": bundle.snapshot,
            **_disturbances(result),
            "confirmed": {
                True: "yes, bit-identical",
                False: "no: flaky",
                None: f"not confirmed: {bundle.why_unconfirmed}" if bundle.why_unconfirmed else "not tried",
            }[bundle.confirmed],
        },
        "escape": story.escape,
        "avoidable": last_avoidable(story),
        "nearest": story.nearest.step if story.nearest is not None else None,
        **_danger(story),
        "agent": story.agent,
        "other": story.other,
        "agents": list(recording.agents),
        "dt": recording.prologue.step_length_s,
        **_scenes(recording, story.agent),
        "actionWords": story.action_words,
        **(_to_closest(story) if story.encounter is None else _to_other(story.encounter, recording)),
        "lanes": _lanes(bundle, recording),
        **_obstacles(bundle, recording),
        **player_layers(bundle, recording, story.agent, story.contact, _origin(recording)),
        "disturbances": [
            [one.step, one.step + steps_of(one.how_long, recording.prologue.step_length_s) - 1, one.words, one.vehicle]
            for one in result.disturbances
        ],
    }


def _badges(story: Story) -> list[str]:
    """Return the few facts that the page shows below the verdict."""
    result = story.bundle.result
    found: list[str] = [result.outcome.category if story.nearest is None else "near miss"]
    if story.encounter is not None and story.nearest is None:
        rules = " and ".join(finding.rule for finding in story.fault.findings)
        parties = {"ego": story.agent, "the other": story.other, "both": f"{story.agent} and {story.other}"}
        party = parties.get(story.fault.verdict)
        found.append(f"at fault: {party} ({rules})" if party else f"fault: {NOT_DECIDED}")
    if story.bundle.confirmed is not None:
        found.append("confirmed: bit-identical in a new process" if story.bundle.confirmed else "not confirmed: flaky")
    if may_be_disturbed(result):
        found.append("with disturbances" if result.disturbed else "in undisturbed traffic")
    return found


def _danger(story: Story) -> dict[str, object]:
    """Return the agent's own criticality and the rear criticality over time."""
    course = story.danger
    return {"danger": packed_floats(course.own), "behind": packed_floats(course.behind)} if course is not None else {}


def _disturbances(result: TrialResult) -> dict[str, str]:
    """Return the summary of the disturbances for the page."""
    if not may_be_disturbed(result):
        return {}
    said = f"{len(result.disturbances)} took place" if result.disturbed else "none: in undisturbed traffic"
    likely = {} if result.log_likelihood is None else {"log-likelihood": f"{result.log_likelihood:.2f}"}
    return {"disturbances": said, **likely}


def _scenes(recording: Recording, agent: str) -> dict[str, object]:
    """Return all scenes as columns: float32, shape (steps, actors, 4); x and y start at the agent's first position."""
    scenes = recording.scenes()
    names: dict[str, Actor] = {}
    highest: dict[str, float] = {}

    def noted() -> Iterator[Scene]:
        for scene in scenes:
            for row, actor in enumerate(scene.roster.actors):
                names.setdefault(actor.id, actor)
                if scene.heights:
                    highest[actor.id] = max(highest.get(actor.id, -math.inf), scene.heights[row])
            yield scene

    times, gaps, _ = approaches([*join_frames(noted())], agent)
    if highest:  # the page draws them in this order
        names = dict(sorted(names.items(), key=lambda entry: highest.get(entry[0], 0.0)))
    place = {name: number for number, name in enumerate(names)}
    table = np.full((len(scenes), len(names), 4), np.nan)
    bends: list[tuple[int, int, list[float]]] = []
    origin = _origin(recording)
    if recording.compact is not None:  # without the actors that are farther away, these would be too large
        times, gaps = np.full_like(times, np.nan), np.full_like(gaps, np.nan)
    actions = np.full((len(scenes), 0), np.nan)
    channel = next((found for found in recording.prologue.agents if found.id == agent), None)
    action_names: list[str] = []
    if channel is not None and not is_opaque(channel.action_shape) and channel.action_shape != TRAJECTORY_SHAPE:
        size = math.prod(channel.action_shape)
        action_names = list(channel.action_names) or [f"action[{n}]" for n in range(size)]
        size = size if size <= _MAX_SHOWN_ACTIONS else 0  # a trajectory is drawn, and not listed
        action_names = action_names[:size]
        actions = np.full((len(scenes), size), np.nan)
    for number, (step, scene) in enumerate(zip(recording.all_steps, scenes, strict=False)):
        table[number, [place[actor.id] for actor in scene.roster.actors]] = scene.data
        for row, spine in scene.spines.items():
            points = np.round(np.array(spine)[:, :2] - origin, 2).ravel().tolist()
            bends.append((number, place[scene.roster.actors[row].id], points))
        if actions.size and agent in step.actions:
            actions[number] = step.actions[agent].reshape(-1)
    table[:, :, :2] -= origin
    return {
        "origin": origin.tolist(),
        "time0": scenes[0].time_s if scenes else 0.0,
        "actors": [[actor.id, actor.kind, actor.length, actor.width] for actor in names.values()],
        "bends": bends,
        "steps": len(scenes),
        "table": packed_floats(table),
        "ttc": packed_floats(times),
        "gap": packed_floats(gaps),
        "actionNames": action_names,
        "actions": packed_floats(actions),
    }


def _to_other(encounter: Encounter, recording: Recording) -> dict[str, str]:
    """Return gap and time to collision to the actor that the text names, not to the nearest actor."""
    moments = {moment.step: moment for moment in encounter.moments}
    steps = range(len(recording.scenes()))
    found = {"gap": "gap_m", "ttc": "time_to_collision_s"}
    return {
        key: packed_floats(np.array([getattr(moments[step], name) if step in moments else np.nan for step in steps]))
        for key, name in found.items()
    }


def _to_closest(story: Story) -> dict[str, object]:
    """Return for each step the actor with the least time to collision and the actor with the least gap."""
    closest = closest_actors(story.recording, story.agent) if story.recording.compact is None else []
    return {"closest": [list(one) for one in closest]}


def _lanes(bundle: Bundle, recording: Recording) -> list[list[str]]:
    origin = _origin(recording)
    return [
        [packed_floats(right - origin), packed_floats(left - origin)]
        for right, left in read_lanes(bundle.path / layout.LOG)
        if len(right) > 1
    ]


def _obstacles(bundle: Bundle, recording: Recording) -> dict[str, object]:
    """Return the outlines of obstacles, such as buildings; nothing if there are none."""
    outlines = [one for one in read_obstacles(bundle.path / layout.LOG) if len(one) > 2]
    return {"obstacles": [packed_floats(one - _origin(recording)) for one in outlines]} if outlines else {}


def _origin(recording: Recording) -> NDArray[np.float64]:
    scenes = recording.scenes()
    for scene in scenes[:1]:
        for agent in recording.agents:
            if agent in scene.roster.index:
                return np.round(np.array(scene.points[scene.roster.index[agent]]))
    return np.zeros(2)
