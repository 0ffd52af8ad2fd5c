"""Hunts that run at the same time, each in its own process, so that a failure of one does not affect the others."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
import traceback
from collections import deque
from contextlib import closing, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.errors import BusyError, CrashhuntError, UsageError
from crashhunt.base.files import exchange, put_in_place
from crashhunt.base.processes import die_with
from crashhunt.base.signals import stop_requests
from crashhunt.base.temporary import temporary_beside
from crashhunt.ledger import Ledger
from crashhunt.plans import (
    Request,
    RunSettings,
    executor_of,
    plan_with_code,
    read_settings,
    with_settings,
)
from crashhunt.results import HuntDirectory
from crashhunt.snapshots import SnapshotOptions, latest_snapshot
from crashhunt.suites._request_file import REQUEST, RunRequest, write_request

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from crashhunt.base.plugins import ImportedModules
    from crashhunt.plans import Given, HuntSettings
    from crashhunt.scenario import Scenario


_LOOK_EVERY_S = 0.1  # at processes that may have ended
_WATCH_EVERY_S = 1.0  # the table of `suite run --watch`
_BUSY_S = 15.0  # for the process of an earlier run to leave the directory
_NEW_CODE = "continue_with_new_code"  # the option of a run that is none of `RunSettings`


def slots_of(parallel: int) -> int:
    """Return the number of trials that run at a time; 0 means one per core.

    Raises:
        UsageError: ``parallel`` is negative.
    """
    if parallel < 0:
        raise UsageError(f"PARALLEL is {parallel}", fix="give at least 0 (0: one per core)")
    return parallel or len(os.sched_getaffinity(0))


def check_machine(parallel: int, machine: Given | None) -> None:
    """Refuse invalid execution options before any hunt starts.

    Raises:
        UsageError: ``parallel`` is negative, or an option does not exist.
        PluginError: the executor does not exist.
    """
    slots_of(parallel)
    run = {name: value for name, value in (machine or {}).items() if name != _NEW_CODE}
    executor_of(RunSettings(**run).checked().executor)


def run_all(
    folders: Sequence[Path],
    parallel: int = 0,
    *,
    watch: Callable[[], None] | None = None,
    machine: Given | None = None,
    is_enough: Callable[[], bool] = lambda: False,
    environments: Mapping[Path, Mapping[str, str]] | None = None,
    partners: Mapping[Path, Path] | None = None,
) -> None:
    """Run hunts, each in its own process, until all have ended, no more are needed, or the user interrupts.

    Args:
        folders: folders of the runs; each contains a ``request.json``.
        parallel: number of trials at a time, of all hunts together; 0 for one per core.
        watch: function called about once a second, and at the end.
        machine: execution options for all hunts, which replace the options of each request.
        is_enough: function called after each `watch`; if it returns true, the hunts stop as after an interrupt.
        environments: environment variables of the process of each folder; by default the variables of this process.
        partners: the folder of the hunt with which each hunt is compared. The hunt that is ahead waits for its partner.

    Raises:
        UsageError: ``parallel`` is negative.
        KeyboardInterrupt: the user interrupted the run; finished trials are kept, and all hunts have stopped.
    """
    slots = slots_of(parallel)
    waiting = deque(folders)
    running: dict[subprocess.Popen[bytes], int] = {}
    watched = 0.0
    passed_on = enough = False
    with stop_requests() as asked:
        try:
            while waiting or running:
                for process in [process for process in running if process.poll() is not None]:
                    del running[process]
                free = slots - sum(running.values())
                while waiting and free > 0 and not (asked or enough):
                    # Towards the end there are fewer hunts than slots: then each gets several.
                    width = max(1, free // len(waiting))
                    folder = waiting.popleft()
                    try:
                        run = {**(machine or {}), "parallel": width}
                        if partners is not None and folder in partners:
                            run["partner"] = str(partners[folder].resolve())
                        running[_start(folder, run, (environments or {}).get(folder))] = width
                        free -= width
                    except (CrashhuntError, OSError) as error:
                        _fail(folder, str(error), "")
                if (asked or enough) and not passed_on:
                    passed_on = True
                    waiting.clear()
                    for process in running:
                        process.send_signal(asked[0] if asked else signal.SIGINT)
                if watch is not None and time.monotonic() - watched > _WATCH_EVERY_S:
                    watched = time.monotonic()
                    watch()
                    enough = enough or is_enough()
                time.sleep(_LOOK_EVERY_S)
        finally:
            for process in running:
                process.kill()
                process.wait()
        if watch is not None:
            watch()
    if asked:
        raise KeyboardInterrupt


def set_aside(folder: Path, planned: Callable[[Path], RunRequest]) -> Path:
    """Move the results of a run to a folder next to it, so that the run can start again; return the new folder.

    If the process is killed during the move, the folder is either unchanged or contains the new request. ``planned``
    returns the new request of the run from the new path of the folder's contents.

    Raises:
        OSError: a folder cannot be created or renamed.
    """
    number = 0
    while (aside := folder.with_name(f"{folder.name}{layout.REPLACED}{number}")).exists():
        if _is_same_plan(aside, request := planned(aside)):
            break
        number += 1
    else:
        request = planned(aside)
    with temporary_beside(folder) as building:
        building.mkdir()
        write_request(building, request)
        put_in_place(building, aside)
    if not exchange(folder, aside):
        with temporary_beside(folder) as building:
            aside.rename(building)
            folder.rename(aside)
            building.rename(folder)
    return aside


def _is_same_plan(aside: Path, request: RunRequest) -> bool:
    """Return whether a folder contains only the request that an earlier, killed call wrote."""
    if not aside.is_dir() or [path.name for path in aside.iterdir()] != [REQUEST]:
        return False
    return RunRequest.read(aside / REQUEST).to_plain() == request.to_plain()


def _start(folder: Path, run: Given, environment: Mapping[str, str] | None) -> subprocess.Popen[bytes]:
    request = RunRequest.read(folder / REQUEST)
    with (folder / layout.RUN_LOG).open("ab") as log:
        return subprocess.Popen(
            [
                sys.executable,
                "-P",
                "-m",
                "crashhunt.suites._processes",
                str(folder.resolve()),
                json.dumps(run),
                str(os.getpid()),
            ],
            cwd=request.folder if Path(request.folder).is_dir() else None,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            start_new_session=True,  # Ctrl-C is passed on by us, once
        )


def _main(folder: Path, run: Given, parent: int) -> None:
    die_with(parent, signal.SIGTERM)  # a suite that is killed takes its hunts along, and they keep what has finished
    from crashhunt.hunts import Hunt
    from crashhunt.report import describe_hunt

    try:
        asked = RunRequest.read(folder / REQUEST)
        options = dict(run)
        partner = Path(other) if (other := options.pop("partner", None)) is not None else None
        new_code = options.pop(_NEW_CODE, asked.request.continue_with_new_code)
        scenario, settings, imported = _planned(folder, asked.request, options)
        snapshot = SnapshotOptions.of(replace(asked.request, continue_with_new_code=new_code))
        command = ["crashhunt", "suite", "run"]
        hunt = Hunt(folder, scenario, settings, command=command, snapshot=snapshot, imported=imported, partner=partner)
        deadline = time.monotonic() + _BUSY_S
        while True:
            try:
                report = hunt.run()
                break
            except BusyError as error:
                if time.monotonic() > deadline:
                    print(f"crashhunt: {error}", file=sys.stderr)  # the process that runs there records its result
                    return
                time.sleep(0.5)
        print(describe_hunt(report), flush=True)
    except CrashhuntError as error:
        _fail(folder, str(error), "")
    except Exception as error:
        _fail(folder, f"{type(error).__name__}: {error}", traceback.format_exc())


def _planned(folder: Path, request: Request, machine: Given) -> tuple[Scenario, HuntSettings, ImportedModules | None]:
    """Return scenario and settings of an existing or new hunt; ``trials`` in the options replaces its trials.

    The last returned value is the modules that trials import; None if they are unknown.
    """
    run = dict(machine)
    trials = run.pop("trials", None)
    begun, snapshot = (folder / layout.HUNT).exists(), latest_snapshot(folder)
    if not begun or snapshot is None:
        from crashhunt.hunts import TrafficSurveyor

        survey = TrafficSurveyor(folder, overwrite=False)
        scenario, settings, code = plan_with_code(replace(request, **run), survey=survey)
        if not begun:
            return scenario, settings, code.imported
    else:
        scenario = snapshot.scenario
    settings = read_settings(folder / layout.HUNT)
    if trials is not None:
        settings = replace(settings, trials=trials)
    return with_settings(scenario, settings), replace(settings, run=replace(settings.run, **run)), None


def _fail(folder: Path, message: str, trace: str) -> None:
    """Write the reason why a hunt could not run to its folder.

    A hunt that had begun before stays resumable, because `rerun` starts over what ended in an error.
    """
    with suppress(CrashhuntError, OSError), HuntDirectory(folder).locked():  # where another runs, that one has the word
        (folder / layout.ERROR_LOG).write_text(f"{message}\n{trace}", encoding="utf-8", errors="replace")
        with closing(Ledger(folder / layout.LEDGER, writable=True)) as ledger:
            before = ledger.facts().get("state")
            if before == "error":
                return
            ledger.enter("error", message)  # also for the gate, which reports the last event
            if before not in (None, "queued", "no_valid_trial"):
                # A resumed hunt looks for audits that were not noted if its last process was killed.
                ledger.note(state="running" if before == "running" else "interrupted")


if __name__ == "__main__":
    _main(Path(sys.argv[1]), json.loads(sys.argv[2]), int(sys.argv[3]))
