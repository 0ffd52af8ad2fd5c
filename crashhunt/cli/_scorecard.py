"""``crashhunt scorecard``."""

from __future__ import annotations

import json
import re
from collections import defaultdict
from pathlib import Path

from crashhunt.base.errors import UsageError
from crashhunt.base.files import whole_file
from crashhunt.base.text import command_line
from crashhunt.cli._common import (
    DONE,
    NO_ANSWER,
    CommandOptions,
    Commands,
    WordsWithCommas,
    add_json,
    add_options,
    add_parallel,
    chosen_options,
)
from crashhunt.cli._suite import run_with_trust, states_watcher
from crashhunt.cli._trust import add_trust

_HUNT_OPTIONS = (
    "action", "observe", "arguments", "seed", "timeout_s", "native", "snapshot_roots", "snapshot_limit_mb",
)  # fmt: skip
_SPEEDS = "20,40,60"
_SEED = 1


def add_scorecard(commands: Commands) -> None:
    """Add the command ``scorecard`` to the parser."""
    scorecard = commands.add_parser(
        "scorecard",
        help="run all cases of a regulation, and compare the agent with models of a competent driver",
        description="Run an agent in all cases of a regulation, and write one page: where the agent and four models of "
        "a competent driver crash, and the share of cases in which the agent crashes and a competent driver does not. "
        "By default, the boundary between crashes and survived cases is searched. The same command resumes.",
    )
    scorecard.add_argument("agent", metavar="AGENT", help="the agent as MODULE:ATTR or by its name")
    what = scorecard.add_argument_group("what is run")
    what.add_argument("--suite", metavar="NAME", default="r157", help="the suite of cases: r157 (UN Regulation 157)")
    what.add_argument("--group", metavar="NAME,…", action=WordsWithCommas, default="",
                      help="run only these groups, such as cut-in,cut-out; default: all")  # fmt: skip
    what.add_argument("--speeds", metavar="KMH,…", default=_SPEEDS,
                      help=f"speeds of the agent at the beginning, in km/h; default: {_SPEEDS}")  # fmt: skip
    what.add_argument("--grid", action="store_true", help="run every case instead of searching the boundary")
    how = scorecard.add_argument_group("how it is run")
    how.add_argument(
        "--to", metavar="DIR", type=Path, help="directory of the scorecard; default: scorecard-SUITE-AGENT"
    )
    add_parallel(how)
    add_options(defaultdict(lambda: how, what=what), _HUNT_OPTIONS)
    add_trust(scorecard)
    add_json(scorecard)
    scorecard.set_defaults(command=_scorecard)


def _scorecard(options: CommandOptions, _words: list[str]) -> int:
    from crashhunt.report import describe_scorecard, scorecard_page, scorecard_table
    from crashhunt.suites import run_scorecard

    directory = options.to or Path(re.sub(r"[^\w.+-]+", "-", f"scorecard-{options.suite}-{options.agent}").rstrip("-"))
    chosen = chosen_options(options, _HUNT_OPTIONS)
    if chosen["seed"] is None:
        chosen = {**chosen, "seed": _SEED}
    watch, finish = states_watcher(as_json=options.json)
    try:
        found = run_with_trust(
            lambda trusted: run_scorecard(
                options.suite, options.agent, directory, speeds=_speeds(options.speeds),
                groups=[name for name in options.group.split(",") if name], grid=options.grid, options=chosen,
                parallel=options.parallel, watch=watch, trusted=trusted,
            ),
            options,
        )  # fmt: skip
    except KeyboardInterrupt:
        options.say(f"Interrupted. Run the same command to resume; {command_line(directory)} has the cases that ran.")
        raise
    finally:
        finish()
    card = found.to_json()
    for name, text in (
        ("scorecard.html", scorecard_page(card)),
        ("scorecard.md", scorecard_table(card)),
        ("scorecard.json", json.dumps(card) + "\n"),
    ):
        with whole_file(directory / name) as temporary:
            temporary.write_text(text, encoding="utf-8")
    options.answer(describe_scorecard(card, str(directory)), card)
    return DONE if found.is_complete else NO_ANSWER


def _speeds(text: str) -> list[int]:
    try:
        found = [int(word) for word in text.split(",")]
    except ValueError:
        found = []
    if not found or len(set(found)) < len(found):
        raise UsageError(f"--speeds is {text!r}", fix="give different whole numbers in km/h, such as 20,40,60")
    return found
