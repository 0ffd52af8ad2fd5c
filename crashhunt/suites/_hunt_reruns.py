"""Reruns: failed hunts run again in place, or a changed version of a hunt runs in another directory."""

from __future__ import annotations

from contextlib import closing
from dataclasses import asdict, replace
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.errors import HuntDirectoryError, UsageError
from crashhunt.base.files import is_empty_folder, sync_folder
from crashhunt.base.temporary import new_folder
from crashhunt.base.text import command_line
from crashhunt.disturbances import NONE
from crashhunt.ledger import Ledger
from crashhunt.plans import (
    HuntSettings,
    Owners,
    Request,
    Takes,
    TrialOptions,
    fields_of,
    read_settings,
    spec_words,
    takes_of,
)
from crashhunt.results import HuntState, hunt_state
from crashhunt.scenario import load_scenario, shipped_scenarios, with_stated_choice
from crashhunt.snapshots import latest_snapshot
from crashhunt.suites._processes import check_machine, run_all, set_aside
from crashhunt.suites._request_file import REQUEST, RunRequest, refuse_untrusted_hunt, write_request
from crashhunt.trial import Outcome

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from crashhunt.plans import Given

_NUMBER_OPTIONS = ("trials", "max_steps", "seed")  # what --set changes besides arguments


def rerun(
    hunts: Sequence[Path],
    *,
    everything: bool = False,
    changes: Mapping[str, str] | None = None,
    to: Path | None = None,
    parallel: int = 0,
    watch: Callable[[list[HuntState]], None] | None = None,
    machine: Given | None = None,
    trusted: bool = False,
) -> tuple[list[HuntState], list[Path]]:
    """Run hunts again; return their states, and the folders to which replaced files were moved.

    A hunt that ended in an error runs again. A hunt that was interrupted or killed resumes. A hunt with trials that
    could not be set up repeats these trials. Finished hunts stay unchanged.

    Args:
        hunts: directories of the hunts.
        everything: whether to run all hunts again, including finished hunts.
        changes: new value by name: ``NAME`` or ``AGENT.NAME`` of an argument, ``trials``, ``max_steps`` or ``seed``.
        to: directory in which a changed version of a single hunt runs; the directory of the original hunt does not
            change.
        parallel: number of trials at a time, of all hunts together; 0 for one per core.
        watch: function called about once a second with the states of the hunts.
        machine: execution options, such as ``executor``, that replace the options of all hunts.
        trusted: whether the code that the hunts name may run; otherwise every hunt must be trusted before the first
            hunt starts.

    Raises:
        UsageError: a change names an unknown argument or an invalid value.
        UntrustedError: a hunt is neither made here nor trusted.
        HuntDirectoryError: a directory cannot be read or written.
    """
    check_machine(parallel, machine)
    for hunt in () if trusted else hunts:
        refuse_untrusted_hunt(hunt)
    changes = changes or {}
    if to is not None:
        return _run_copies(hunts, to, changes, parallel, watch, machine), []
    if changes and not everything:
        raise UsageError(
            f"--set {next(iter(changes))}: a hunt cannot change its settings",
            fix="give --to DIR for a new hunt, or --all to start over",
        )
    busy = [hunt for hunt in hunts if hunt_state(hunt).state == "running"]
    if busy:
        raise HuntDirectoryError("the hunt is running", fix="wait for it, or stop it", where=str(busy[0]))
    # First everything that may fail, so that nothing is moved away for nothing.
    requests = {hunt: _changed(_request(hunt), changes, hunt) for hunt in hunts}
    again, replaced = [], []
    for hunt in hunts:
        state = hunt_state(hunt)
        if everything or state.state == "error":
            replaced.append(set_aside(hunt, partial(_with_moved_scenario, requests[hunt], hunt)))
        elif state.failed or state.state == "queued" or _replace_invalid(hunt, state):
            write_request(hunt, requests[hunt])
        else:
            continue
        again.append(hunt)
    run_all(
        again,
        parallel,
        watch=None if watch is None else lambda: watch([hunt_state(hunt) for hunt in hunts]),
        machine=machine,
    )
    return [hunt_state(hunt) for hunt in hunts], replaced


def _request_of(settings: HuntSettings) -> Request:
    """Return the request that would result in the given settings."""
    arguments = {
        f"{agent}.{name}": spec.spec
        for agent, chosen in settings.agents.items()
        for name, spec in chosen.arguments.items()
    }
    options = {name: getattr(settings, name) for name in fields_of(TrialOptions)}
    actions = {with_stated_choice(chosen.action or "") for chosen in settings.agents.values()}
    return Request(
        **asdict(settings.run),
        **{**options, "crash_on": settings.crash_on_words, "disturb": settings.disturb or (NONE,)},
        trials=settings.trials,
        max_steps=settings.max_steps,
        scenario=settings.scenario,
        action=actions.pop() if len(actions) == 1 else "",  # otherwise the scenario or the agents name the forms
        observe=next((chosen.observation for chosen in settings.agents.values() if chosen.observation), ()),
        agents={agent: chosen.agent for agent, chosen in settings.agents.items()},
        arguments=arguments,
        scenario_arguments={name: spec.spec for name, spec in settings.scenario_arguments.items()},
    )


def _request(hunt: Path) -> RunRequest:
    if (hunt / REQUEST).exists():
        return RunRequest.read(hunt / REQUEST)
    settings = read_settings(hunt / layout.HUNT)
    request = _request_of(settings)
    if settings.scenario not in shipped_scenarios():
        # Where the hunt was started from is not known; the scenario is in the snapshot.
        snapshot = latest_snapshot(hunt)
        scenario = Path(settings.scenario) if snapshot is None else snapshot.path / "scenario" / layout.SCENARIO
        request = replace(request, scenario=str(scenario.resolve()))
    return RunRequest(request, str(Path.cwd()))


def _with_moved_scenario(asked: RunRequest, hunt: Path, aside: Path) -> RunRequest:
    """Return the settings with the scenario of the snapshot, which has been moved with all replaced files."""
    scenario = Path(asked.request.scenario)
    if not scenario.is_relative_to(hunt.resolve()):
        return asked
    moved = aside.resolve() / scenario.relative_to(hunt.resolve())
    return replace(asked, request=replace(asked.request, scenario=str(moved)))


def _changed(asked: RunRequest, changes: Mapping[str, str], hunt: Path) -> RunRequest:
    request = asked.request
    arguments, scenario_arguments = spec_words(request.arguments), spec_words(request.scenario_arguments)
    owners = _Names(asked, hunt) if changes else None
    for name, spec in changes.items():
        if name in _NUMBER_OPTIONS:
            if not spec.isdecimal():
                raise UsageError(f"--set {name}={spec}: {spec!r} is not a whole number", fix="give a whole number")
            number: Given = {name: int(spec)}
            request = replace(request, **number)
        elif owners is not None:
            agent, argument = owners.owner(name)
            if not agent:
                scenario_arguments[argument] = spec
                continue
            # The same argument may have been written with the agent's id, or without.
            for other in [other for other in arguments if owners.find(other) == (agent, argument)]:
                del arguments[other]
            arguments[f"{agent}.{argument}"] = spec
    request = replace(request, arguments=arguments, scenario_arguments=scenario_arguments)
    return replace(asked, request=request)


class _Names:
    """Resolves names of arguments to agents, for a hunt that has run or is planned."""

    def __init__(self, asked: RunRequest, hunt: Path) -> None:
        request = asked.request
        scenario = load_scenario(request.scenario, ego=request.ego)
        given = request.locators
        drivers = {agent: given.get(agent) or given.get("") or setup.agent for agent, setup in scenario.agents.items()}
        scenario = scenario.with_agents(drivers)
        known = {agent: dict.fromkeys(scenario.agent_arguments(agent)) for agent in drivers}
        if (hunt / layout.HUNT).exists():
            for agent, chosen in read_settings(hunt / layout.HUNT).agents.items():
                known.get(agent, {}).update(dict.fromkeys(chosen.arguments))
        takes = {agent: Takes(tuple(names)) for agent, names in known.items()}
        self._owners = Owners(takes, tuple(scenario.scenario_arguments()))
        self._ask = cache(lambda agent: takes_of(drivers[agent], folder=Path(asked.folder)))

    def find(self, word: str) -> tuple[str, str] | None:
        return self._owners.of_record(word, self._ask)

    def owner(self, word: str) -> tuple[str, str]:
        owner = self.find(word)
        if owner is None:
            raise self._owners.unknown(word, option="--set", whose="the hunt")
        return owner


def _replace_invalid(hunt: Path, state: HuntState) -> int:
    """Run the trials again that could not be set up, unless the hunt has reached its goal."""
    run = read_settings(hunt / layout.HUNT).run
    done = (state.crashes and not run.keep_going) or 0 < run.distinct <= len(state.kinds or ())
    if not state.outcomes.get(Outcome.INVALID):
        return 0
    with closing(Ledger(hunt / layout.LEDGER, writable=True)) as ledger:
        # With --only-at-fault or --by-cause, the crash types do not show whether it has found what it was after.
        is_counted = not run.only_at_fault and not run.by_cause
        if ledger.facts().get("state") in ("crash", "distinct", "rate") or (done and is_counted):
            return 0
        return ledger.replace([result.spec.number for result in ledger.results(outcomes=(str(Outcome.INVALID),))])


def _run_copies(
    hunts: Sequence[Path],
    to: Path,
    changes: Mapping[str, str],
    parallel: int,
    watch: Callable[[list[HuntState]], None] | None,
    machine: Given | None,
) -> list[HuntState]:
    if len(hunts) != 1:
        raise UsageError(f"--to takes one hunt, but there are {len(hunts)}", fix="choose one with --run")
    request = _changed(_request(hunts[0]), changes, hunts[0])
    try:
        if to.exists() and not is_empty_folder(to):
            _require_same_request(to, request)
        else:
            with new_folder(to) as building:  # one that is there has its request
                write_request(building, request)
            sync_folder(to.absolute().parent, to)
    except OSError as error:
        raise HuntDirectoryError(
            f"cannot be created: {error.strerror}", fix="choose another directory", where=str(to)
        ) from error
    if hunt_state(to).state in ("queued", "killed", "interrupted"):
        run_all([to], parallel, watch=None if watch is None else lambda: watch([hunt_state(to)]), machine=machine)
    return [hunt_state(to)]


def _require_same_request(to: Path, request: RunRequest) -> None:
    """Check that a directory belongs to the same command, which was killed or interrupted.

    Raises:
        HuntDirectoryError: the directory has other contents, its hunt is running, or its hunt ended in an error.
    """
    try:
        same = RunRequest.read(to / REQUEST).to_plain() == request.to_plain()
    except HuntDirectoryError:
        same = False
    if not same:
        raise HuntDirectoryError("the directory exists already", fix="give a new directory", where=str(to))
    state = hunt_state(to).state
    if state == "running":
        raise HuntDirectoryError("the hunt is running", fix="wait for it, or stop it", where=str(to))
    if state == "error":
        fix = f"see {command_line('crashhunt', 'logs', to)}, then {command_line('crashhunt', 'rerun', to)}"
        raise HuntDirectoryError("the directory exists, and its hunt ended in an error", fix=fix, where=str(to))
