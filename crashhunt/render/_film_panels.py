"""Panels in a film: the built-in curves, and the pictures of an agent's own panels on their way into the film."""

from __future__ import annotations

import json
import textwrap
from typing import TYPE_CHECKING

import numpy as np

from crashhunt.crashes import Encounter, danger_course
from crashhunt.panels import Action, Curve, Panel, Text
from crashhunt.recording import is_opaque
from crashhunt.world import approaches

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from crashhunt.recording import Recording
    from crashhunt.world import Scene


# The panels that every film has.

_SHOWN_S = 10.0  # of the built-in curves
_TTC_CUT_S, _GAP_CUT_M, _ACCELERATION_CUT_MPS2 = 10.0, 100.0, 12.0  # as in the player of the report
_AGENT_CURVE, _PARTNER_CURVE = (154, 91, 0), (143, 15, 63)  # as the vehicles, in colours that are legible on white
_MOTION = ("speed (m/s)", "acceleration (m/s^2)", "criticality", "action")  # the font has no ²
_WITH_OTHER = ("time to collision (s)", "gap (m)", *_MOTION)
_WITH_NEAREST = ("least time to collision (s)", "nearest gap (m)", *_MOTION)  # a crash without a partner
_PLAN_COLUMNS = 5  # a trajectory: time, x, y, heading and speed of each point
_PANELS_WITHOUT_SCENE = ("reward", "action")


def builtin_labels(recording: Recording, other: str) -> tuple[str, ...]:
    """Return the labels of the panels that every film of a recording has.

    Args:
        recording: recording of the trial.
        other: identifier of the collision partner; empty if there is none.
    """
    if not recording.actors:
        return _PANELS_WITHOUT_SCENE
    labels = _WITH_OTHER if other else _WITH_NEAREST
    # A compact recording lacks actors that criticality depends on.
    return labels if recording.compact is None else tuple(label for label in labels if label != "criticality")


class BuiltinPanels:
    """The panels that every film has: time to collision, gap, speeds, accelerations, criticality, and the action.

    A recording without a scene has a curve of the reward instead of the other curves. A dotted line is a value that is
    cut at the axis.

    Args:
        recording: recording of the trial.
        agent: identifier of the vehicle that the curves describe.
        other: identifier of the collision partner; empty if there is none. The curves then describe the nearest actor.
        meanings: names of the agent's discrete actions, if they are known.
    """

    def __init__(self, recording: Recording, *, agent: str, other: str, meanings: Sequence[str] = ()) -> None:
        self._recording, self._agent, self._meanings = recording, agent, meanings
        self._labels = builtin_labels(recording, other)
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
