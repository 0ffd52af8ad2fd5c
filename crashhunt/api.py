"""The functions of the command line for Python that prepare and run a hunt."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base.calls import called_with
from crashhunt.base.plugins import refuse_while_importing
from crashhunt.plans import Request, hunt_options

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from crashhunt.hunts import Hunt, HuntReport, HuntStatus
    from crashhunt.plans import HuntSettings
    from crashhunt.scenario import Scenario
    from crashhunt.snapshots import SnapshotOptions


@dataclass(frozen=True)
class _Place:
    directory: Path | str


@dataclass(frozen=True)
class HuntCall(Request, _Place):
    """Arguments of `prepare`: the request, whose numbers are required and positional, and the directory of the hunt.

    Args:
        directory: directory of the hunt, created if it does not exist. An existing hunt with the same settings resumes.
        parallel: number of trials at a time; 0 for one per core.
        trials: maximum number of trials; 0 for no limit, which needs a ``duration``.
        max_steps: maximum number of steps of a trial.
        snapshot: options of the snapshot, instead of the ``snapshot_…`` arguments.
        overwrite: whether a new hunt replaces an existing one.
        command: the command line, which is written to ``hunt.toml`` as a comment.
    """

    parallel: int = field()
    trials: int = field()
    max_steps: int = field()
    _: KW_ONLY
    snapshot: SnapshotOptions | None = None
    overwrite: bool = False
    command: Sequence[str] | None = None


@dataclass(frozen=True)
class RunCall(HuntCall):
    """Arguments of `run`: all arguments of `prepare`, and a function that receives the progress.

    Args:
        directory: directory of the hunt, created if it does not exist. An existing hunt with the same settings resumes.
        parallel: number of trials at a time; 0 for one per core.
        trials: maximum number of trials; 0 for no limit, which needs a ``duration``.
        max_steps: maximum number of steps of a trial.
        watch: function called with the progress of the hunt about ten times a second.
        snapshot: options of the snapshot, instead of the ``snapshot_…`` arguments.
        overwrite: whether a new hunt replaces an existing one.
        command: the command line, which is written to ``hunt.toml`` as a comment.
    """

    _: KW_ONLY
    watch: Callable[[HuntStatus], None] | None = None


@called_with(HuntCall, documents=hunt_options())
def prepare(asked: HuntCall) -> Hunt:
    """Return a hunt that is ready to run.

    Raises:
        CrashhuntError: the input is invalid; the message gives the reason.
    """
    return _prepared(asked)


def _prepared(asked: HuntCall) -> Hunt:
    refuse_while_importing()
    # Refuse values out of range before large imports: the user waits at a terminal.
    request = asked.checked()
    from crashhunt.plans import plan_with_code

    def survey(scenario: Scenario, request: Request, settings: HuntSettings) -> Scenario:
        from crashhunt.hunts import TrafficSurveyor

        return TrafficSurveyor(Path(asked.directory), overwrite=asked.overwrite)(scenario, request, settings)

    found, settings, code = plan_with_code(request, survey=survey)
    from crashhunt.hunts import Hunt
    from crashhunt.snapshots import SnapshotOptions

    snapshot = asked.snapshot if asked.snapshot is not None else SnapshotOptions.of(asked)
    return Hunt(
        Path(asked.directory),
        found,
        settings,
        command=list(asked.command) if asked.command is not None else None,
        overwrite=asked.overwrite,
        seed_given=asked.seed is not None,
        snapshot=snapshot,
        imported=code.imported,
    )


@called_with(RunCall, documents=hunt_options())
def run(asked: RunCall) -> HuntReport:
    """Hunt for a crash, as ``crashhunt run`` does, and return the result.

    Raises:
        CrashhuntError: the input is invalid; the message gives the reason.
    """
    return _prepared(asked).run(asked.watch)
