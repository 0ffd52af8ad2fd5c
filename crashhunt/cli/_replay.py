"""``crashhunt replay``."""

from __future__ import annotations

import json
import math
import re
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from crashhunt.base import layout
from crashhunt.base.errors import UsageError
from crashhunt.base.extras import install_command
from crashhunt.base.temporary import temporary_folder
from crashhunt.base.text import command_line
from crashhunt.cli._common import (
    INTERRUPTED,
    WordsWithCommas,
    add_crash,
    add_json,
    integer,
    number,
    opened_crash,
    pairs,
    shown_progress,
)
from crashhunt.cli._trust import add_trust, run_trusted
from crashhunt.trial import Outcome

if TYPE_CHECKING:
    import argparse
    from collections.abc import Callable, Iterator, Mapping, Sequence

    import numpy as np
    from numpy.typing import NDArray

    from crashhunt.base.codec import JsonObject
    from crashhunt.cli._common import CommandOptions, Commands, Parser
    from crashhunt.crashes import Bundle
    from crashhunt.recording import Recording
    from crashhunt.render import FilmOptions, Shot
    from crashhunt.replays import Look, ReplayOptions, ReplayReport
    from crashhunt.trial import TrialResult


# The options of ``crashhunt replay`` that make films.


def add_film_options(parser: Parser) -> None:
    """Add the options for films to the parser."""
    film = parser.add_argument_group(
        "to watch it",
        "With --from-log, the film shows the recording, and no code runs. Otherwise it shows the replay, with the "
        "agent's own panels. Needs: pip install 'crashhunt[video]'.",
    )
    film.add_argument("--video", metavar="FILE", type=Path, help="write an MP4 file")
    film.add_argument("--gif", metavar="FILE", type=Path, help="write an animated GIF")
    film.add_argument("--frames", metavar="DIR", type=Path, help="write the pictures as PNG files into this folder")
    film.add_argument(
        "--fps",
        metavar="N",
        type=number,
        default=0.0,
        help="number of pictures per second; default: one picture per step",
    )
    film.add_argument(
        "--size", metavar="WxH", default="960x540", help="size of the drawn scene, in pixels; default: 960x540"
    )
    film.add_argument(
        "--last-seconds", metavar="S", type=number, default=0.0,
        help="show only the last S seconds; of a near miss, the S seconds around its closest moment (default: 10)",
    )  # fmt: skip
    film.add_argument(
        "--last-step-repeats",
        metavar="N",
        type=integer,
        default=10,
        help="how often the film repeats its last picture; default: 10",
    )
    film.add_argument(
        "--blank-frames",
        metavar="N",
        type=integer,
        default=10,
        help="number of blank pictures between two crashes; default: 10",
    )
    film.add_argument(
        "--no-panels", action="store_true", help="do not show the pictures that the agent returns from panels()"
    )


def film_options(options: CommandOptions) -> FilmOptions | None:
    """Return the options of a film; None if the user wants no film.

    Raises:
        UsageError: an option is invalid, or Pillow is not installed.
    """
    if not (options.video or options.gif or options.frames):
        return None
    try:
        from crashhunt.render import FilmOptions, check_places
    except ImportError as error:
        raise UsageError(f"a film needs Pillow: {error}", fix=install_command("video")) from None
    check_places(video=options.video, gif=options.gif, folder=options.frames)
    width, _, height = options.size.partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise UsageError(f"--size {options.size!r} is not a size", fix="write WIDTHxHEIGHT, such as 960x540")
    return FilmOptions(
        fps=options.fps,
        size=(int(width), int(height)),
        last_s=options.last_seconds,
        last_step_repeats=options.last_step_repeats,
        blank_frames=options.blank_frames,
        panels=not options.no_panels,
    )


def look_at_all(bundle: Bundle, *, quiet: bool = False) -> Look | None:
    """Return the options to examine a whole crash; None if no part of it can be examined."""
    from crashhunt.replays import Look

    # The process that is looked at is not watched over: it stops before what ended the one of the hunt.
    fatal = bundle.result.outcome in {Outcome.PROCESS_DIED, Outcome.HANG}
    until = bundle.result.steps if fatal else bundle.result.spec.max_steps
    return Look(until=until, quiet=quiet) if until else None


@contextmanager
def filmed(chosen: ReplayOptions, bundle: Bundle, film: FilmOptions | None) -> Iterator[ReplayOptions]:
    """Yield the replay options with which the agent's panels are drawn, and the folder of their pictures."""
    if film is None or not film.panels:
        yield chosen
        return
    with temporary_folder("panels") as folder:
        from crashhunt.crashes import most_dangerous
        from crashhunt.render import shown_steps

        first = 0
        if film.last_s or bundle.is_near_miss:
            recording = bundle.recording()
            near = most_dangerous(recording) if bundle.is_near_miss else None
            first = max(0, shown_steps(recording, film.last_s, near.step if near is not None else -1)[0] - 1)
        look = chosen.look or look_at_all(bundle, quiet=True)
        yield replace(chosen, look=look and replace(look, panels=(first, folder)))


def replayed_shot(report: ReplayReport, chosen: ReplayOptions) -> Shot:
    """Return a replay in the form from which films are made."""
    from crashhunt.render import load_meanings, load_panels

    folder = chosen.look.panels[1] if chosen.look is not None and chosen.look.panels is not None else None
    panels = load_panels(folder) if folder is not None else {}
    meanings = load_meanings(folder).get(report.bundle.driver, ()) if folder is not None else ()
    crashed = report.replayed.outcome in report.rerun.worker.crash_on
    return _shot(report.bundle, report.recording, report.replayed, panels, crashed=crashed, meanings=meanings)


def recorded_shot(bundle: Bundle) -> Shot:
    """Return the recording of a crash in the form from which films are made."""
    return _shot(bundle, bundle.recording(), bundle.result, {}, crashed=not bundle.is_near_miss)


def write_films(options: CommandOptions, shots: list[Shot], film: FilmOptions) -> dict[str, int]:
    """Write the requested films; return the number of pictures of each file.

    Raises:
        CrashhuntError: a file cannot be written, or a required package is not installed.
    """
    from crashhunt.render import write_frames, write_gif, write_video

    written = {}
    for path, write in ((options.video, write_video), (options.gif, write_gif), (options.frames, write_frames)):
        if path is not None:
            with shown_progress(f"writing {path}", as_json=options.json) as watch:
                written[str(path)] = write(path, shots, film, watch=watch)
    return written


def _shot(
    bundle: Bundle,
    recording: Recording,
    result: TrialResult,
    panels: Mapping[int, Mapping[str, NDArray[np.uint8]]],
    *,
    crashed: bool,
    meanings: Sequence[str] = (),
) -> Shot:
    from crashhunt.crashes import most_dangerous, names_of_actions
    from crashhunt.recording import read_lanes, read_obstacles
    from crashhunt.render import Shot

    log = bundle.path / layout.LOG
    lanes, obstacles = read_lanes(log), read_obstacles(log)
    near = most_dangerous(recording) if bundle.is_near_miss and not crashed else None
    if near is not None:
        return Shot(
            recording=recording,
            lanes=lanes,
            agent=near.agent,
            other=near.other,
            crash_step=-1,
            panels=panels,
            meanings=meanings or names_of_actions(bundle, near.agent),
            nearest=near.step,
            obstacles=obstacles,
        )
    hit = result.collision
    other = hit.other if hit else ""
    return Shot(
        recording=recording,
        lanes=lanes,
        agent=bundle.driver,
        other=other,
        crash_step=recording.steps if crashed else -1,
        panels=panels,
        meanings=meanings or names_of_actions(bundle, bundle.driver),
        crash_words=_crash_words(result.outcome),
        obstacles=obstacles,
    )


def _crash_words(outcome: Outcome) -> str:
    """Return the text that a film shows at the end: only a traffic crash is called a crash."""
    from crashhunt.oracles import REQUIREMENT

    if outcome.category == "traffic crash":
        return "CRASH"
    return "VIOLATION" if outcome == REQUIREMENT else str(outcome).replace("_", " ").upper()


def add_replay(commands: Commands) -> None:
    """Add the command ``replay`` to the parser."""
    replay = commands.add_parser(
        "replay",
        help="run a saved crash again, and report whether it is bit-identical",
        description="Run a saved crash again in a new process, from its bundle alone, and compare every observation, "
        "action and scene with the log. Exits with 1 if the verdict is not the expected one.",
    )
    add_crash(replay, default="the crash with the fewest steps; for a film, several with commas")
    who = replay.add_mutually_exclusive_group()
    who.add_argument(
        "--code", choices=("snapshot", "current"), default="snapshot",
        help="run the agent's code from the snapshot (the default), or today's code, to see whether a fix works",
    )  # fmt: skip
    who.add_argument(
        "--from-log", action="store_true", help="repeat the recorded actions instead of running the agent's code"
    )
    replay.add_argument(
        "--set", metavar="NAME=VALUE", action="append", default=[], dest="sets",
        help="another value for an argument of the agent or of the scenario; if there are several agents, ID.NAME "
        "names the agent",
    )  # fmt: skip
    replay.add_argument(
        "--scenario", metavar="NAME|PATH", default="",
        help="run the same agents with the same arguments and seed in another scenario, which may use another "
        "simulator, to see whether they crash there too",
    )  # fmt: skip
    replay.add_argument("--no-accelerate", action="store_true", help="run highway-env without the accelerator")
    replay.add_argument(
        "--times",
        metavar="N",
        type=integer,
        default=1,
        help="number of replays; several replays show whether all have the same verdict; default: 1",
    )
    replay.add_argument(
        "--expect", choices=("reproduced", "fixed"), default="reproduced",
        help="the expected verdict, for which the exit code is 0; default: reproduced",
    )  # fmt: skip
    _add_inspection(replay)
    add_film_options(replay)
    add_trust(replay)
    replay.add_argument(
        "--force", action="store_true",
        help="replay even if the snapshot is damaged; needs --trust, or --from-log, which runs no code of the snapshot",
    )  # fmt: skip
    add_json(replay)
    replay.set_defaults(command=_replay)


def _add_inspection(replay: argparse.ArgumentParser) -> None:
    """Add the options that stop a replay, and show what is inside."""
    look = replay.add_argument_group(
        "to look into it",
        "With these options, the agent runs attached to the terminal, so breakpoints in its code work.",
    )
    stop = look.add_mutually_exclusive_group()
    stop.add_argument("--until", metavar="STEP", type=integer, help="stop the replay after this step")
    stop.add_argument(
        "--before",
        metavar="N",
        type=integer,
        help="stop the replay N steps before the crash, or before the closest moment of a near miss",
    )
    look.add_argument(
        "--pdb", action="store_true",
        help="start the debugger in the agent's method act at the last step of the replay; agent, observation, scene "
        "and step are local variables",
    )  # fmt: skip
    look.add_argument(
        "--print", metavar="FIELD,…", action=WordsWithCommas, default="", dest="fields",
        help="print a table with these values of each step: x, y, heading, speed, reward, time_to_collision_s, gap_m "
        "and required_deceleration (to the nearest actor), gap_to_other_m, time_to_other_s, closing_speed, action or "
        "its parts, action[ROW,COLUMN], observation[ROW,NAME] and other names that a divergence contains",
    )  # fmt: skip
    look.add_argument(
        "--gui", action="store_true",
        help="open the simulator's own window, follow the agent, and pause before the crash",
    )  # fmt: skip
    look.add_argument(
        "--sleep", metavar="S", type=number,
        help="with --gui: wall time between two steps, in s; default: the length of a simulation step, so that the "
        "replay runs in real time",
    )  # fmt: skip


def _replay(options: CommandOptions, _words: list[str]) -> int:
    from crashhunt.replays import ReplayOptions

    chosen = ReplayOptions(
        code="log" if options.from_log else options.code,
        changes=pairs(options.sets, "--set"),
        force=options.force,
        times=options.times,
        scenario=options.scenario,
        accelerate=not options.no_accelerate,
    )
    film = film_options(options)
    crashes = options.crash.split(",")
    if len(crashes) > 1 and film is None:
        raise UsageError(
            f"--crash {options.crash!r} names several crashes",
            fix="give one crash, or add --video, --gif or --frames for one film of them",
        )
    _refuse_what_would_be_ignored(options, film)
    if chosen.times > 1:
        return _replay_often(options, chosen)
    answers, shots, good = [], [], True
    for crash in crashes:
        with opened_crash(options.directory, crash) as (bundle, archive):
            if film is not None and options.from_log:
                shots.append(recorded_shot(bundle))
                continue
            one = replace(chosen, look=_view_of(options, bundle))

            def run(trusted: bool | None, bundle: Bundle = bundle, one: ReplayOptions = one) -> tuple[Any, ...]:
                with filmed(replace(one, trusted=trusted), bundle, film) as asked:
                    report, answer = _replay_one(options, bundle, asked)
                    return report, answer, replayed_shot(report, asked) if film is not None else None

            report, answer, shot = run_trusted(run, bundle, archive, options)
            shots += [shot] if shot is not None else []
            answers.append(answer)
            good = good and set(report.verdicts) == {options.expect}
    written = write_films(options, shots, film) if film is not None else {}
    for path, count in written.items():
        options.say(f"{command_line(path)} has {count} pictures")
    if options.json:
        data: dict[str, object] = dict(answers[0]) if len(answers) == 1 else {"crashes": answers}
        print(json.dumps(data | ({"written": written} if film is not None else {})))
    return 0 if good else 1


def _replay_often(options: CommandOptions, chosen: ReplayOptions) -> int:
    """Replay one crash several times; after a Ctrl-C, report the replays that finished."""
    from crashhunt.base.signals import stop_requests
    from crashhunt.trial_reruns import StoppedError

    with opened_crash(options.directory, options.crash) as (bundle, archive), stop_requests() as stops:
        chosen = replace(chosen, look=_view_of(options, bundle))

        def run(trusted: bool | None) -> tuple[ReplayReport, JsonObject]:
            return _replay_one(options, bundle, replace(chosen, trusted=trusted), lambda: bool(stops))

        try:
            report, answer = run_trusted(run, bundle, archive, options)
        except StoppedError:
            options.say(f"Interrupted: none of {chosen.times} replays finished.")
            return INTERRUPTED
    if report.times < chosen.times:
        options.say(f"Interrupted: {report.times} of {chosen.times} replays finished.")
    options.print_json(answer)
    if report.times < chosen.times:
        return INTERRUPTED
    return 0 if set(report.verdicts) == {options.expect} else 1


def _refuse_what_would_be_ignored(options: CommandOptions, film: FilmOptions | None) -> None:
    """Refuse options that contradict each other, instead of ignoring one of them."""
    look = {
        "--gui": options.gui,
        "--pdb": options.pdb,
        "--until": options.until is not None,
        "--before": options.before is not None,
    }
    if options.scenario:
        for name in [
            name for name, given in {**look, "--print": options.fields, "a film": film is not None}.items() if given
        ]:
            raise UsageError(
                f"{name} cannot be combined with --scenario, because it needs the scenario of the crash",
                fix="omit one of the two",
            )
    if film is not None and options.from_log:
        look |= {"--print": options.fields, "--set": options.sets, "--times": options.times != 1}
        for name in [name for name, given in look.items() if given]:
            raise UsageError(
                f"{name} cannot be used with --from-log, which simulates nothing", fix=f"omit {name} or --from-log"
            )
    if options.times != 1:
        if film is not None:
            look |= {"a film": True}
        for name in [name for name, given in look.items() if given]:
            raise UsageError(
                f"{name} examines one run, so it cannot be combined with --times {options.times}",
                fix="omit one of the two",
            )


def _replay_one(
    options: CommandOptions,
    bundle: Bundle,
    chosen: ReplayOptions,
    stopped: Callable[[], bool] = lambda: False,
) -> tuple[ReplayReport, JsonObject]:
    from crashhunt.crashes import most_dangerous, partner
    from crashhunt.replays import replay
    from crashhunt.report import check_fields, describe_replay, format_table, steps_table

    fields = re.split(r",(?![^\[]*\])", options.fields)  # not at the comma of observation[ROW,NAME]
    if options.fields and chosen.code != "current":  # today's code may be shown other observations
        check_fields(bundle.recording(), fields, bundle.driver)
    report = replay(bundle, chosen, stopped)
    answer = report.to_json()
    if options.fields:
        near = most_dangerous(bundle.recording()) if bundle.is_near_miss else None
        other = partner(bundle.result) if near is None or near.agent != bundle.driver else near.other
        table = steps_table(report.recording, fields, bundle.driver, other)
        options.say("\n".join([*format_table(table), ""]))
        answer["table"] = table
    options.say(describe_replay(report))
    return report, answer


def _view_of(options: CommandOptions, bundle: Bundle) -> Look | None:
    """Return the options of a debugged replay; None for a plain replay."""
    from crashhunt.replays import Look

    if options.json and options.pdb:
        raise UsageError("--pdb needs a terminal, so it cannot be combined with --json", fix="omit --pdb or --json")
    if options.sleep is not None and not (options.gui and 0 <= options.sleep < math.inf):
        raise UsageError(f"--sleep is {options.sleep:g}", fix="give a time of at least 0 s, together with --gui")
    until = _last_step(options, bundle)
    if options.gui:
        whole = look_at_all(bundle)
        if whole is None:
            raise UsageError(f"{bundle.id} ended before its first step, so there is nothing to show", fix="omit --gui")
        real_time = bundle.recording().prologue.step_length_s
        return replace(
            whole,
            until=until or whole.until,
            stop_at=until if options.pdb else 0,
            to_stderr=options.json,
            window=real_time if options.sleep is None else options.sleep,
        )
    return Look(until=until, stop_at=until if options.pdb else 0, to_stderr=options.json) if until else None


def _last_step(options: CommandOptions, bundle: Bundle) -> int:
    """Return the step at which to stop; 0 without ``--until`` or ``--before``."""
    crash, what = bundle.result.steps, "the crash is"
    if bundle.is_near_miss and (options.before is not None or options.pdb):
        from crashhunt.crashes import most_dangerous

        near = most_dangerous(bundle.recording())
        what = "the closest moment is" if near is not None and near.step else "the trial ended"
        crash = near.step if near is not None and near.step else crash
    if options.before is not None:
        if not 0 <= options.before < crash:
            fix = f"give 0 to {crash - 1}" if crash else "omit the option"
            raise UsageError(f"--before is {options.before}, but {what} at step {crash}", fix=fix)
        return crash - int(options.before)
    if options.until is not None:
        if options.until < 1:
            raise UsageError(f"--until is {options.until}", fix="give at least 1")
        return int(options.until)
    # An agent that failed did so in the step after the last complete one.
    return crash + (bundle.result.outcome is Outcome.AGENT_ERROR) if options.pdb else 0
