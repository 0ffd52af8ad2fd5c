"""A scorecard: where an agent crashes in all cases of a regulation, next to models of a competent driver."""

from __future__ import annotations

import hashlib
import itertools
import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from crashhunt.base.errors import HuntDirectoryError
from crashhunt.base.version import __version__
from crashhunt.crashes import COMPETENT_DRIVERS, wilson
from crashhunt.results import HuntResults
from crashhunt.samplers import SAMPLE, nearest_labels
from crashhunt.scenario import load_scenario
from crashhunt.snapshots import latest_snapshot
from crashhunt.suites._reference_maps import ReferenceMaps
from crashhunt.suites._scorecard_groups import STEPS, entries_of, groups_of
from crashhunt.suites._suite_file import Suite
from crashhunt.trial import Outcome

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from crashhunt.base.codec import JsonObject
    from crashhunt.plans import Given
    from crashhunt.results import HuntState
    from crashhunt.suites._scorecard_groups import Group
    from crashhunt.trial import Value

    Labels = NDArray[np.bool_]

_STEP_S = 0.1


@dataclass(frozen=True, slots=True)
class Share:
    """A share of the cases of one or several hunts, with a 95 % interval.

    Args:
        counts: for each hunt its number of cases, of random cases, and of random cases that count. If all cases of a
            hunt ran, all of them are random cases.
    """

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
    """The cases of one hunt: which ran, how they ended, and how the models end.

    Args:
        group: the group of the cases.
        state: state of the hunt.
        axes: the values of each argument that varies, in the order of the names.
        constants: the other arguments of the scenario.
        ran: for each case that ran, whether the agent crashed, by the index of the case.
        random: the cases that were drawn at random.
        invalid: number of cases that could not be set up.
        drivers: whether each model crashes, by case; models that do not apply are missing.
        facts: seed, digests and versions.
        units: unit of each argument; a missing unit is empty.
    """

    group: Group
    state: HuntState
    axes: Mapping[str, tuple[Value, ...]]
    constants: Mapping[str, Value]
    ran: Mapping[int, bool]
    random: frozenset[int]
    invalid: int
    drivers: Mapping[str, Labels]
    facts: JsonObject
    units: Mapping[str, str] = field(default_factory=dict)

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
    """The results of an agent in the cases of a suite.

    Args:
        suite: name of the suite.
        agent: the agent.
        grid: whether all cases were to run.
        hunts: the hunts, in the order of the groups.
    """

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
            "preventable_by": shares_of(self.hunts),
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
                    "preventable_by": shares_of(hunts),
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


def shares_of(hunts: Iterable[ScorecardHunt]) -> JsonObject:
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

    Args:
        suite: name of the suite.
        agent: the agent.
        directory: directory for the hunts.
        speeds: speeds of the agent at the beginning, in km/h.
        groups: ids of the groups to run; by default all groups.
        grid: whether to run every case; otherwise the boundary between crashes and survived cases is searched.
        options: further options of the hunts.
        parallel: number of trials at a time; 0 for one per core.
        watch: function called about once a second with the states of the hunts.
        trusted: whether existing hunts may run without a question.

    Raises:
        UsageError: an option is invalid.
        UntrustedError: an existing hunt was not made on this machine and is not trusted.
        HuntDirectoryError: the directory contains something else.
        KeyboardInterrupt: the user has interrupted the run; the same call resumes it.
    """
    entries = list(entries_of(groups_of(suite, groups), agent, speeds, grid=grid, options=options or {}))
    made = Suite([entry for _, entry in entries])
    states = made.run(directory, parallel, watch=watch, trusted=trusted)
    for state in states:
        if state.state == "error":
            raise HuntDirectoryError(
                f"the hunt could not run: {state.detail}", fix="correct this, and delete the directory", where=state.dir
            )
    hunts = (_read(group, directory / entry.id / "0") for group, entry in entries)
    return Scorecard(suite, agent, grid=grid, hunts=tuple(hunts))


def _read(group: Group, directory: Path) -> ScorecardHunt:
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
            "versions": {} if snapshot is None else dict(snapshot.environment()["versions"]),
        },
        units={name: one.unit for name, one in scenario.arguments.items()},
    )
