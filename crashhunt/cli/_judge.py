"""``crashhunt judge``."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from crashhunt.base.errors import UsageError
from crashhunt.cli._common import (
    DONE,
    INTERRUPTED,
    add_crash,
    add_json,
    add_parallel,
    integer,
    opened_crash,
    shown_progress,
)
from crashhunt.cli._trust import add_trust, check_trust, run_trusted

if TYPE_CHECKING:
    from crashhunt.cli._common import CommandOptions, Commands
    from crashhunt.crashes import Bundle


def add_judge(commands: Commands) -> None:
    """Add the command ``judge`` to the parser."""
    judge = commands.add_parser(
        "judge",
        help="find the last avoidable step and the causes of a crash, by running it again",
        description="Find the last avoidable step and the causes of a crash. First run the trial of a collision many "
        "times, and override the agent from another step each time: full braking, or a lane change and braking. "
        "Report the last step from which such a manoeuvre avoids the collision. Then run the trial again and "
        "remove one element each time: a decision of the agent, a manoeuvre of another vehicle, or the value of an "
        "argument. For crashes that are not collisions, only the causes are analysed. The results are "
        "written to crash.json, and crashhunt show prints them.",
    )
    add_crash(judge)
    judge.add_argument(
        "--all", action="store_true", help="analyse all crashes of the hunt that have not been analysed, except hangs"
    )
    judge.add_argument(
        "--runs",
        metavar="N",
        type=integer,
        default=60,
        help="maximum number of trials to find the last avoidable step of one collision; default: 60",
    )
    judge.add_argument(
        "--why", metavar="N", type=integer, default=80,
        help="maximum number of trials to find the causes of one crash; 0: none; default: 80",
    )  # fmt: skip
    judge.add_argument(
        "--reference", metavar="N", type=integer, default=20,
        help="maximum number of trials with a reference driver, to find what the agent omitted to do; 0: none; "
        "default: 20",
    )  # fmt: skip
    judge.add_argument(
        "--no-drivers", action="store_true",
        help="do not ask models of a competent driver (UN R157) whether they would have prevented a collision",
    )  # fmt: skip
    add_parallel(judge)
    add_trust(judge)
    add_json(judge)
    judge.set_defaults(command=_judge)


def _judge(options: CommandOptions, _words: list[str]) -> int:
    from crashhunt.analysis import check_numbers
    from crashhunt.base.signals import stop_requests

    check_numbers(runs=options.runs, why=options.why, reference=options.reference, parallel=options.parallel)
    if options.all and options.crash:
        raise UsageError(f"--all and --crash {options.crash} contradict each other", fix="omit one of them")
    answers: list[dict[str, object]] = []
    with stop_requests() as stops:
        if options.all:
            bundles = _unjudged(options)
            for bundle in bundles:  # before the first one runs
                run_trusted(partial(check_trust, bundle), bundle, None, options)
            answers += (_judge_one(options, bundle, stops, True, write=True) for bundle in bundles if not stops)
        else:
            with opened_crash(options.directory, options.crash) as (bundle, archive):
                answers.append(
                    run_trusted(
                        lambda trusted: _judge_one(options, bundle, stops, trusted, write=archive is None),
                        bundle, archive, options,
                    )
                )  # fmt: skip
    options.print_json({"judged": answers})
    return INTERRUPTED if stops else DONE


def _unjudged(options: CommandOptions) -> list[Bundle]:
    from crashhunt.crashes import judgement_of, list_bundles, partner
    from crashhunt.results import find_hunts
    from crashhunt.trial import Outcome

    if options.directory.is_file():
        raise UsageError(
            "--all needs the directory of a hunt",
            fix="give the directory of a hunt, or omit --all",
            where=str(options.directory),
        )
    bundles = [bundle for hunt in find_hunts(options.directory) for bundle in list_bundles(hunt)]
    return [
        bundle
        for bundle in bundles
        if (partner(bundle.result) or (options.why and bundle.result.outcome is not Outcome.HANG))
        and ((known := judgement_of(bundle)) is None or known.is_interrupted or not (known.attempts or known.why))
    ]


def _judge_one(
    options: CommandOptions, bundle: Bundle, stops: list[int], trusted: bool | None, *, write: bool
) -> dict[str, object]:
    from crashhunt.analysis import judge_bundle
    from crashhunt.crashes import judgement_of
    from crashhunt.replays import ReplayOptions
    from crashhunt.report import Story

    with shown_progress(f"running {bundle.id}", as_json=options.json) as watch:
        bundle = judge_bundle(
            bundle,
            ReplayOptions(force=True, trusted=trusted),
            runs=options.runs,
            why=options.why,
            reference=options.reference,
            drivers=not options.no_drivers,
            parallel=options.parallel,
            write=write,
            watch=watch,
            stopped=lambda: bool(stops),
        )
    found = judgement_of(bundle)
    assert found is not None
    story = Story(bundle)
    lines = [f"{bundle.id}: {bundle.result.summary}", *(f"  {line}" for line in story.about_judgement())]
    options.say("\n".join(lines))
    return {"crash": bundle.id, **found.to_json()}
