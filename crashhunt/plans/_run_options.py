"""The list of all hunt options, the single source for every interface.

The command line, `crashhunt.prepare` and ``run``, ``suite.toml``, ``request.json`` and ``hunt.toml`` are derived from
this list. To add an option to all of them, add a field to one of the base classes of `HuntOptions`:

- `Subject`: `plan` resolves the option into ``hunt.toml``, and has to be changed for a new option;
- `TrialOptions`: the option determines trials and is a key of ``hunt.toml``, and another value makes another hunt;
- `RunOptions`: the option only determines how trials are run and is a key of ``[run]``, which a resumed hunt may
  change;
- `SnapshotChoices`: the option is passed to `SnapshotOptions` of the ``snapshots`` package, and is not stored.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cache
from pathlib import Path
from typing import Self

from crashhunt.base.errors import UsageError
from crashhunt.plans._declaration import HuntOption, above_zero, at_least, declared, declared_options, option, within
from crashhunt.plans._durations_and_rates import check_duration, check_probe, check_rate, check_share
from crashhunt.trial import CRASHES

Spec = str | int | float | bool
Driver = str | Callable[..., object]  # a class is one, too

_SPEC = "a value (20), a range (5:40, 5:40:5), a log range (log:1e-3:1) or a choice (a|b|c)"
_SIGNAL = "; or a signal over the time of a trial (signal:0:1:points=5:kind=constant|linear|pchip)"


@dataclass(frozen=True, kw_only=True)
class _Options:
    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if isinstance(value, list):  # what was read from a file is the same as what was given in Python
                object.__setattr__(self, item.name, tuple(value))

    def checked(self) -> Self:
        """Return the same options after validation, with plain Python values.

        Raises:
            UsageError: an option is invalid.
        """
        options = hunt_options(type(self))
        return replace(self, **{known.name: known.checked(getattr(self, known.name)) for known in options})


@dataclass(frozen=True, kw_only=True)
class Subject(_Options):
    """The scenario, agents and arguments of a hunt."""

    scenario: Path | str = option(
        "loop", "name of an included scenario, or a path",
        help="an included one (see crashhunt list scenarios), a folder, a scenario.toml, a .sumocfg or a map (.osm, "
        ".xodr)",
        brief="an included scenario, a folder, a scenario.toml, a .sumocfg or a map (.osm, .xodr)",
        flag="--scenario", metavar="NAME|PATH", group="what",
    )  # fmt: skip
    ego: str = option(
        "", "if the scenario is a ``.sumocfg``, the vehicle that the agent controls",
        help="for a .sumocfg: the id of the vehicle that the agent controls; route=ID or edges=FROM,TO adds a vehicle; "
        "any: a random vehicle in each trial",
        unset="any",
        flag="--ego", metavar="VEHICLE", group="what",
    )  # fmt: skip
    action: str = option(
        "", "form of the actions on SUMO, a name that ``crashhunt list actions`` shows",
        help="the form of the agent's actions on SUMO: speed_and_lane, meta, acceleration or another name that "
        "crashhunt list actions shows",
        unset="as the scenario file or the agent's class says, or else speed_and_lane",
        flag="--action", metavar="FORM", group="what",
    )  # fmt: skip
    observe: Sequence[str] = option(
        (), "parts that the agents observe, such as ``ego`` or ``actors:rows=8``; ``kinematics`` alone is the default "
        "observation",
        help="the parts that the agents observe, such as ego,actors:rows=8; crashhunt list observations shows parts "
        "and their settings; kinematics: the default observation",
        unset="as the scenario or the agent's class says, or else kinematics",
        flag="--observe", metavar="PART,…", group="what", separator=",",
    )  # fmt: skip
    agents: Mapping[str, Driver] | None = option(
        {}, "identifier of each controlled vehicle to its agent, if there are several",
        help="the agent that drives: a class or function, or a name that crashhunt list agents shows; if the scenario "
        "has several controlled vehicles, ID= names the vehicle that this agent drives",
        brief="the agent that drives: a class, a function, or a name that crashhunt list agents shows",
        flag="--agent", metavar="[ID=]MODULE:ATTR", group="what", named=False,
    )  # fmt: skip
    arguments: Mapping[str, Spec] | None = option(
        {}, '``NAME`` or ``AGENT.NAME`` to a value or a specification such as ``"5:40"``',
        help=f"values to try for an argument of the agent: {_SPEC}{_SIGNAL}; if there are several "
        "agents, ID.NAME=SPEC names the agent",
        brief="values of an agent's argument: one (20), a range (5:40 or log:1e-3:1) or a choice (a|b|c)",
        flag="--arg", metavar="NAME=SPEC", group="what",
    )  # fmt: skip
    scenario_arguments: Mapping[str, Spec] | None = option(
        {}, 'name of an argument of the scenario to a value, or to a specification such as ``"0.5:1.5"``',
        help="values to try for an argument of the scenario, such as its traffic demand",
        brief="values of an argument of the scenario, such as its traffic, written as for --arg",
        flag="--set", metavar="NAME=SPEC", group="what",
    )  # fmt: skip
    oracles: Sequence[str] = option(
        (), "additional oracles; by default, oracles detect collisions that the simulator reports, overlaps, and "
        "leaving the road",
        help="an additional oracle that detects crashes, with its arguments; crashhunt list oracles shows all oracles; "
        "none switches off the default oracles; the option may be given several times",
        flag="--oracle", metavar="NAME[:KEY=VALUE,…]", group="what",
    )  # fmt: skip
    requirements: Sequence[str] = option(
        (), "requirements as ``NAME=FORMULA``, in temporal logic; a violation is a crash with the outcome "
        "``requirement``",
        help="what must hold, in temporal logic, such as headway='always (headway_s >= 1)'; a violation is a crash "
        "with the outcome requirement; crashhunt signals SCENARIO lists the signals; the option may be given several "
        "times",
        unset="those of the scenario, if it has any",
        flag="--require", metavar="[NAME=]FORMULA", group="what",
    )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class TrialOptions(_Options):
    """The options that determine trials; `HuntSettings` contains them as well."""

    sampler: str = option(
        "random", "name of the sampler",
        help="the sampler that chooses the arguments of trials: random, halton, sobol, grid or sweep; or a sampler "
        "that learns from results: guided, cross-entropy, mutation, cma-es or optuna:NAME, such as optuna:tpe",
        brief="how the arguments of trials are chosen: random, grid, guided or others",
        flag="--sampler", group="search", metavar="NAME",
    )  # fmt: skip
    points: int = option(
        10, "number of values that the samplers grid and sweep try in a range "
        "without a step", flag="--points", group="search",
        metavar="N",
        check=at_least(1),
    )  # fmt: skip
    seed: int | None = option(
        None, "seed of the hunt", unset="a new one, which is printed",
        brief="seed of the hunt; the same seed runs the same trials again",
        flag="--seed", group="search", metavar="N", check=at_least(0),
    )  # fmt: skip
    crash_on: Sequence[str] = option(
        CRASHES, "outcomes that count as a crash",
        help="the outcomes that count as a crash. By default: collision, off_road, agent_error, simulator_error, "
        "process_died, hang. Traffic events may also count: red_light, wrong_way, off_route, stop_missed, not_moving "
        "(no motion for 60 s, or for S seconds with not_moving:S), others_collided, hard_braking (or "
        "hard_braking:M/S² for another limit), teleport, stop_sign, kerb",
        flag="--crash-on", group="what", metavar="KIND,…", separator=",",
    )  # fmt: skip
    disturb: Sequence[str] = option(
        (), "faults of the vehicles around the agent, or of its sensors and actuators: ``NAME=RATE`` with a rate per"
            " second, or ``KIND@STEP=PLACE:STRENGTH:DURATION`` in every trial",
        help="inject faults of other vehicles or of the agent's sensors and actuators, each with its rate per second, "
        "such as brake=0.02,cut_in=0.01. The faults: brake, stop, dawdle, speed, cut_in, late_merge, step_out, "
        "ignore_priority, unseen, late_observation, noisy_observation, late_action or module:attribute. A fault at a "
        "given step of every trial: brake@124=ahead:4:2 (the vehicle ahead, 4 m/s², 2 s). none: no faults",
        unset="those of the scenario, if it has any",
        brief="faults to inject, with their rates per second, such as brake=0.02",
        flag="--disturb", group="faults", metavar="NAME=RATE,…", separator=",",
    )  # fmt: skip
    probe: str = option(
        "", "interval of simulation time, such as ``4s``, at which forks of a trial search for the mildest "
        "disturbance that makes the trial crash",
        help="at this interval of simulation time, such as 4s, try disturbances in forks of the running trial, and "
        "find the mildest disturbance with which the trial crashes",
        unset="never", flag="--probe", group="faults", metavar="TIME",
        check=check_probe,
    )  # fmt: skip
    branch: bool = option(
        False, "whether copies of a trial continue with other disturbances when another actor is near",
        help="when another actor is near, fork the running trial at this moment and some seconds earlier, and "
        "continue each fork with other disturbances; needs --disturb",
        flag="--branch", group="faults",
    )  # fmt: skip
    rare: bool = option(
        False, "whether to estimate the rate of rare crashes, from forks of trials in which a disturbance is forced",
        help="estimate the rate of rare crashes: one of five trials runs undisturbed and is forked; each fork is "
        "forced to begin with one disturbance, and its result is weighted by the probability of this disturbance; "
        "needs --disturb with rates and implies --keep-going",
        flag="--rare", group="faults",
    )  # fmt: skip
    seeds: int = option(
        0, "number of traffics, each used for many arguments of the agents; 0: a new traffic in each trial",
        help="use only N traffics (a traffic is a seed and the scenario's arguments): simulate the warm-up of a "
        "traffic once, then run trials with different arguments of the agents in it; 0: a new traffic in each trial",
        unset="every trial has its own",
        flag="--seeds", group="search", metavar="N", check=at_least(0, zero="every trial has its own"),
    )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class RunOptions(_Options):
    """The options that determine how trials run; `RunSettings` contains them as well."""

    duration: str = option(
        "", "time limit of the hunt: ``90s``, ``30m``, ``1h30m``; TRIALS may then be 0",
        help="start no trial after this time, such as 90s, 30m or 1h30m; TRIALS may then be 0 (no limit)",
        unset="no time limit", brief="start no trial after this time, such as 30m",
        flag="--for", group="search", metavar="TIME", check=check_duration,
    )  # fmt: skip
    keep_going: bool = option(
        False, "collect all crashes instead of stopping at the first",
        brief="collect all crashes instead of stopping at the first",
        flag="--keep-going", group="search",
    )  # fmt: skip
    distinct: int = option(
        0, "number of crash types after which the hunt ends; it collects all crashes until then; 0: no limit",
        help="collect all crashes, and stop when N different crash types (see crashhunt crashes) have been found; 0: "
        "no such limit",
        flag="--distinct", group="search", metavar="N", check=at_least(0, zero="never"),
    )  # fmt: skip
    until_rate: str = option(
        "", "a rate, such as ``1e-3/trial``, ``2/hour`` or ``5/1000km``: the hunt ends when the crash rate is "
            "certainly below or above it",
        help="stop when the crash rate is certainly below or above this rate, such as 1e-3/trial, 2/hour or 5/1000km; "
            "the hunt collects all crashes, and TRIALS may be 0; exit code 0: the crash rate is below, 1: above, 3: "
            "undecided",
        unset="run all trials", flag="--until-rate", group="search", metavar="RATE", check=check_rate,
    )  # fmt: skip
    most: int = option(
        0, "with ``until_rate``, maximum number of trials; 0: as many as TRIALS",
        help="with --until-rate: maximum number of trials; 0: as many as TRIALS",
        flag="--most", group="search", metavar="N", check=at_least(0, zero="as many as TRIALS says"),
    )  # fmt: skip
    keep: int = option(
        0, "number of bundles to keep of each crash type, the shortest crashes first; 0: all",
        help="keep only the bundles of the N shortest crashes of each type; the ledger keeps all crashes. Requires "
        "--keep-going, --distinct or --rare; 0: keep all",
        brief="keep only the N shortest crashes of each type",
        flag="--keep", group="kept", metavar="N", check=at_least(0, zero="keep all"),
    )  # fmt: skip
    by_cause: int = option(
        0, "with ``distinct`` or ``keep``: find the causes of up to this number of crashes of each type; the options "
        "then apply to causes instead of types; 0: none",
        help="find the causes of up to N crashes of each type, by running them again; --distinct then counts causes "
        "instead of crash types, and --keep applies to each cause of a type; 0: do not search for causes",
        flag="--by-cause", group="search", metavar="N", check=at_least(0, zero="count types"),
    )  # fmt: skip
    only_at_fault: bool = option(
        False, "stop only at a crash that is the agent's fault; other crashes are saved, and the hunt continues",
        help="stop only at a crash that is the agent's fault according to the fault rules; other crashes are saved and "
        "do not end the hunt",
        flag="--only-at-fault", group="search",
    )  # fmt: skip
    until_error: str = option(
        "", "with ``rare``, largest ratio of half the interval's width to the estimate, such as ``0.3``: the hunt "
            "ends when it is reached",
        help="with --rare: stop when half the width of the confidence interval is at most this share of the estimated "
        "crash rate, such as 0.3",
        unset="all trials", flag="--until-error", group="faults", metavar="SHARE", check=check_share,
    )  # fmt: skip
    deterministic: bool = option(
        False, "after a crash, wait for the running trials with lower numbers, so that the same seed always finds the "
        "same crash",
        flag="--deterministic", group="run",
    )  # fmt: skip
    timeout_s: float = option(
        60.0, "wall-clock limit of a trial, in s", flag="--timeout", group="run", metavar="S",
        check=above_zero("give seconds above 0"),
    )  # fmt: skip
    step_timeout_s: float = option(
        0.0, "wall-clock limit of a step of an agent that is a program, a library or an FMU, in s; 0: no limit",
        help="time limit for each action of an agent that is a program, a library or an FMU, in s; a later action is "
        "an error of the agent, which names the step. A call of a library or FMU that never returns is a hang. "
        "0: no limit",
        flag="--step-timeout", group="run", metavar="S", check=within(0, 1e6, "give seconds (0: no limit)"),
    )  # fmt: skip
    reuse: bool = option(
        False, "whether the program of an agent (``exec:``) drives in one trial after another; replays start a new one",
        help="let the program of an agent (exec:) drive in one trial after another, for programs that start slowly. "
        "Replays start a new program, and an audit (--audit, 0.05 by default) compares trials with a new program",
        flag="--reuse", group="run",
    )  # fmt: skip
    keep_trials: bool = option(
        False, "keep the log of every trial, not only of crashes", flag="--keep-trials", group="kept",
    )  # fmt: skip
    accelerate: bool = option(
        True, "whether to run simulators with their accelerator; results are bit-identical",
        help="run highway-env without the accelerator; trials stay bit-identical and take longer",
        flag="--no-accelerate", group="run",
    )  # fmt: skip
    native: bool = option(
        True, "whether to use the compiled core of simulators, if it is installed; results are bit-identical",
        help="run SUMO without the compiled core; trials stay bit-identical and take longer",
        flag="--no-native", group="run",
    )  # fmt: skip
    warm_copies: int = option(
        8, "with ``seeds``, the number of traffics for which each worker keeps a suspended process with the "
        "simulation after its warm-up; 0: none",
        help="with --seeds: number of traffics whose warmed-up simulation each worker keeps in memory as a suspended "
        "process; 0: none",
        flag="--warm-copies", group="run", metavar="N", check=at_least(0, zero="none"),
    )  # fmt: skip
    audit: float = option(
        0.0, "share of the trials without a crash that run again in a new process, to check that they are bit-"
             "identical",
        help="replay this share of the trials without a crash, each in a new process, and report every difference; "
        "with 0.02, one of fifty trials",
        flag="--audit", group="run", metavar="SHARE", check=within(0, 1, "give a share of the trials, from 0 to 1"),
    )  # fmt: skip
    near_misses: int = option(
        0, "number of trials without a crash to save as bundles, those with the highest criticality first",
        help="save the N most critical trials without a crash as bundles, for replay and show; these trials run once "
        "more at the end of the hunt",
        flag="--near-misses", group="kept", metavar="N", check=at_least(0, zero="none"),
    )  # fmt: skip
    executor: str = option(
        "pool", "executor that runs the trials, by its name; ``:ARG`` appends an argument",
        help="where trials run: pool (worker processes on this machine), fresh (a new process for each "
        "trial), ray[:HOST:PORT] (all machines of a Ray cluster) or module:attribute; append :ARG to pass an argument "
        "to the executor",
        flag="--executor", group="run", metavar="NAME[:ARG]", anywhere=True,
    )  # fmt: skip

    def checked(self) -> Self:
        """Return the same options after validation. With `distinct`, the hunt continues after the first crash.

        Raises:
            UsageError: an option is invalid.
        """
        found = super().checked()
        if found.most and not found.until_rate:
            raise UsageError(
                f"--most {found.most} needs --until-rate", fix="add --until-rate, or give TRIALS instead of --most"
            )
        if found.until_rate and (found.distinct or found.only_at_fault):
            other = "--distinct" if found.distinct else "--only-at-fault"
            message = f"--until-rate and {other} contradict each other: both decide when the hunt ends"
            raise UsageError(message, fix=f"omit {other}")
        if found.keep and not (found.keep_going or found.distinct or found.only_at_fault or found.until_rate):
            message = f"--keep {found.keep} requires a hunt that continues after a crash"
            raise UsageError(message, fix="give --keep-going or --distinct as well")
        if found.by_cause and not (found.distinct or found.keep):
            message = f"--by-cause {found.by_cause} has no effect without --distinct or --keep"
            raise UsageError(message, fix="add one of them")
        if found.by_cause and found.distinct and found.deterministic:
            message = "--deterministic and --by-cause contradict each other with --distinct"
            raise UsageError(
                f"{message}: which crashes are analysed would depend on which trials end first",
                fix="omit --deterministic or --by-cause",
            )
        return replace(found, keep_going=True) if found.distinct or found.until_rate else found


@dataclass(frozen=True, kw_only=True)
class SnapshotChoices(_Options):
    """The options of the snapshot of the code."""

    snapshot_roots: Sequence[str | Path] = option(
        (), "files and folders to add to the snapshot, in addition to the agents' projects",
        help="a file or folder that the snapshot contains in addition to the agent's project; the option "
        "may be given several times",
        flag="--snapshot-root", group="kept", metavar="PATH",
    )  # fmt: skip
    snapshot_limit_mb: float = option(
        500.0, "maximum size of a snapshot, in MB", help="the greatest size of a snapshot, in MB",
        flag="--snapshot-limit", group="kept", metavar="MB",
        check=above_zero("give MB above 0, or --no-snapshot", finite=False),
    )  # fmt: skip
    snapshot_code: bool = option(
        True, "whether the snapshot contains code; without it, a replay runs the current code",
        help="do not save the code; a replay then runs today's code", flag="--no-snapshot", group="kept",
    )  # fmt: skip
    continue_with_new_code: bool = option(
        False, "whether a hunt resumes although the code has changed since its trials; the versions of the code are "
        "kept apart, and the crash rate counts only the trials of the newest version",
        help="resume the hunt although the agent, the environment, the scenario or a library has changed since its "
        "trials; the versions are kept apart, and the crash rate counts only the trials of the newest version",
        unset="refuse to resume with other code", flag="--continue-with-new-code", group="run", anywhere=True,
    )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class HuntOptions(SnapshotChoices, RunOptions, TrialOptions, Subject):
    """All options, in the order of the help; they are arguments of `crashhunt.prepare` and keys of a suite's hunt."""

    agent: Driver | None = option(None, "agent that drives, if the scenario has one controlled vehicle")


def hunt_options(kind: type = HuntOptions) -> tuple[HuntOption, ...]:
    """Return all options of hunts, or the options that the given dataclass contains."""
    names = declared(kind)
    return tuple(known for known in _all_options() if known.name in names)


@cache
def _all_options() -> tuple[HuntOption, ...]:
    return declared_options(HuntOptions)
