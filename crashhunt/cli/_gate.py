"""``crashhunt gate``."""

from __future__ import annotations

import sys
import time
from collections import defaultdict
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base.errors import UsageError
from crashhunt.base.files import output_file
from crashhunt.base.text import format_number
from crashhunt.cli._common import (
    DONE,
    INTERRUPTED,
    NO_ANSWER,
    THE_ANSWER_IS_NO,
    add_build,
    add_ci_options,
    add_json,
    add_options,
    add_parallel,
    build_limit_s,
    chosen_options,
    duration_s,
    integer,
    make_console,
    number,
    tell,
)
from crashhunt.cli._trust import add_trust

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from crashhunt.cli._common import CommandOptions, Commands
    from crashhunt.statistics import GateReport
    from crashhunt.suites import GateProgress, RunRequest

_HUNT_OPTIONS = (
    "scenario", "ego", "action", "observe", "agents", "arguments", "scenario_arguments", "oracles", "requirements",
    "seed", "crash_on", "disturb", "timeout_s", "accelerate", "native", "executor", "snapshot_roots",
    "snapshot_limit_mb",
)  # fmt: skip
_TRIAL_OPTIONS = tuple(name for name in _HUNT_OPTIONS if name != "executor")  # which a suite says itself
_MOST, _MAX_STEPS, _MARGIN = 1000, 1500, 0.01
_LINE_EVERY_S = 30.0  # where there is no terminal


def add_gate(commands: Commands) -> None:
    """Add the command ``gate`` to the parser."""
    gate = commands.add_parser(
        "gate",
        help="give a verdict on a change: better, worse, no difference or undecided",
        description="Compare HEAD with BASE in the same traffic, trial by trial, until the verdict is certain. BASE "
        "and HEAD are commits of the repository that contains this folder, or agents. Exit code 0: HEAD is better, or "
        "there is no difference above --margin; 1: HEAD is worse; 3: undecided.",
    )
    gate.add_argument("base", metavar="BASE", help="a commit, or an agent as [ID=]MODULE:ATTR or by its name")
    gate.add_argument(
        "head", metavar="HEAD", help="the version with the change: a commit or an agent, in the same form as BASE"
    )
    what = gate.add_argument_group("what is compared")
    what.add_argument(
        "--suite",
        metavar="FILE",
        type=Path,
        help="compare both versions in every hunt of this suite.toml, instead of in --scenario",
    )
    what.add_argument(
        "--corpus", metavar="CORPUS", type=Path,
        help="first run the cases of this corpus in HEAD; HEAD is worse if a fixed crash reproduces; default: "
        "crashes/, if HEAD is a commit that contains this folder",
    )  # fmt: skip
    how = gate.add_argument_group("how it is compared")
    how.add_argument(
        "--most", metavar="N", type=integer, default=_MOST, help=f"maximum number of pairs of trials; default: {_MOST}"
    )
    how.add_argument(
        "--for", metavar="TIME", dest="duration", default="", help="stop the gate after this time, such as 30m"
    )
    how.add_argument(
        "--max-steps", metavar="N", type=integer, default=None,
        help=f"maximum number of steps of a trial; default: {_MAX_STEPS}, or with --suite, as in the suite",
    )  # fmt: skip
    how.add_argument(
        "--margin", metavar="SHARE", default=str(_MARGIN),
        help="the greatest difference in crashes per trial that still counts as no difference, such as 0.01 or 1%%; "
        f"0: never report the verdict no difference; default: {_MARGIN}",
    )  # fmt: skip
    how.add_argument(
        "--only-preventable", action="store_true",
        help="count a collision only if a model of a competent driver would have prevented it (crashhunt judge). If "
        "all answers are null, the collision does not count, and the report has the number of these. Crashes that are "
        "no collisions, such as agent_error, count as before",
    )  # fmt: skip
    how.add_argument(
        "--confidence",
        metavar="PERCENT",
        type=number,
        default=95.0,
        help="confidence of the verdict, in percent; default: 95",
    )
    add_parallel(how, "trials that run at a time, counted over BASE and HEAD together; at least 2")
    how.add_argument(
        "--keep", metavar="DIR", type=Path,
        help="keep the hunts of BASE and HEAD in this folder, for crashhunt compare, rate and report; the same command "
        "resumes the gate",
    )  # fmt: skip
    add_build(what, "each commit")
    add_options(defaultdict(lambda: how, what=what), _HUNT_OPTIONS)
    add_trust(gate)
    gate.add_argument("--markdown", metavar="FILE", type=Path, help="write the verdict as Markdown, for a pull request")
    gate.add_argument("--junit", metavar="FILE", type=Path, help="write the verdict as JUnit's XML")
    add_ci_options(gate)
    add_json(gate)
    gate.set_defaults(command=_gate)


def _gate(options: CommandOptions, words: list[str]) -> int:
    from crashhunt.report import describe_gate, gate_annotations, gate_summary, write_gate_junit
    from crashhunt.suites import Gate, GateVersion

    folder = Path.cwd()
    hunts = _of_suite(options, words) if options.suite is not None else _of_options(options, folder)
    gate = Gate(
        base=GateVersion.of(options.base, folder),
        head=GateVersion.of(options.head, folder),
        hunts=hunts,
        folder=folder,
        most=options.most,
        duration_s=duration_s(options.duration, "--for"),
        margin=_margin(options.margin),
        confidence=options.confidence,
        corpus=options.corpus,
        parallel=options.parallel,
        is_suite=options.suite is not None,
        trusted=options.trust,
        machine={"executor": options.executor} if options.suite is None or "--executor" in _flags(words) else None,
        only_preventable=options.only_preventable,
        build=options.build,
        build_limit_s=build_limit_s(options),
    )

    def tell_user(note: str) -> None:
        print(f"crashhunt: {note}", file=sys.stderr, flush=True)

    with _watched(as_json=options.json) as watch:
        found = gate.run(options.keep, watch, tell_user)
    options.say(describe_gate(found))
    summary = gate_summary(found)
    if options.markdown is not None:
        with output_file(options.markdown) as temporary:
            temporary.write_text(f"{summary}\n", encoding="utf-8")
    if options.junit is not None:
        write_gate_junit(found, options.junit)
    tell(options, summary, gate_annotations(found))
    options.print_json(found.to_json())
    return _exit_code(found)


def _exit_code(found: GateReport) -> int:
    if found.is_interrupted and found.verdict == "undecided":
        return INTERRUPTED
    if found.verdict == "worse":
        return THE_ANSWER_IS_NO
    return NO_ANSWER if found.verdict == "undecided" else DONE


def _margin(text: str) -> float:
    try:
        return float(text.removesuffix("%")) / (100 if text.endswith("%") else 1)
    except ValueError:
        raise UsageError(
            f"--margin {text!r} is not a share", fix="give a share from 0 to below 1, such as 0.01 or 1%"
        ) from None


def _of_options(options: CommandOptions, folder: Path) -> dict[str, RunRequest]:
    """Return the only hunt, as the options describe it."""
    from dataclasses import replace

    from crashhunt.plans import Request
    from crashhunt.scenario import shipped_scenarios
    from crashhunt.suites import RunRequest

    max_steps = _MAX_STEPS if options.max_steps is None else options.max_steps
    request = Request(trials=1, max_steps=max_steps, **chosen_options(options, _HUNT_OPTIONS)).checked()
    scenario = str(request.scenario)
    if scenario not in shipped_scenarios():
        scenario = str((folder / scenario).resolve())
    return {Path(scenario).stem or scenario: RunRequest(replace(request, scenario=scenario), str(folder))}


def _of_suite(options: CommandOptions, words: list[str]) -> dict[str, RunRequest]:
    """Return all runs of a suite by name."""
    from dataclasses import replace

    from crashhunt.plans import hunt_options
    from crashhunt.suites import Suite

    flags = {option.about.flag for option in hunt_options() if option.name in _TRIAL_OPTIONS and option.name != "seed"}
    if both := sorted(flags & _flags(words)):
        raise UsageError(f"--suite and {both[0]} exclude each other", fix=f"write {both[0]} into {options.suite}")
    suite = Suite.read(options.suite)
    found = {}
    for entry in suite.entries:
        for run in range(entry.runs):
            asked = suite.request(replace(entry, seed=options.seed) if options.seed is not None else entry, run)
            steps = asked.request.max_steps if options.max_steps is None else options.max_steps
            request = replace(asked.request, max_steps=steps).checked()
            if entry.seed is None and options.seed is None:
                request = replace(request, seed=None)  # it follows from that of the gate, which a resumed gate keeps
            found[f"{entry.id}.{run}"] = replace(asked, request=request)
    return found


def _flags(words: list[str]) -> set[str]:
    """Return the options that the command line contains."""
    return {word.partition("=")[0] for word in words}


@contextmanager
def _watched(*, as_json: bool) -> Iterator[Callable[[GateProgress], None]]:
    """Yield a function that shows the progress of a gate: a changing line on a terminal, else a line each 30 s."""
    from rich.status import Status

    console = make_console(stderr=True)
    if console.is_terminal and not as_json:
        with Status("preparing", console=console) as status:
            yield lambda progress: status.update(_progress(progress).replace("[", r"\["))
        return
    said = time.monotonic()

    def tell_now_and_then(progress: GateProgress) -> None:
        nonlocal said
        if time.monotonic() - said >= _LINE_EVERY_S:
            said = time.monotonic()
            print(_progress(progress), file=sys.stderr, flush=True)

    yield tell_now_and_then


def _progress(progress: GateProgress) -> str:
    return (
        f"{progress.name}: {progress.done:,} of {progress.most:,} pairs; only BASE crashes in {progress.only_base}, "
        f"only HEAD in {progress.only_head}; evidence {format_number(progress.evidence)}"
    )
