"""Films of crashes: the scene, the panels next to it, and the output formats."""

from __future__ import annotations

import json
import math
import textwrap
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image, ImageSequence

from crashhunt.base.errors import UsageError
from crashhunt.base.extras import install_command
from crashhunt.base.files import cannot_write, output_file
from crashhunt.base.progress import Watch, watched
from crashhunt.base.temporary import temporary_beside
from crashhunt.crashes import Encounter, danger_course
from crashhunt.panels import Action, Curve, Panel, Text
from crashhunt.recording import is_opaque
from crashhunt.render._scene_from_above import SceneView
from crashhunt.world import approaches

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from crashhunt.recording import Recording
    from crashhunt.world import Scene

_PANEL_PIXELS = (240, 160)
_BACKGROUND = 255
_AROUND_S = 10.0  # of a near miss, half of it before and half after


@dataclass(frozen=True, slots=True, kw_only=True)
class FilmOptions:
    """The options of a film."""

    # pictures per second; by default as many as there are steps per second, so that the film runs in real time
    fps: float = 0.0
    size: tuple[int, int] = (960, 540)  # size of the scene, in pixels
    # duration to show, in s: the end of a crash, or the time around the nearest moment of a near miss. 0 shows the
    # whole crash, or 10 s of a near miss.
    last_s: float = 0.0
    last_step_repeats: int = 10  # number of times that the last picture is repeated
    blank_frames: int = 10  # number of blank pictures between two crashes
    panels: bool = True  # whether to show panels next to the scene
    scale: float = 8.0  # scale of the scene, in pixels per metre

    def __post_init__(self) -> None:
        for name, value, least in (
            ("--fps", self.fps, 0), ("--last-seconds", self.last_s, 0), ("--blank-frames", self.blank_frames, 0),
            ("--last-step-repeats", self.last_step_repeats, 0), ("--size", min(self.size), 64),
        ):  # fmt: skip
            if not value >= least or not math.isfinite(value):
                raise UsageError(f"{name} is {value:g}", fix=f"give at least {least}")
        if max(self.size) > 8192:
            raise UsageError(f"--size is {self.size[0]}x{self.size[1]}", fix="give at most 8192x8192")


@dataclass(frozen=True, slots=True)
class Shot:
    """One crash or near miss of a film."""

    recording: Recording  # recording of the crash
    lanes: Sequence[tuple[NDArray[np.float64], NDArray[np.float64]]]  # lanes of the crash's map
    agent: str  # identifier of the vehicle in the centre of the picture
    other: str  # identifier of the collision partner
    crash_step: int
    panels: Mapping[int, Mapping[str, NDArray[np.uint8]]]  # pictures of the agent's own panels, by step and label
    meanings: Sequence[str] = ()  # names of the agent's discrete actions, if they are known
    # for a near miss, the step around which the film is made; -1 for a crash, with which the film ends
    nearest: int = -1
    crash_words: str = "CRASH"  # text above the step of the crash
    obstacles: Sequence[NDArray[np.float64]] = ()  # outlines of the obstacles of the crash's map


class Layout:
    """Positions of panels, next to the scene or below it, whichever makes the smaller picture; determined only once."""

    def __init__(self, frame: tuple[int, int], labels: Sequence[str]) -> None:
        (width, height), (across, down), count = frame, _PANEL_PIXELS, len(labels)
        rows, columns = max(1, height // down), max(1, width // across)
        next_to = width + math.ceil(count / rows) * across, max(height, min(rows, count) * down)
        below = max(width, min(columns, count) * across), height + math.ceil(count / columns) * down
        self.places: dict[str, tuple[int, int]] = {}
        if next_to[0] * next_to[1] < below[0] * below[1]:  # of two equal sizes, the narrow one is legible on a page
            self.size = next_to
            for number, label in enumerate(labels):
                self.places[label] = width + number // rows * across, number % rows * down
        else:
            self.size = below
            for number, label in enumerate(labels):
                self.places[label] = number % columns * across, height + number // columns * down
        # What players expect: an even number of pixels each way.
        self.size = self.size[0] + self.size[0] % 2, self.size[1] + self.size[1] % 2

    def compose(self, scene: NDArray[np.uint8], panels: Mapping[str, NDArray[np.uint8]]) -> NDArray[np.uint8]:
        """Return one picture with scene and panels; the place of a missing panel stays white."""
        picture = np.full((self.size[1], self.size[0], 3), _BACKGROUND, np.uint8)
        picture[: scene.shape[0], : scene.shape[1]] = scene
        for label, panel in panels.items():
            if label in self.places:
                x, y = self.places[label]
                picture[y : y + panel.shape[0], x : x + panel.shape[1]] = panel
        return picture


def check_places(*, video: Path | None = None, gif: Path | None = None, folder: Path | None = None) -> None:
    """Check before a film is made whether its files can be written.

    Raises:
        UsageError: a file name has the wrong ending or is not in a folder, the folder for frames is not empty, or PyAV
            is not installed.
    """
    for option, place, ending in (("--video", video, ".mp4"), ("--gif", gif, ".gif"), ("--frames", folder, "")):
        if place is None:
            continue
        if ending and place.suffix != ending:
            raise UsageError(f"{option} {str(place)!r} does not end in {ending}", fix="add this ending")
        if not place.parent.is_dir():
            raise UsageError(
                f"{option} {str(place)!r}: there is no folder {str(place.parent)!r}", fix="create this folder first"
            )
    if folder is not None and folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
        raise UsageError(f"--frames {str(folder)!r} is not an empty folder", fix="give a new folder")
    if video is not None:
        try:
            import av  # noqa: F401
        except ImportError as error:
            raise UsageError(
                f"--video needs PyAV: {error}", fix=f"{install_command('video')}, or give --gif or --frames"
            ) from None


def frames(shots: Sequence[Shot], options: FilmOptions) -> Iterator[NDArray[np.uint8]]:
    """Yield the pictures of a film, all of the same size."""
    labels: dict[str, None] = {}
    if options.panels:
        for shot in shots:
            labels |= dict.fromkeys(_builtin_labels(shot.recording, shot.other))
        for shot in shots:
            for panels in shot.panels.values():
                labels |= dict.fromkeys(panels)
    layout = Layout(options.size, list(labels))
    for number, shot in enumerate(shots):
        if number:
            blank = np.full((layout.size[1], layout.size[0], 3), _BACKGROUND, np.uint8)
            yield from [blank] * options.blank_frames
        view = SceneView(
            shot.recording,
            shot.lanes,
            agent=shot.agent,
            other=shot.other,
            width=options.size[0],
            height=options.size[1],
            scale=options.scale,
            crash_step=shot.crash_step,
            nearest_step=shot.nearest,
            crash_words=shot.crash_words,
            obstacles=shot.obstacles,
        )
        builtin = None
        if options.panels:
            builtin = BuiltinPanels(shot.recording, agent=shot.agent, other=shot.other, meanings=shot.meanings)
        last: tuple[int, NDArray[np.uint8]] | None = None
        for step in _steps(shot, options):
            if last is None or last[0] != step:
                drawn: dict[str, NDArray[np.uint8]] = {}
                if builtin is not None:
                    drawn |= shot.panels.get(step, {})
                    drawn |= {label: panel.draw(*_PANEL_PIXELS, label) for label, panel in builtin.panels(step)}
                last = step, layout.compose(view.draw(step), drawn)
            yield last[1]
        if last is not None:
            yield from [last[1]] * options.last_step_repeats


def _count(shots: Sequence[Shot], options: FilmOptions) -> int:
    """Return the number of pictures that `frames` yields."""
    shown = sum(len(_steps(shot, options)) + options.last_step_repeats for shot in shots)
    return shown + max(0, len(shots) - 1) * options.blank_frames


def _frame_rate(shots: Sequence[Shot], options: FilmOptions) -> float:
    """Return the number of pictures per second."""
    return options.fps or 1.0 / min(shot.recording.prologue.step_length_s for shot in shots)


def write_video(path: Path, shots: Sequence[Shot], options: FilmOptions, *, watch: Watch | None = None) -> int:
    """Write an MP4 file, which is never incomplete; return the number of pictures.

    Raises:
        HuntDirectoryError: the file cannot be written.
    """
    from fractions import Fraction

    import av

    count = 0
    with output_file(path) as temporary, av.open(str(temporary), "w") as container:
        stream: Any = None
        for picture in watched(frames(shots, options), _count(shots, options), watch):
            if stream is None:
                rate = Fraction(_frame_rate(shots, options)).limit_denominator(1000)
                stream = container.add_stream("libx264", rate=rate, options={"crf": "20", "preset": "veryfast"})
                stream.height, stream.width = picture.shape[:2]
                stream.pix_fmt = "yuv420p"
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
            count += 1
        if stream is not None:
            container.mux(stream.encode())
    return count


def write_gif(path: Path, shots: Sequence[Shot], options: FilmOptions, *, watch: Watch | None = None) -> int:
    """Write an animated GIF; return the number of its pictures, in which consecutive equal pictures count once.

    Raises:
        HuntDirectoryError: the file cannot be written.
    """
    pictures = [
        Image.fromarray(picture).quantize(64)
        for picture in watched(frames(shots, options), _count(shots, options), watch)
    ]
    with output_file(path) as temporary:
        pictures[0].save(
            temporary,
            save_all=True,
            append_images=pictures[1:],
            duration=max(20, round(1000 / _frame_rate(shots, options))),  # players slow down what is faster
            loop=0,
        )
        with Image.open(temporary) as written:
            count = sum(1 for _ in ImageSequence.Iterator(written))
    return count


def write_frames(folder: Path, shots: Sequence[Shot], options: FilmOptions, *, watch: Watch | None = None) -> int:
    """Write the pictures as ``000000.png`` and so on; return their number.

    Raises:
        HuntDirectoryError: the folder cannot be written.
    """
    made: list[Path] = []
    new = not folder.exists()
    try:
        if not new:
            folder.mkdir(exist_ok=True)  # which refuses a file
        # Half a film is none, and would be in the way of the next.
        with temporary_beside(folder if new else folder / "frames") as building:
            building.mkdir()
            for picture in watched(frames(shots, options), _count(shots, options), watch):
                made.append(building / f"{len(made):06d}.png")
                Image.fromarray(picture).save(made[-1])
            if new:
                building.rename(folder)
            else:
                for path in made:
                    path.replace(folder / path.name)
    except OSError as error:
        raise cannot_write(folder, error) from error
    return len(made)


def shown_steps(recording: Recording, last_s: float, nearest: int) -> tuple[int, int]:
    """Return the first and the last step of a film.

    ``last_s`` is as in `FilmOptions`, and ``nearest`` as in `Shot`.
    """
    dt, end = recording.prologue.step_length_s, recording.steps
    if nearest < 0:
        return max(0, end - round(last_s / dt)) if last_s else 0, end
    half = round((last_s or _AROUND_S) / 2 / dt)
    return max(0, nearest - half), min(end, nearest + half)


def _steps(shot: Shot, options: FilmOptions) -> list[int]:
    """Return the step that each picture shows."""
    dt = shot.recording.prologue.step_length_s
    first, last = shown_steps(shot.recording, options.last_s, shot.nearest)
    fps = options.fps or 1.0 / dt
    count = math.floor((last - first) * dt * fps + 1e-6) + 1
    steps = [min(last, first + int(number / fps / dt + 1e-6)) for number in range(count)]
    return steps if steps[-1] == last else [*steps, last]


# The panels that every film has.

_SHOWN_S = 10.0  # of the built-in curves
_TTC_CUT_S, _GAP_CUT_M, _ACCELERATION_CUT_MPS2 = 10.0, 100.0, 12.0  # as in the player of the report
_AGENT_CURVE, _PARTNER_CURVE = (154, 91, 0), (143, 15, 63)  # as the vehicles, in colours that are legible on white
_MOTION = ("speed (m/s)", "acceleration (m/s^2)", "criticality", "action")  # the font has no ²
_WITH_OTHER = ("time to collision (s)", "gap (m)", *_MOTION)
_WITH_NEAREST = ("least time to collision (s)", "nearest gap (m)", *_MOTION)  # a crash without a partner
_PLAN_COLUMNS = 5  # a trajectory: time, x, y, heading and speed of each point
_PANELS_WITHOUT_SCENE = ("reward", "action")


def _builtin_labels(recording: Recording, other: str) -> tuple[str, ...]:
    """Return the labels of the panels that every film of a recording has."""
    if not recording.actors:
        return _PANELS_WITHOUT_SCENE
    labels = _WITH_OTHER if other else _WITH_NEAREST
    # A compact recording lacks actors that criticality depends on.
    return labels if recording.compact is None else tuple(label for label in labels if label != "criticality")


class BuiltinPanels:
    """The panels that every film has: time to collision, gap, speeds, accelerations, criticality, and the action.

    A recording without a scene has a curve of the reward instead of the other curves. A dotted line is a value that is
    cut at the axis. Without a collision partner, the curves describe the nearest actor.
    """

    def __init__(self, recording: Recording, *, agent: str, other: str, meanings: Sequence[str] = ()) -> None:
        self._recording, self._agent, self._meanings = recording, agent, meanings
        self._labels = _builtin_labels(recording, other)
        scenes = recording.scenes()
        self._dt = recording.prologue.step_length_s
        self._times, self._gaps, _ = approaches([scene.frame for scene in scenes], agent)
        if other:
            moments = {moment.step: moment for moment in Encounter(recording, agent, other).moments}
            self._gaps, self._times = (
                np.array([getattr(moments[n], name) if n in moments else np.nan for n in range(len(scenes))])
                for name in ("gap_m", "time_to_collision_s")
            )
        self._speeds = {name: _speeds_of(scenes, name) for name in (agent, other) if name}
        self._colors = {agent: _AGENT_CURVE, **({other: _PARTNER_CURVE} if other else {})}
        self._accelerations = {
            name: np.append(np.nan, np.diff(speeds)) / self._dt for name, speeds in self._speeds.items()
        }
        course = danger_course(recording, agent) if recording.compact is None else None
        self._danger = course.own if course is not None else np.full(len(scenes), np.nan)
        self._rewards = np.array([step.rewards.get(agent, 0.0) for step in recording.all_steps if step.whole])
        self._seconds = np.array([scene.time_s for scene in scenes])
        channel = next((found for found in recording.prologue.agents if found.id == agent), None)
        self._names = tuple(channel.action_names) if channel is not None else ()
        self._plots_actions = channel is None or not is_opaque(channel.action_shape)
        every = recording.all_steps if self._plots_actions else []
        taken = [step.actions[agent] for step in every if agent in step.actions]
        spread = np.array(taken).reshape(len(taken), -1) if taken else np.zeros((1, 1))
        # The bounds are not recorded; what was decided in the whole episode says enough.
        self._low, self._high = np.minimum(spread.min(axis=0), 0.0), np.maximum(spread.max(axis=0), 1.0)
        # A value with two directions, such as a lane change to the left or right, has its 0 in the middle.
        has_sides = (self._low < 0) | np.isin(self._names or [""] * len(self._low), ["lane_change"])
        self._low = np.where(has_sides, -np.maximum(-self._low, self._high), self._low)
        self._high = np.where(has_sides, -self._low, self._high)

    def panels(self, step: int) -> list[tuple[str, Panel]]:
        """Return each panel with its label."""
        first = max(0, step - round(_SHOWN_S / self._dt))
        part = slice(first, step + 1)
        x = self._seconds[part]
        gaps, is_whole = self._gaps[part], self._recording.compact is None
        pulls = {name: values[part] for name, values in self._accelerations.items()}
        strongest = max(float(np.abs(values[np.isfinite(values)]).max(initial=1.0)) for values in pulls.values())
        bound = min(_ACCELERATION_CUT_MPS2, strongest)
        curves = [
            Curve(self._times[part], x, low=0.0, high=_TTC_CUT_S),
            Curve(gaps, x, low=0.0, high=min(_GAP_CUT_M, float(gaps[np.isfinite(gaps)].max(initial=1.0)))),
            Curve({name: values[part] for name, values in self._speeds.items()}, x, low=0.0, colors=self._colors),
            Curve(pulls, x, low=-bound, high=bound, colors=self._colors),
            *([Curve(self._danger[part], x, low=0.0, high=1.0)] if is_whole else []),
        ]
        if not self._recording.actors:
            curves = [Curve(self._rewards[part], x)]
        found: list[tuple[str, Panel]] = list(zip(self._labels, curves, strict=False))  # the action has the last label
        action = self._recording.all_steps[step].actions.get(self._agent)
        if action is not None and self._plots_actions:
            value = action.reshape(-1)
            if value.size == 1 and np.issubdtype(value.dtype, np.integer):
                drawn: Panel = Action(int(value[0]), names=self._meanings)
            elif action.ndim == 2 and action.shape[1] == _PLAN_COLUMNS and not self._names:
                rising = np.append(True, np.diff(action[:, 0]) > 0)  # an encoded trajectory repeats its last point
                drawn = Curve({"planned m/s": action[rising, -1]}, action[rising, 0], low=0.0)
            else:
                drawn = Action(value=value, low=self._low, high=self._high, names=self._names)
            found.append((self._labels[-1], drawn))
        return found


def _speeds_of(scenes: Sequence[Scene], actor: str) -> NDArray[np.float64]:
    """Return the speed of an actor in each scene; NaN where the actor is not in the scene."""
    rows = [scene.roster.index.get(actor) for scene in scenes]
    return np.array([np.nan if row is None else scene.speeds[row] for scene, row in zip(scenes, rows, strict=True)])


# Drawn panels on their way from the process of the agent to the one that makes the film.

_PANEL_SHAPE = (160, 240, 3)  # what a panel draws unless asked for another size
_MAX_LINE_CHARACTERS = 34  # characters that fit


def explanation(error: Exception) -> Text:
    """Return the panel that replaces a panel that cannot be drawn."""
    return Text("\n".join(textwrap.wrap(f"cannot be drawn: {type(error).__name__}: {error}", _MAX_LINE_CHARACTERS)[:9]))


def save_panels(folder: Path, step: int, panels: Sequence[tuple[str, Panel]]) -> None:
    """Draw and add the panels of one agent and step; a panel that cannot be drawn is replaced by the reason."""
    from PIL import Image

    with (folder / "index.jsonl").open("a", encoding="utf-8") as index:
        for number, (label, panel) in enumerate(panels):
            name = f"{step:06d}-{index.tell()}-{number}.png"
            try:
                picture = panel.draw(label=label)
                if picture.shape != _PANEL_SHAPE or picture.dtype != np.uint8:
                    raise ValueError(
                        f"a panel has type {picture.dtype} and shape {picture.shape}, not uint8 and {_PANEL_SHAPE}"
                    )
            except Exception as error:  # an agent may put anything into its panels
                picture = explanation(error).draw(label=label)
            Image.fromarray(picture).save(folder / name, compress_level=1)
            index.write(json.dumps([step, label, name]) + "\n")


def save_meanings(folder: Path, agent: str, meanings: Sequence[str]) -> None:
    """Write the names of an agent's discrete actions to a file; without names, no file is written."""
    if meanings:
        with (folder / "meanings.jsonl").open("a", encoding="utf-8") as file:
            file.write(json.dumps([agent, list(map(str, meanings))]) + "\n")


def load_meanings(folder: Path) -> dict[str, tuple[str, ...]]:
    """Return the names of actions that `save_meanings` has written, by agent."""
    try:
        lines = (folder / "meanings.jsonl").read_text(encoding="utf-8").splitlines()
    except OSError:
        return {}
    return {agent: tuple(meanings) for agent, meanings in map(json.loads, lines)}


def load_panels(folder: Path) -> dict[int, dict[str, NDArray[np.uint8]]]:
    """Return the pictures of panels by step and label, uint8, shape (height, width, 3)."""
    from PIL import Image

    found: dict[int, dict[str, NDArray[np.uint8]]] = {}
    try:
        lines = (folder / "index.jsonl").read_text(encoding="utf-8").splitlines()
    except OSError:
        return found
    for line in lines:
        step, label, name = json.loads(line)
        with Image.open(folder / name) as image:
            found.setdefault(step, {})[label] = np.asarray(image.convert("RGB"))
    return found
