"""`suite.toml`: a list of hunts; each runs several times with different seeds. Most keys are the options of hunts."""

from __future__ import annotations

import json
import re
import secrets
import tomllib
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from crashhunt.base.calls import clear_constructor
from crashhunt.base.errors import CrashhuntError, HuntDirectoryError, UsageError
from crashhunt.base.text import command_line, listed, near_path
from crashhunt.base.validation import validate
from crashhunt.plans import HuntOptions, Request, fields_of, hunt_options
from crashhunt.results import HuntState, find_hunts, hunt_state, is_hunt
from crashhunt.scenario import load_scenario, shipped_scenarios
from crashhunt.snapshots import code_differences, latest_snapshot
from crashhunt.suites._processes import check_machine, run_all
from crashhunt.suites._request_file import REQUEST, RunRequest, refuse_untrusted_hunt, write_request

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from crashhunt.plans import Given

_ENTRY_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9._+=-]*")


@clear_constructor
@dataclass(frozen=True, kw_only=True)
class SuiteEntry(HuntOptions):
    """``[[hunts]]``: one hunt of a suite; ``[defaults]`` has the same keys. The fields are the options of hunts.

    Args:
        id: name of the hunt's folder; unique in the suite.
        agent: the agent that drives, if the scenario has one controlled vehicle.
        agents: agent of each vehicle, if the scenario has several controlled vehicles.
        runs: number of runs, each with its own seed.
        trials: maximum number of trials of each run.
        max_steps: maximum number of steps of each trial.
    """

    # Paths of scenario and snapshot_roots are from the folder of the file; the seeds of the runs come from seed.
    id: str = ""
    agent: str = ""
    agents: dict[str, str] = field(default_factory=dict)
    runs: int = 1
    trials: int = 100
    max_steps: int = 1500


@dataclass(frozen=True, kw_only=True)
class _File:
    hunts: tuple[dict[str, object], ...]
    defaults: dict[str, object] = field(default_factory=dict)
    schema: int = 1


@clear_constructor
class Suite:
    """A list of hunts to run in one directory.

    Args:
        entries: the hunts of the suite.
        folder: folder to which relative paths of scenarios refer, and from which agents are imported.

    Raises:
        UsageError: an id is missing, is used twice, or is not a valid folder name; or a value of an entry is invalid.
    """

    def __init__(self, entries: Sequence[SuiteEntry], *, folder: Path | None = None) -> None:
        self.entries = tuple(entries)
        self.folder = (folder or Path.cwd()).resolve()
        seen: set[str] = set()
        for place, entry in enumerate(self.entries):
            if not _ENTRY_ID.fullmatch(entry.id):
                raise UsageError(
                    f"hunts[{place}].id = {entry.id!r} is not a valid folder name", fix="use letters, digits and ._+=-"
                )
            if entry.id.lower() in seen:
                raise UsageError(f"the id {entry.id!r} is used twice", fix="give each hunt its own id")
            seen.add(entry.id.lower())
            if entry.runs < 1:
                raise UsageError(f"hunts.{entry.id}.runs = {entry.runs}", fix="give at least 1")
            if entry.seed is not None and entry.seed < 0:
                raise UsageError(f"hunts.{entry.id}.seed = {entry.seed}", fix="give at least 0")
            for path in (entry.scenario, *entry.snapshot_roots):
                if "\0" in str(path):
                    raise UsageError(f"hunts.{entry.id}: {str(path)!r} is not a path", fix="remove the null byte")
            if entry.agent and entry.agents:
                raise UsageError(f"hunts.{entry.id} has both agent and agents", fix="give one of them")
            try:
                self.request(entry, 0).request.checked()
            except UsageError as error:
                raise UsageError(f"hunts.{entry.id}: {_in_keys(error.message)}", fix=_in_keys(error.fix)) from None

    def __repr__(self) -> str:
        runs = sum(entry.runs for entry in self.entries)
        return f"<suite of {len(self.entries)} hunts, {runs} runs: {', '.join(entry.id for entry in self.entries)}>"

    @classmethod
    def read(cls, path: Path | str) -> Suite:
        """Read a ``suite.toml``.

        Raises:
            UsageError: the file is missing or not valid; the message names the key, its value and the fix.
        """
        file = Path(path)
        try:
            data = tomllib.loads(file.read_text(encoding="utf-8"))
        except OSError as error:
            fix = f"{near_path(file, '.toml')}give a suite.toml"
            raise UsageError(f"cannot be read: {error.strerror}", fix=fix, where=str(file)) from None
        except (ValueError, RecursionError) as error:
            raise UsageError(f"not valid TOML: {error}", fix="correct the file", where=str(file)) from None
        whole = validate(_File, data, where=str(file), error=UsageError)
        if whole.schema != 1:
            raise UsageError(
                f"schema = {whole.schema} is not supported", fix="this crashhunt reads schema 1", where=str(file)
            )
        if not whole.hunts:
            raise UsageError("the file lists no hunts", fix="add [[hunts]]", where=str(file))
        entries = []
        for place, given in enumerate(whole.hunts):
            merged = _merged(whole.defaults, given)
            where = f"{file}, hunts.{given.get('id', place)}"
            entries.append(validate(SuiteEntry, merged, where=where, error=UsageError))
        try:
            return cls(entries, folder=file.resolve().parent)
        except UsageError as error:
            raise UsageError(error.message, fix=error.fix, where=str(file)) from None

    def plan(self, directory: Path | str) -> list[Path]:
        """Create a folder with a request for every run. A second call changes nothing.

        Raises:
            HuntDirectoryError: the directory contains another suite, or cannot be written.
        """
        place = Path(directory)
        if is_hunt(place):
            raise HuntDirectoryError(
                "the directory contains a hunt, not a suite", fix="give another directory", where=str(place)
            )
        planned: dict[Path, RunRequest] = {}
        for entry in self.entries:
            for number in range(entry.runs):
                folder = place / entry.id / str(number)
                planned[folder] = self._planned(entry, number, folder)
        try:
            place.mkdir(exist_ok=True)
            for folder, request in planned.items():
                if not (folder / REQUEST).exists() or RunRequest.read(folder / REQUEST) != request:
                    folder.mkdir(parents=True, exist_ok=True)
                    write_request(folder, request)
            return list(planned)
        except OSError as error:
            raise HuntDirectoryError(
                f"cannot be created: {error.strerror}",
                fix="choose another directory",
                where=str(error.filename or place),
            ) from error

    def run(
        self,
        directory: Path | str,
        parallel: int = 0,
        *,
        watch: Callable[[list[HuntState]], None] | None = None,
        machine: Given | None = None,
        trusted: bool = False,
        stop_on_error: bool = False,
    ) -> list[HuntState]:
        """Run all unfinished hunts; return the state of each hunt.

        Args:
            directory: directory of the suite; created if it does not exist. Finished hunts in the directory stay
                unchanged.
            parallel: number of trials at a time, of all hunts together; 0 for one per core.
            watch: function called about once a second with the states of the hunts.
            machine: execution options, such as ``executor``, that replace the options of all hunts.
            trusted: whether the code that existing hunts name may run; otherwise every hunt must be trusted before the
                first hunt starts.
            stop_on_error: whether the other hunts stop when one could not run. By default, they run.

        Raises:
            UntrustedError: an existing hunt was not made on this machine and is not trusted.
            HuntDirectoryError: the directory contains another suite, or cannot be written.
            PluginError: the executor does not exist.
        """
        check_machine(parallel, machine)
        folders = self.plan(directory)
        waiting = [folder for folder in folders if hunt_state(folder).state in ("queued", "interrupted", "killed")]
        for folder in () if trusted else waiting:
            refuse_untrusted_hunt(folder)
        states: list[HuntState] = []

        def look() -> None:
            states[:] = [hunt_state(folder) for folder in folders]
            if watch is not None:
                watch(states)

        run_all(
            waiting,
            parallel,
            watch=look,
            machine=machine,
            is_enough=lambda: stop_on_error and any(state.state == "error" for state in states),
        )
        return [hunt_state(folder) for folder in folders]

    def request(self, entry: SuiteEntry, number: int) -> RunRequest:
        """Return the request for one run of an entry, with the seed of the run.

        Args:
            entry: entry of the suite.
            number: number of the run, counted from 0.

        Raises:
            UsageError: the agent is not in a module that workers can import.
        """
        scenario = str(entry.scenario)
        if scenario not in shipped_scenarios():
            scenario = str((self.folder / scenario).resolve())
        seed = entry.seed if entry.seed is not None else secrets.randbits(32)
        drawn = np.random.SeedSequence(seed, spawn_key=(number,)).generate_state(1)[0]
        given = {name: getattr(entry, name) for name in fields_of(HuntOptions)}
        given |= {"scenario": scenario, "seed": int(drawn)}
        given["snapshot_roots"] = tuple(str((self.folder / root).resolve()) for root in entry.snapshot_roots)
        return RunRequest(Request(trials=entry.trials, max_steps=entry.max_steps, **given), str(self.folder))

    def _planned(self, entry: SuiteEntry, number: int, folder: Path) -> RunRequest:
        wanted = self.request(entry, number)
        if not (folder / REQUEST).exists():
            return wanted
        before = RunRequest.read(folder / REQUEST)
        if entry.seed is None:
            wanted = replace(wanted, request=replace(wanted.request, seed=before.request.seed))
        # A suite may allow new code later; `plan` then writes the request again.
        new_code = wanted.request.continue_with_new_code
        before = replace(before, request=replace(before.request, continue_with_new_code=new_code))
        if before != replace(wanted, folder=before.folder):
            raise HuntDirectoryError(
                f"the hunt {entry.id!r} was planned in this folder with other settings",
                fix="give another directory, or run the hunt again with crashhunt rerun",
                where=str(folder),
            )
        return before


def describe_finished(directory: Path) -> str:
    """Return that `Suite.run` does not run finished hunts again, and which files have changed since; may be empty.

    Versions of libraries are not compared, because their comparison would take a process for each hunt.
    """
    hunts = [hunt for hunt in find_hunts(directory) if hunt_state(hunt).state in ("finished", "crashed")]
    changed: dict[str, None] = {}
    for snapshot in {found.digest: found for hunt in hunts if (found := latest_snapshot(hunt)) is not None}.values():
        with suppress(CrashhuntError, OSError):  # a damaged snapshot is reported by `check`
            agents = [setup.agent for setup in snapshot.scenario.agents.values()]
            changed |= dict.fromkeys(code_differences(snapshot, agents) or ())
    if not hunts:
        return ""
    count, were = (f"{len(hunts)} hunts", "were") if len(hunts) > 1 else ("1 hunt", "was")
    said = f"{count} had finished before and {were} not run again"
    if not changed:
        return said
    names = listed(changed)
    again = command_line("crashhunt", "rerun", directory, "--all")
    return f"{said}, although files have changed since: {names}. Fix: {again} runs all hunts with today's files"


def default_suite() -> str:
    """Return the text of a ``suite.toml`` with every shipped scenario, as a template for the user."""
    lines = [
        "# Every scenario that comes with crashhunt. Run it with: crashhunt suite run FILE DIR",
        "schema = 1",
        "",
        "[defaults]  # of every hunt; any of these may stand in a hunt as well",
        "runs = 1            # each with a seed of its own",
        "trials = 300",
        "max_steps = 1500",
        "keep_going = false  # true: collect all crashes instead of stopping at the first",
    ]
    for name in sorted(shipped_scenarios()):
        scenario = load_scenario(name)
        lines += ["", "[[hunts]]", f'id = "{name}"', f'scenario = "{name}"']
        agents = {agent: setup.agent for agent, setup in scenario.agents.items()}
        if len(agents) == 1:
            lines.append(f'agent = "{next(iter(agents.values()))}"')
        else:
            lines.append(f"agents = {{ {', '.join(f'{agent} = {json.dumps(who)}' for agent, who in agents.items())} }}")
        for agent in agents:
            for argument, known in scenario.agent_arguments(agent).items():
                key = argument if len(agents) == 1 else f'"{agent}.{argument}"'
                lines.append(f'# arguments.{key} = "{known.distribution or known.default}"')
        for argument, known in scenario.scenario_arguments().items():
            lines.append(f'# scenario_arguments.{argument} = "{known.distribution or known.default}"')
    return "\n".join(lines) + "\n"


def _in_keys(text: str) -> str:
    """Return a text in which the keys of the file replace the options of the command line."""
    keys = {"TRIALS": "trials", "MAX_STEPS": "max_steps"}
    for option in hunt_options():
        flag = f"{option.name} = {json.dumps(not option.default)}"
        keys[option.about.flag] = flag if option.form == "flag" else option.name
    return re.sub(r"(?<![\w-])(?:--[a-z-]+|[A-Z_]+)", lambda found: keys.get(found[0], found[0]), text)


def _merged(defaults: Given, given: Given) -> Given:
    """Return an entry merged with the defaults; the entry's agent replaces all default agents."""
    found = dict(defaults)
    if "agent" in given or "agents" in given:
        found.pop("agent", None)
        found.pop("agents", None)
    for key, value in given.items():
        both = isinstance(value, dict) and isinstance(found.get(key), dict) and key != "agents"
        found[key] = {**found[key], **value} if both else value
    return found
