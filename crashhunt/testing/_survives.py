"""An assertion for test suites that an agent does not crash; a crash is printed as a call that can be pasted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from typing import TYPE_CHECKING, TypedDict

from crashhunt.analysis import shrink
from crashhunt.api import run
from crashhunt.base.errors import CrashhuntError, UsageError
from crashhunt.base.temporary import temporary_folder
from crashhunt.base.text import command_line, one_of, visible
from crashhunt.episode import WorkerSettings
from crashhunt.executors import PoolExecutor
from crashhunt.plans import Request, plan
from crashhunt.trial import Disturbance, Outcome, TrialSpec

if TYPE_CHECKING:
    from pathlib import Path

    from crashhunt.base.codec import JsonObject
    from crashhunt.crashes import Bundle
    from crashhunt.plans import Driver, Spec
    from crashhunt.trial import TrialResult, Value


class Example(TypedDict, total=False):
    """One trial, in the form in which a failure of `assert_survives` prints it.

    Args:
        seed: seed of the trial.
        arguments: arguments of the agents, by agent id.
        scenario_arguments: arguments of the scenario.
        only: ids of the other actors that take part; all actors take part if the key is missing.
        disturbances: disturbances of the trial, as in `crash.json`; no disturbances if the key is missing.
    """

    seed: int
    arguments: Mapping[str, Mapping[str, Value]]
    scenario_arguments: Mapping[str, Value]
    only: Sequence[str]
    disturbances: Sequence[JsonObject]


def assert_survives(
    agent: Driver,
    scenario: Path | str = "loop",
    *,
    trials: int = 20,
    max_steps: int = 500,
    seed: int = 0,
    arguments: Mapping[str, Spec] | None = None,
    scenario_arguments: Mapping[str, Spec] | None = None,
    example: Example | None = None,
    budget: int = 100,
    parallel: int = 0,
    directory: Path | str | None = None,
) -> None:
    """Run trials with an agent; if the agent crashes, fail and print the minimized crash.

    The same seed runs the same trials. The error message contains a call of this function with ``example``. Paste this
    call into a test to run only the trial that crashed.

    Args:
        agent: class or function in a module, or ``module:attribute``.
        scenario: name of an included scenario, or a path.
        trials: number of trials to run.
        max_steps: maximum number of steps of a trial.
        seed: seed of the hunt.
        arguments: arguments of the agent, as values or specifications; see `crashhunt.run`.
        scenario_arguments: arguments of the scenario, as values or specifications.
        example: the single trial to run. The arguments of the example replace those in ``arguments``.
        budget: maximum number of trials to minimize a crash; 0 to skip the minimization.
        parallel: number of trials at a time; 0 for one per core.
        directory: directory in which the hunt is kept, such as pytest's ``tmp_path``; None to delete the hunt.

    Raises:
        AssertionError: the agent crashes in a trial.
        UsageError: the example has an unknown key.
        CrashhuntError: no trial could be run.
    """
    __tracebackhide__ = True  # of pytest
    call = f"{_word(agent)}, {str(scenario)!r}, max_steps={max_steps}"
    if example is not None:
        request = Request(
            trials=1, max_steps=max_steps, agent=agent, scenario=scenario, arguments=arguments,
            scenario_arguments=scenario_arguments, seed=seed,
        )  # fmt: skip
        result = _run_one(_asking(request, example), example)
        if result.outcome not in (Outcome.SURVIVED, Outcome.FINISHED):
            raise AssertionError(_told(result, call, ""))
        return
    with ExitStack() as stack:
        place = directory or stack.enter_context(temporary_folder("survives"))
        report = run(
            place, parallel, trials, max_steps, deterministic=True, agent=agent, scenario=scenario,
            arguments=arguments, scenario_arguments=scenario_arguments, seed=seed,
        )  # fmt: skip
        if report.stopped_because == "interrupted":
            raise KeyboardInterrupt
        if report.stopped_because == "no_valid_trial":
            raise CrashhuntError(f"no trial could be set up: {report.reason}", fix="correct the scenario")
        if report.crashes:
            bundle = _smaller(report.crashes[0], budget, parallel)
            look = f"look at it: {command_line('crashhunt', 'show', place)} --crash {bundle.id}" if directory else ""
            raise AssertionError(_told(bundle.result, call, look))


def _smaller(bundle: Bundle, budget: int, parallel: int) -> Bundle:
    if budget < 1:
        return bundle
    try:  # the others drive: scripted actors cannot be written in a line
        return shrink(bundle, budget=budget, parallel=parallel, form="traffic").small or bundle
    except CrashhuntError:  # report the crash as it is
        return bundle


def _asking(request: Request, example: Example) -> Request:
    """Return the request with only the values of an example; an agent may not know all other options.

    Raises:
        UsageError: the example has an unknown key, or unknown arguments.
    """
    known = Example.__annotations__
    for key in example:
        if key not in known:
            raise UsageError(
                f"the example has the unknown key {key!r}", fix=one_of(key, known, give="the known keys are")
            )
    arguments: dict[str, Value] = {}
    for agent, given in example.get("arguments", {}).items():
        if not isinstance(given, Mapping):
            raise UsageError(
                f"example: the arguments of {agent!r} are {given!r}",
                fix="give the arguments of each agent by the agent's id: {'ego': {'speed': 20.0}}",
            )
        arguments |= {f"{agent}.{name}": value for name, value in given.items()}
    return replace(
        request,
        arguments={**(request.arguments or {}), **_one_each(arguments)},
        scenario_arguments={**(request.scenario_arguments or {}), **_one_each(example.get("scenario_arguments", {}))},
    )


def _one_each(values: Mapping[str, Value]) -> dict[str, Spec]:
    return {name: value for name, value in values.items() if not (isinstance(value, str) and "|" in value)}


def _run_one(request: Request, example: Example) -> TrialResult:
    scenario, settings = plan(request)
    only = example.get("only")
    spec = TrialSpec(
        number=0,
        seed=example.get("seed", 0),
        arguments=example.get("arguments", {}),
        scenario_arguments=example.get("scenario_arguments", {}),
        max_steps=request.max_steps,
        only=None if only is None else tuple(only),
        disturbances=tuple(map(Disturbance.from_json, example.get("disturbances", ()))),
    )
    with temporary_folder("survives") as scratch:
        worker = WorkerSettings(
            scenario=scenario, oracles=settings.oracles, crash_on=settings.crash_on, scratch=scratch,
            timeout_s=settings.run.timeout_s,
            step_timeout_s=settings.run.step_timeout_s,
        )  # fmt: skip
        executor = PoolExecutor(worker)
        try:
            executor.submit(spec)
            found: list[TrialResult] = []
            while not found:
                found = list(executor.completed(1.0))
        finally:
            executor.close()
    result = found[0]
    if result.outcome is Outcome.INVALID:
        raise CrashhuntError(f"the example could not be set up: {result.summary}", fix="correct the scenario")
    return replace(result, spec=spec)


def _told(result: TrialResult, call: str, look: str) -> str:
    spec = result.spec
    example: Example = {
        "seed": spec.seed,
        "arguments": {agent: dict(values) for agent, values in spec.arguments.items()},
        "scenario_arguments": dict(spec.scenario_arguments),
    }
    if spec.only is not None:
        example["only"] = list(spec.only)
    if spec.disturbances:
        example["disturbances"] = [one.to_json() for one in spec.disturbances]
    lines = [
        "",
        result.summary,
        "This call runs that trial alone:",
        f"    assert_survives({call}, example={example!r})",
    ]
    return visible("\n".join([*lines, look] if look else lines))


def _word(agent: Driver) -> str:
    return repr(agent) if isinstance(agent, str) else getattr(agent, "__qualname__", repr(agent))
