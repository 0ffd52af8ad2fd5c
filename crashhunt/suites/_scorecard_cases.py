"""A scorecard: where an agent crashes in all cases of a regulation, next to models of a competent driver."""

from __future__ import annotations

import hashlib
import itertools
import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from crashhunt.agents import REFERENCE_MODELS, Situation
from crashhunt.base.errors import HuntDirectoryError, UsageError
from crashhunt.base.text import one_of
from crashhunt.base.version import __version__
from crashhunt.crashes import COMPETENT_DRIVERS, wilson
from crashhunt.results import HuntResults
from crashhunt.samplers import SAMPLE, nearest_labels
from crashhunt.scenario import load_scenario
from crashhunt.snapshots import latest_snapshot
from crashhunt.suites._suite_file import Suite, SuiteEntry
from crashhunt.trial import Outcome, parse_spec
from crashhunt.world import START_M, actor_of_manoeuvre, manoeuvre_motions

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from crashhunt.base.codec import JsonObject
    from crashhunt.plans import Given
    from crashhunt.results import HuntState
    from crashhunt.trial import Value

    Labels = NDArray[np.bool_]
    Values = NDArray[np.float64]

# The groups of cases, and the hunts that run them.

STEPS = 400
"""Steps of each case. The published comparison of the driver models has 350 steps."""

_WITHOUT_CUT_IN = tuple(model for model in COMPETENT_DRIVERS if model != "reg157")
_NO_CUT_IN = "the requirement applies to cut-ins only"
_SPEEDS_KMH = (1, 250)


@dataclass(frozen=True, slots=True, kw_only=True)
class CaseGroup:
    """A group of cases of a regulation."""

    id: str  # name of the group
    paragraph: str  # where the regulation describes it
    x: str  # the argument along the horizontal axis of the maps
    y: str  # the argument along the vertical axis of the maps
    axes: Mapping[str, str]  # the values of these and further arguments, in the notation of ``--set``
    constants: Mapping[str, str]  # values of further arguments
    models: tuple[str, ...] = _WITHOUT_CUT_IN  # the models that apply
    why_not: str = _NO_CUT_IN  # why the other models do not apply

    @property
    def scenario(self) -> str:
        """The name of the scenario."""
        return f"r157-{self.id}"


_R157 = (
    CaseGroup(
        id="cut-in", paragraph="4.4", x="gap_m", y="lateral_mps",
        axes={"gap_m": "0:60:5", "lateral_mps": "0.5:3:0.5"}, constants={"side": "1"},
        models=COMPETENT_DRIVERS, why_not="",
    ),
    CaseGroup(
        id="cut-out", paragraph="4.5", x="front_m", y="lateral_mps",
        axes={"front_m": "10:100:10", "lateral_mps": "0.5:3:0.5"}, constants={"headway_s": "2", "side": "1"},
    ),
    CaseGroup(
        id="deceleration", paragraph="4.3", x="headway_s", y="decel_mps2",
        axes={"headway_s": "1:3:0.25", "decel_mps2": "1:10:1"}, constants={},
    ),
    CaseGroup(
        id="lane-keeping", paragraph="4.1", x="swerve_m", y="beside_m",
        axes={"swerve_m": "0:0.8:0.2", "beside_m": "-5:5:2.5"},
        constants={"headway_s": "2", "period_s": "8", "side": "1"},
    ),
    CaseGroup(
        id="following", paragraph="4.3", x="offset_m", y="slower_kmh",
        axes={"offset_m": "-1.75:1.75:0.5", "slower_kmh": "0:20:5"}, constants={"headway_s": "2", "period_s": "10"},
    ),
    CaseGroup(
        id="blocked-lane", paragraph="4.2", x="offset_m", y="distance_m",
        axes={"offset_m": "-2:2:0.5", "distance_m": "50:125:25"}, constants={},
    ),
    CaseGroup(
        id="multiple-targets", paragraph="4.2", x="offset_m", y="between_m",
        axes={"offset_m": "-2:2:0.5", "between_m": "1:21:5"}, constants={"distance_m": "100"},
    ),
    CaseGroup(
        id="pedestrian", paragraph="4.2", x="distance_m", y="impact_m",
        axes={"distance_m": "20:100:10", "impact_m": "-0.2:0.2:0.1"}, constants={"walk_kmh": "5", "from_side": "1"},
        models=(), why_not="the models do not apply to persons",
    ),
    CaseGroup(
        id="detection-range", paragraph="4.6", x="seen_m", y="offset_m",
        axes={"seen_m": "20:70:5", "offset_m": "-5.25|0|5.25"}, constants={"distance_m": "150"},
    ),
)  # fmt: skip

_SCORECARD_SUITES: Mapping[str, tuple[CaseGroup, ...]] = {"r157": _R157}
"""The groups of each suite of cases, by name."""


def groups_of(suite: str, names: Sequence[str] = ()) -> tuple[CaseGroup, ...]:
    """Return the groups of a suite; with names, only these groups.

    Raises:
        UsageError: the suite or a group does not exist.
    """
    if suite not in _SCORECARD_SUITES:
        raise UsageError(f"--suite is {suite!r}", fix=one_of(suite, _SCORECARD_SUITES))
    known = {group.id: group for group in _SCORECARD_SUITES[suite]}
    for name in names:
        if name not in known:
            raise UsageError(f"--group {name!r} is no group of the suite {suite!r}", fix=one_of(name, known))
    return tuple(group for group in known.values() if not names or group.id in names)


def entries_of(
    groups: Sequence[CaseGroup], agent: str, speeds: Sequence[int], *, grid: bool, options: Given
) -> Iterator[tuple[CaseGroup, SuiteEntry]]:
    """Yield the hunts that run the cases of some groups.

    Speeds are those at the beginning, in km/h. Without ``grid``, the boundary between crashes and survived cases is
    searched.

    Raises:
        UsageError: a speed is out of range.
    """
    low, high = _SPEEDS_KMH
    for speed in speeds:
        if not low <= speed <= high:
            raise UsageError(f"--speeds contains {speed} (allowed: {low} to {high})", fix="give speeds in km/h")
    for group in groups:
        for name, extra in _parts(group, speeds):
            values = {**group.constants, **group.axes, **extra}
            yield (
                group,
                SuiteEntry(
                    **{
                        "keep": 1,
                        **options,
                        "id": name,
                        "scenario": group.scenario,
                        "agent": agent,
                        "scenario_arguments": values,
                        "sampler": "grid" if grid else "boundary",
                        "trials": _cells(values),
                        "max_steps": STEPS,
                        "keep_going": True,
                    }
                ),
            )


def _parts(group: CaseGroup, speeds: Sequence[int]) -> Iterator[tuple[str, Mapping[str, str]]]:
    """Yield the name and the remaining arguments of each hunt of a group.

    A cut-in needs a slower vehicle, so it has a hunt for each speed.
    """
    if group.id != "cut-in":
        yield group.id, {"ego_kmh": "|".join(map(str, speeds))}
        return
    for speed in speeds:
        slower = (speed - 1) // 10 * 10
        others = f"10:{slower}:10" if slower > 10 else str(slower or speed // 2)
        yield f"{group.id}-{speed}", {"ego_kmh": str(speed), "other_kmh": others}


def _cells(values: Mapping[str, str]) -> int:
    return math.prod(len(parse_spec(text, "float").grid(1)) for text in values.values())


# The results of the cases.

_STEP_S = 0.1


@dataclass(frozen=True, slots=True)
class Share:
    """A share of the cases of one or several hunts, with a 95 % interval."""

    # for each hunt its number of cases, of random cases, and of random cases that count. If all cases of a hunt ran,
    # all of them are random cases.
    counts: tuple[tuple[int, int, int], ...]

    @property
    def value(self) -> float | None:
        """The share; None if no random case ran."""
        ends = self._ends()
        return None if ends is None else ends[0]

    @property
    def interval(self) -> tuple[float, float] | None:
        """The 95 % interval; None if no random case ran.

        The interval of one hunt is that of Wilson, or a point if all cases ran. Those of several hunts are combined by
        MOVER (Zou and Donner, Statistics in Medicine 27, 2008).
        """
        ends = self._ends()
        return None if ends is None else (max(0.0, ends[0] - ends[1]), min(1.0, ends[0] + ends[2]))

    def _ends(self) -> tuple[float, float, float] | None:
        if not self.counts or any(drawn == 0 for _, drawn, _ in self.counts):
            return None
        total = sum(cases for cases, _, _ in self.counts)
        value = below = above = 0.0
        for cases, drawn, found in self.counts:
            weight, share = cases / total, found / drawn
            low, high = (share, share) if drawn == cases else wilson(found, drawn)
            value += weight * share
            below += (weight * (share - low)) ** 2
            above += (weight * (high - share)) ** 2
        return value, math.sqrt(below), math.sqrt(above)

    def to_json(self) -> JsonObject:
        """Return JSON-compatible data."""
        drawn, found = sum(one[1] for one in self.counts), sum(one[2] for one in self.counts)
        interval = self.interval
        return {
            "share": self.value,
            "interval": None if interval is None else list(interval),
            "random_cases": drawn,
            "found": found,
        }


@dataclass(frozen=True, slots=True, eq=False)
class ScorecardHunt:
    """The cases of one hunt: which ran, how they ended, and how the models end."""

    group: CaseGroup
    state: HuntState
    axes: Mapping[str, tuple[Value, ...]]  # the values of each argument that varies, in the order of the names
    constants: Mapping[str, Value]  # the other arguments of the scenario
    ran: Mapping[int, bool]  # for each case that ran, whether the agent crashed, by the index of the case
    random: frozenset[int]  # the cases that were drawn at random
    invalid: int  # number of cases that could not be set up
    drivers: Mapping[str, Labels]  # whether each model crashes, by case; models that do not apply are missing
    facts: JsonObject  # seed, digests and versions
    units: Mapping[str, str] = field(default_factory=dict)  # unit of each argument; a missing unit is empty

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of values along each axis."""
        return tuple(len(values) for values in self.axes.values())

    @property
    def cases(self) -> int:
        """Number of cases."""
        return math.prod(self.shape)

    @property
    def agent(self) -> Labels | None:
        """Whether the agent crashes, by case. A case that has not run ends like the nearest one; None if none ran."""
        return nearest_labels(self.shape, dict(self.ran)) if self.ran else None

    def only_agent(self, model: str) -> tuple[int, int, int]:
        """Return the number of cases, of random cases, and of those in which the agent crashes and a model does not."""
        found = sum(self.ran[case] and not bool(self.drivers[model][case]) for case in self.random)
        return self.cases, len(self.random), found

    def maps(self) -> Iterator[JsonObject]:
        """Yield a map for each combination of the values of all other arguments."""
        names = list(self.axes)
        x, y = self.group.x, self.group.y
        order = [*(place for place, name in enumerate(names) if name not in (x, y)), names.index(y), names.index(x)]
        agent = self.agent
        ran = np.zeros(self.cases, bool)
        ran[list(self.ran)] = True

        def turned(labels: Labels) -> Labels:
            return labels.reshape(self.shape).transpose(order)

        others = [names[place] for place in order[:-2]]
        for index in itertools.product(*(range(len(self.axes[name])) for name in others)):
            fixed = {name: self.axes[name][place] for name, place in zip(others, index, strict=True)}
            yield {
                "fixed": {**self.constants, **fixed},
                "x": {"name": x, "unit": self.units.get(x, ""), "values": list(self.axes[x])},
                "y": {"name": y, "unit": self.units.get(y, ""), "values": list(self.axes[y])},
                "ran": turned(ran)[index].tolist(),
                "agent": None if agent is None else turned(agent)[index].tolist(),
                "drivers": {model: turned(labels)[index].tolist() for model, labels in self.drivers.items()},
            }


@dataclass(frozen=True, slots=True, eq=False)
class Scorecard:
    """The results of an agent in the cases of a suite."""

    suite: str
    agent: str
    grid: bool
    hunts: tuple[ScorecardHunt, ...]

    @property
    def groups(self) -> dict[str, tuple[ScorecardHunt, ...]]:
        """The hunts by the id of their group."""
        found: dict[str, tuple[ScorecardHunt, ...]] = {}
        for hunt in self.hunts:
            found[hunt.group.id] = (*found.get(hunt.group.id, ()), hunt)
        return found

    @property
    def is_complete(self) -> bool:
        """Whether all hunts have run to their end."""
        return all(hunt.state.state in ("finished", "crashed") for hunt in self.hunts)

    def to_json(self) -> JsonObject:
        """Return JSON-compatible data."""
        return {
            "suite": self.suite,
            "agent": self.agent,
            "crashhunt": __version__,
            "method": "grid" if self.grid else "boundary",
            "steps": STEPS,
            "complete": self.is_complete,
            "cases": sum(hunt.cases for hunt in self.hunts),
            "ran": sum(len(hunt.ran) for hunt in self.hunts),
            "preventable_by": _shares_of(self.hunts),
            "groups": [
                {
                    "id": name,
                    "scenario": hunts[0].group.scenario,
                    "paragraph": hunts[0].group.paragraph,
                    "cases": sum(hunt.cases for hunt in hunts),
                    "ran": sum(len(hunt.ran) for hunt in hunts),
                    "invalid": sum(hunt.invalid for hunt in hunts),
                    "crashes": crashes_of(hunts, None),
                    "crashes_of_drivers": {model: crashes_of(hunts, model) for model in COMPETENT_DRIVERS},
                    "preventable_by": _shares_of(hunts),
                    "why_not": hunts[0].group.why_not,
                    "hunts": [hunt.facts for hunt in hunts],
                    "maps": [one for hunt in hunts for one in hunt.maps()],
                }
                for name, hunts in self.groups.items()
            ],
        }


def crashes_of(hunts: Iterable[ScorecardHunt], model: str | None) -> int | None:
    """Return in how many cases the agent, or a model, crashes; None if that is unknown, or the model does not apply."""
    labels = [hunt.agent if model is None else hunt.drivers.get(model) for hunt in hunts]
    return None if any(one is None for one in labels) else sum(int(one.sum()) for one in labels if one is not None)


def _shares_of(hunts: Iterable[ScorecardHunt]) -> JsonObject:
    """Return for each model the share of cases in which the agent crashes and the model does not.

    The share concerns the cases to which the model applies. It is None if there are none.
    """
    hunts = list(hunts)
    found: JsonObject = {}
    for model in COMPETENT_DRIVERS:
        applies = [hunt for hunt in hunts if model in hunt.drivers]
        share = Share(tuple(hunt.only_agent(model) for hunt in applies))
        found[model] = {"cases": sum(hunt.cases for hunt in applies), **share.to_json()} if applies else None
    return found


def run_scorecard(
    suite: str,
    agent: str,
    directory: Path,
    *,
    speeds: Sequence[int] = (20, 40, 60),
    groups: Sequence[str] = (),
    grid: bool = False,
    options: Given | None = None,
    parallel: int = 0,
    watch: Callable[[list[HuntState]], None] | None = None,
    trusted: bool = False,
) -> Scorecard:
    """Run the cases of a suite that have not run, and return the scorecard.

    The arguments are those of ``crashhunt scorecard``. ``watch`` is called about once a second with the states of the
    hunts.

    Raises:
        UsageError: an option is invalid.
        UntrustedError: an existing hunt was not made on this machine and is not trusted.
        HuntDirectoryError: the directory contains something else.
        KeyboardInterrupt: the user has interrupted the run; the same call resumes it.
    """
    entries = list(entries_of(groups_of(suite, groups), agent, speeds, grid=grid, options=options or {}))
    made = Suite([entry for _, entry in entries])
    states = made.run(directory, parallel, watch=watch, trusted=trusted, stop_on_error=True)
    for state in states:
        if state.state == "error":
            raise HuntDirectoryError(
                f"the hunt could not run: {state.detail}", fix="correct this, and delete the directory", where=state.dir
            )
    hunts = (_read(group, directory / entry.id / "0") for group, entry in entries)
    return Scorecard(suite, agent, grid=grid, hunts=tuple(hunts))


def _read(group: CaseGroup, directory: Path) -> ScorecardHunt:
    results = HuntResults(directory)
    settings = results.settings
    space = {name: settings.space["", name] for name in sorted(settings.scenario_arguments)}
    values = {name: known.grid(settings.points) for name, known in space.items()}
    shown = {group.x, group.y}
    axes = {name: one for name, one in values.items() if len(one) > 1 or name in shown}
    constants = {name: one[0] for name, one in values.items() if name not in axes}
    cells = {cell: number for number, cell in enumerate(itertools.product(*axes.values()))}
    ran: dict[int, bool] = {}
    random: set[int] = set()
    digest, invalid = hashlib.sha256(), 0
    for row in sorted(results.trial_rows(), key=lambda one: one.number):
        cell = cells[tuple(row.scenario_arguments[name] for name in axes)]
        digest.update(f"{row.number} {row.outcome} {row.data['digest']}\n".encode())
        if row.outcome is Outcome.INVALID:
            invalid += 1
            continue
        ran[cell] = row.outcome in settings.crash_on
        if row.origin in (SAMPLE, ""):
            random.add(cell)
    if settings.sampler == "grid" and len(ran) < len(cells):
        random.clear()  # an interrupted grid has the first cases only
    scenario = load_scenario(group.scenario)
    manoeuvre = group.id.replace("-", "_")
    cases = [{**constants, **dict(zip(axes, cell, strict=True))} for cell in cells]
    maps = ReferenceMaps(manoeuvre, cases, steps=STEPS, step_s=_STEP_S) if group.models else None
    snapshot = latest_snapshot(directory)
    return ScorecardHunt(
        group=group,
        state=results.state,
        axes=axes,
        constants=constants,
        ran=ran,
        random=frozenset(random),
        invalid=invalid,
        drivers={} if maps is None else {model: maps.crashes(model) for model in group.models},
        facts={
            "dir": str(directory),
            "state": results.state.state,
            "seed": settings.seed,
            "scenario_digest": settings.scenario_digest,
            "snapshot": "" if snapshot is None else snapshot.digest,
            "trials": len(ran),
            "trials_digest": digest.hexdigest()[:32],
            "versions": {} if snapshot is None else dict(snapshot.environment["versions"]),
        },
        units={name: one.unit for name, one in scenario.arguments.items()},
    )


# In which cases of a manoeuvre each model of a competent driver crashes, by equations of motion.
#
# The controlled vehicle keeps its speed until the model brakes. First the speed changes, then the position by the new
# speed. The other road users move as in the scenarios. A model watches every vehicle, and the strongest braking counts.

_LANE_M = 3.5
_WANDERING_M = 0.375  # from here on, a vehicle ahead shows what is ahead of it. Source: UN R157, table 1
_TIE_M = 1e-9
_KMH = 3.6
_OWN = actor_of_manoeuvre("ego")
# In cut-outs, R157 has the careful human react when the standing vehicle becomes visible, at any distance.
_REACTS_AT_ONCE = {("cut_out", "cc_human"): {"early_s": 1000.0}}


class ReferenceMaps:
    """The motions of all road users in some cases of a manoeuvre, and how each model would end."""

    def __init__(self, manoeuvre: str, cases: Sequence[Mapping[str, Value]], *, steps: int, step_s: float) -> None:
        self._manoeuvre, self._step_s, self._count = manoeuvre, step_s, len(cases)
        self._speeds = np.array([float(case["ego_kmh"]) / _KMH for case in cases])
        self._own_y = 0.0
        found: dict[str, Values] = {}
        for number, case in enumerate(cases):
            values = {name: float(value) for name, value in case.items() if isinstance(value, int | float)}
            self._own_y, next_y = (0.0, _LANE_M) if values.get("side", -1.0) >= 0 else (_LANE_M, 0.0)
            states = manoeuvre_motions(manoeuvre, values, self._own_y, next_y, step_s)
            for step in range(steps):
                for name, state in next(states).items():
                    if name not in found:
                        found[name] = np.full((3, steps, self._count), np.nan)
                    found[name][:, step, number] = state.x, state.y - self._own_y, state.speed
        self._tracks, self._steps = found, steps

    def crashes(self, model: str) -> NDArray[np.bool_]:
        """Return whether the model crashes in each case."""
        more = _REACTS_AT_ONCE.get((self._manoeuvre, model), {})
        drivers = {name: REFERENCE_MODELS[model](self._count, self._step_s, **more) for name in self._tracks}
        before: dict[str, Values] = {}
        speed, front = self._speeds, np.full(self._count, START_M)
        crashed = np.zeros(self._count, bool)
        for step in range(self._steps):
            acceleration = np.zeros(self._count)
            for name, (xs, ys, speeds) in self._tracks.items():
                other = actor_of_manoeuvre(name)
                present = ~np.isnan(xs[step])
                gap = np.where(present, xs[step] - other.length - front, np.inf)
                side = np.where(present, np.abs(ys[step]) - (other.width + _OWN.width) / 2, np.inf)
                length = other.length + _OWN.length
                crashed |= (side < 0) & (gap <= 0) & (gap > -length)
                with np.errstate(invalid="ignore"):
                    towards = (before.get(name, side) - side) / self._step_s
                before[name] = side
                situation = Situation(
                    speed=speed,
                    other_speed=np.where(present, speeds[step], 0.0),
                    gap=gap,
                    lateral_gap=side,
                    lateral_speed=np.where(present, np.nan_to_num(np.maximum(0.0, towards), posinf=0.0), 0.0),
                    length=np.full(self._count, _OWN.length),
                    other_length=np.full(self._count, other.length),
                    visible=present & self._is_shown(name, step),
                )
                acceleration = np.minimum(acceleration, drivers[name].brake(situation))
            speed = np.where(crashed, 0.0, np.maximum(0.0, speed + acceleration * self._step_s))
            front = front + speed * self._step_s
        if self._manoeuvre == "cut_in":  # a risk that the model has classified as harmless
            crashed &= ~drivers["other"].dismissed
        return crashed

    def _is_shown(self, name: str, step: int) -> NDArray[np.bool_]:
        """Return whether no vehicle ahead hides a standing vehicle."""
        if name != "standing" or "leader" not in self._tracks:
            return np.ones(self._count, bool)
        _, ys, speeds = self._tracks["leader"]
        shown: NDArray[np.bool_] = (np.abs(ys[step]) >= _WANDERING_M - _TIE_M) | (speeds[step] <= 0)
        return shown
