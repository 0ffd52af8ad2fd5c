"""What the command line does, as functions: ``import crashhunt``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from crashhunt.base.calls import clear_calls
from crashhunt.base.errors import UsageError
from crashhunt.crashes import Bundle, find_bundle
from crashhunt.estimation import compare
from crashhunt.hunts import Hunt, load
from crashhunt.plans import Request, RunSettings, plan
from crashhunt.replays import ReplayOptions, ReplayReport, replay as _replay
from crashhunt.suites import Suite
from crashhunt.trial import CRASHES

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from crashhunt.hunts import HuntReport, HuntStatus
    from crashhunt.replays import Code
    from crashhunt.snapshots import SnapshotOptions

__all__ = ["Hunt", "Suite", "compare", "load", "prepare", "replay", "run"]

Spec = str | int | float | bool


@clear_calls()
def prepare(
    directory: Path | str,
    parallel: int,
    trials: int,
    max_steps: int,
    *,
    scenario: Path | str = "loop",
    ego: str = "",
    action: str = "",
    agent: str | type | Callable[..., Any] | None = None,
    agents: Mapping[str, str | type | Callable[..., Any]] | None = None,
    arguments: Mapping[str, Spec] | None = None,
    scenario_arguments: Mapping[str, Spec] | None = None,
    sampler: str = "random",
    points: int = 10,
    seed: int | None = None,
    crash_on: Sequence[str] = CRASHES,
    keep_going: bool = False,
    deterministic: bool = False,
    keep_trials: bool = False,
    accelerate: bool = True,
    timeout_s: float = 60.0,
    recycle_after: int = 1000,
    audit: float = 0.0,
    snapshot: SnapshotOptions | None = None,
    overwrite: bool = False,
    command: Sequence[str] | None = None,
) -> Hunt:
    """Return a hunt that is ready to run.

    Args:
        directory: where everything is kept; made where it does not exist. The same hunt there goes on.
        parallel: trials at a time; 0 for one per core.
        trials: how many at most.
        max_steps: the bound on each, in steps.
        scenario: a shipped name, or a path.
        ego: which vehicle of a bare ``.sumocfg``.
        action: how agents act on SUMO, ``continuous`` or ``meta``; by default as the scenario says.
        agent: who drives, where there is one controlled vehicle: ``module:attribute``, or a class or function of a
            module that workers can import.
        agents: vehicle to who drives it, where there are several.
        arguments: ``NAME`` or ``AGENT.NAME`` to a value or a specification such as ``"5:40"``.
        scenario_arguments: name to value or specification.
        sampler: its name.
        points: values that grid and sweep try of a range without a step.
        seed: of the hunt; drawn where it is None.
        crash_on: the outcomes that count.
        keep_going: collect all crashes instead of stopping at the first.
        deterministic: the same seed gives the same crash, whatever the timing.
        keep_trials: keep the logs of every trial.
        accelerate: speed simulators up where that changes no bit.
        timeout_s: wall-clock limit of a trial, in s.
        recycle_after: trials after which a worker is replaced; 0 for never.
        audit: the share of trials without a crash that are run again in a fresh process, to see that they are the same.
        snapshot: what the snapshot of the code takes in.
        overwrite: begin anew, whatever hunt is there.
        command: the command line, as a comment in ``hunt.toml``.

    Raises:
        CrashhuntError: with what is wrong.
    """
    drivers = dict(agents or {})
    if agent is not None:
        drivers[""] = agent
    request = Request(
        trials=trials,
        max_steps=max_steps,
        scenario=scenario,
        ego=ego,
        action=action,
        agents={name: _locator(who) for name, who in drivers.items()},
        arguments={name: _spec(value) for name, value in (arguments or {}).items()},
        scenario_arguments={name: _spec(value) for name, value in (scenario_arguments or {}).items()},
        sampler=sampler,
        points=points,
        seed=seed,
        crash_on=[str(outcome) for outcome in crash_on],
        run=RunSettings(
            parallel=parallel,
            keep_going=keep_going,
            deterministic=deterministic,
            keep_trials=keep_trials,
            accelerate=accelerate,
            timeout_s=timeout_s,
            recycle_after=recycle_after,
            audit=audit,
        ),
    )
    found, settings = plan(request)
    return Hunt(
        Path(directory),
        found,
        settings,
        command=list(command) if command is not None else None,
        overwrite=overwrite,
        seed_given=seed is not None,
        snapshot=snapshot,
    )


@clear_calls(options_of=prepare)
def run(
    directory: Path | str,
    parallel: int,
    trials: int,
    max_steps: int,
    *,
    watch: Callable[[HuntStatus], None] | None = None,
    **options: Any,
) -> HuntReport:
    """Hunt for a crash, as ``crashhunt run`` does.

    Args:
        directory: where everything is kept; made where it does not exist. The same hunt there goes on.
        parallel: trials at a time; 0 for one per core.
        trials: how many at most.
        max_steps: the bound on each, in steps.
        watch: called about ten times a second.
        options: those of `prepare`, such as ``scenario``, ``agent``, ``arguments``, ``seed`` and ``keep_going``.

    Returns:
        What came of it.

    Raises:
        CrashhuntError: with what is wrong.
    """
    return prepare(directory, parallel, trials, max_steps, **options).run(watch)


@clear_calls()
def replay(
    crash: Bundle | Path | str,
    crash_id: str = "",
    *,
    code: Code = "snapshot",
    changes: Mapping[str, Spec] | None = None,
    times: int = 1,
    force: bool = False,
    scenario: str | Path = "",
    accelerate: bool = True,
) -> ReplayReport:
    """Run a saved crash again in a fresh process, as ``crashhunt replay`` does.

    Args:
        crash: the directory of a hunt or of one crash, or a crash of what `load` has returned.
        crash_id: which of a hunt; the one with the fewest steps by default.
        code: who drives: the code of the ``snapshot``, the ``current`` code, or the actions of the ``log``.
        changes: ``NAME`` or ``AGENT.NAME`` of an argument to another value.
        times: how often.
        force: replay even from a snapshot that is damaged.
        scenario: the name or path of another scenario in which the same agents drive, on another simulator too.
        accelerate: speed simulators up where that changes no bit.

    Returns:
        The verdict, and everything behind it.

    Raises:
        CrashhuntError: it cannot be run.
    """
    bundle = crash if isinstance(crash, Bundle) else find_bundle(Path(crash), crash_id)
    edits = {name: _spec(value) for name, value in (changes or {}).items()}
    options = ReplayOptions(
        code=code, changes=edits, times=times, force=force, scenario=str(scenario), accelerate=accelerate
    )
    return _replay(bundle, options)


def _locator(who: str | type | Callable[..., Any]) -> str:
    if isinstance(who, str):
        return who
    module, name = getattr(who, "__module__", ""), getattr(who, "__qualname__", "")
    if module in ("", "__main__") or not name or "<" in name:
        raise UsageError(
            f"{name or who!r} is in no module that a worker could import",
            fix="put it into a file of its own, and give it from there or as 'module:attribute'",
        )
    return f"{module}:{name}"


def _spec(value: Spec) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)
