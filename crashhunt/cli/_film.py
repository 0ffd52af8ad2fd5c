"""The options of ``crashhunt replay`` that make films."""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.errors import UsageError
from crashhunt.base.temporary import temporary_folder
from crashhunt.cli._common import integer, number
from crashhunt.cli._progress import shown_progress
from crashhunt.trial import Outcome

if TYPE_CHECKING:
    import argparse
    from collections.abc import Iterator, Mapping, Sequence

    import numpy as np
    from numpy.typing import NDArray

    from crashhunt.crashes import Bundle
    from crashhunt.recording import Recording
    from crashhunt.render import FilmOptions, Shot
    from crashhunt.replays import Look, ReplayOptions, ReplayReport
    from crashhunt.trial import TrialResult

__all__ = ["add_film_options", "film_options", "filmed", "look_at_all", "recorded_shot", "replayed_shot", "write_films"]


def add_film_options(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    film = parser.add_argument_group(
        "to watch it",
        "With --from-log no code is run, and nothing is simulated; otherwise what the replay does is shown, with the "
        "agent's own panels. Needs pip install 'crashhunt[video]'.",
    )
    film.add_argument("--video", metavar="FILE", type=Path, help="write an MP4 file")
    film.add_argument("--gif", metavar="FILE", type=Path, help="write an animated GIF")
    film.add_argument("--frames", metavar="DIR", type=Path, help="write a folder of PNG files")
    film.add_argument("--fps", metavar="N", type=number, default=0.0, help="pictures a second; default: one a step")
    film.add_argument("--size", metavar="WxH", default="960x540", help="of the scene, in pixels; default: 960x540")
    film.add_argument(
        "--last-seconds", metavar="S", type=number, default=0.0,
        help="only the end of it; of a near miss, around the moment when it was nearest (default of one: 10)",
    )  # fmt: skip
    film.add_argument(
        "--last-step-repeats", metavar="N", type=integer, default=10, help="of the last picture; default: 10"
    )
    film.add_argument("--blank-frames", metavar="N", type=integer, default=10, help="between two crashes; default: 10")
    film.add_argument("--no-panels", action="store_true", help="show the scene alone")


def film_options(options: argparse.Namespace) -> FilmOptions | None:
    """Return what a film shall look like; None where none is wanted.

    Raises:
        UsageError: an option cannot be meant, or Pillow is not installed.
    """
    if not (options.video or options.gif or options.frames):
        return None
    try:
        from crashhunt.render import FilmOptions, check_places
    except ImportError as error:
        raise UsageError(f"a film needs Pillow: {error}", fix="pip install 'crashhunt[video]'") from None
    check_places(video=options.video, gif=options.gif, folder=options.frames)
    width, _, height = options.size.partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise UsageError(f"--size {options.size!r} is no size", fix="write 960x540")
    return FilmOptions(
        fps=options.fps,
        size=(int(width), int(height)),
        last_s=options.last_seconds,
        last_step_repeats=options.last_step_repeats,
        blank_frames=options.blank_frames,
        panels=not options.no_panels,
    )


def look_at_all(bundle: Bundle, *, to_stderr: bool = False) -> Look | None:
    """Return how to look at a whole crash; None where nothing of it can be looked at."""
    from crashhunt.replays import Look

    # The process that is looked at is not watched over: it stops before what ended the one of the hunt.
    fatal = bundle.result.outcome in {Outcome.PROCESS_DIED, Outcome.HANG}
    until = bundle.result.steps if fatal else bundle.result.spec.max_steps
    return Look(until=until, to_stderr=to_stderr) if until else None


@contextmanager
def filmed(
    chosen: ReplayOptions, bundle: Bundle, film: FilmOptions | None, *, to_stderr: bool
) -> Iterator[ReplayOptions]:
    """Yield how to replay so that the agent's panels are drawn, and where they then are."""
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
        look = chosen.look or look_at_all(bundle, to_stderr=to_stderr)
        yield replace(chosen, look=look and replace(look, panels=(first, folder)))


def replayed_shot(report: ReplayReport, chosen: ReplayOptions) -> Shot:
    """Return what a replay did, to be filmed."""
    from crashhunt.render import load_meanings, load_panels

    folder = chosen.look.panels[1] if chosen.look is not None and chosen.look.panels is not None else None
    panels = load_panels(folder) if folder is not None else {}
    meanings = load_meanings(folder).get(report.bundle.driver, ()) if folder is not None else ()
    crashed = report.replayed.outcome in report.rerun.worker.crash_on
    return _shot(report.bundle, report.recording, report.replayed, panels, crashed=crashed, meanings=meanings)


def recorded_shot(bundle: Bundle) -> Shot:
    """Return what was recorded, to be filmed."""
    return _shot(bundle, bundle.recording(), bundle.result, {}, crashed=not bundle.is_near_miss)


def write_films(options: argparse.Namespace, shots: list[Shot], film: FilmOptions) -> dict[str, int]:
    """Write what was asked for; return file to number of pictures.

    Raises:
        CrashhuntError: a file cannot be written, or what writes it is not installed.
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
    from crashhunt.crashes import most_dangerous
    from crashhunt.recording import read_lanes
    from crashhunt.render import Shot

    lanes = read_lanes(bundle.path / layout.LOG)
    near = most_dangerous(recording) if bundle.is_near_miss and not crashed else None
    if near is not None:
        return Shot(recording, lanes, near.agent, near.other, -1, panels, meanings, nearest=near.step)
    hit = result.collision
    other = hit.other if hit else ""
    return Shot(recording, lanes, bundle.driver, other, recording.steps if crashed else -1, panels, meanings)
