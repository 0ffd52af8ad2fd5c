"""A table with selected fields of every step of a recording."""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from crashhunt.base.errors import UsageError
from crashhunt.base.json_types import finite
from crashhunt.base.text import aligned, did_you_mean
from crashhunt.crashes import Encounter
from crashhunt.recording import describe_value, is_opaque
from crashhunt.scenario import ACTIONS
from crashhunt.simulators import TRAJECTORY_SHAPE
from crashhunt.world import approaches, join_frames

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from crashhunt.recording import AgentChannel, Recording, StepRecord


TableCell: TypeAlias = "bool | int | float | str | None"
TableRow: TypeAlias = dict[str, TableCell]
_MAX_COLUMNS = 12  # of an action in a table
_MAX_TEXT = 60  # of an action that is no array of numbers
_SCENE_FIELDS = ("x", "y", "heading", "speed")
NEAREST = ("time_to_collision_s", "gap_m", "required_deceleration")
"""Measures relative to the nearest actor, as in every trial."""

_PARTNER_FIELDS = {
    "gap_to_other_m": "gap_m",
    "time_to_other_s": "time_to_collision_s",
    "closing_speed": "closing_speed",
}


def check_fields(recording: Recording, fields: Sequence[str], agent: str) -> list[str]:
    """Return the table columns for the names of fields: observations and actions of an agent of a recording.

    Raises:
        UsageError: a field does not exist; the message lists the existing fields.
    """
    channel = next(found for found in recording.prologue.agents if found.id == agent)
    actions, observed = _actions(channel), _observed(channel)
    parts = list(actions)[: max(1, math.prod(channel.action_shape))]
    known = [*_SCENE_FIELDS, "reward", *NEAREST, *_PARTNER_FIELDS, *actions, *observed]
    names: list[str] = []
    for field in fields:
        name = field.replace(" ", "")
        if name != "action" and name not in known:
            hint = did_you_mean(name, known)
            shown = ", ".join(
                [*_SCENE_FIELDS, "reward", *NEAREST, *_PARTNER_FIELDS, "action", *parts[:9], *list(observed)[:3]]
            )
            raise UsageError(f"--print: there is no field {field!r}", fix=f"{hint} there are {shown}, …".lstrip())
        names += parts if name == "action" and not is_wide(channel) else (name,)
    return names


def steps_table(recording: Recording, fields: Sequence[str], agent: str, other: str = "") -> list[TableRow]:
    """Return one row for each step: the step, the time and the fields; None for a missing value.

    Args:
        recording: recording of the episode.
        fields: names of the columns: ``x``, ``y``, ``heading``, ``speed``, ``reward``, ``time_to_collision_s``,
            ``gap_m``, ``required_deceleration`` (relative to the nearest actor), ``gap_to_other_m``,
            ``time_to_other_s``, ``closing_speed`` (relative to the collision partner), ``observation[ROW,NAME]``, the
            components of the action by name, or ``action`` for all components; for a wide action, its text.
        agent: identifier of the agent whose values are listed.
        other: identifier of the collision partner.

    Raises:
        UsageError: a field does not exist; the message lists the existing fields.
    """
    channel = next(found for found in recording.prologue.agents if found.id == agent)
    actions, observed = _actions(channel), _observed(channel)
    names = check_fields(recording, fields, agent)
    measured: dict[str, NDArray[np.float64]] = {}
    if set(names) & set(NEAREST):
        frames = [*join_frames(recording.scenes())]
        measured = dict(zip(NEAREST, approaches(frames, agent), strict=True))
    moments = {moment.step: moment for moment in Encounter(recording, agent, other).moments} if other else {}
    rows = []
    for number, step in enumerate(recording.all_steps):
        row: TableRow = {"step": step.step, "time_s": step.scene.time_s if step.scene is not None else None}
        for name in names:
            if name in _PARTNER_FIELDS:
                row[name] = getattr(moments.get(step.step), _PARTNER_FIELDS[name], None)
            elif name in NEAREST:
                row[name] = float(measured[name][number]) if step.scene is not None else None
            elif name in actions or name == "action":
                array = step.actions.get(agent)
                row[name] = None if array is None else _action_cell(array, actions.get(name), channel)
            elif name in observed:
                array = step.observations.get(agent)
                row[name] = None if array is None else _item(array, observed[name], channel.observation_shape)
            else:
                row[name] = _of_scene(step, agent, name)
        rows.append({name: finite(value) if isinstance(value, float) else value for name, value in row.items()})
    return rows


def format_table(rows: Sequence[TableRow]) -> list[str]:
    """Return rows of a table as aligned lines below a heading."""
    if not rows:
        return []
    return aligned([list(rows[0])] + [[_format(value) for value in row.values()] for row in rows])


def stacked(heading: Sequence[str]) -> list[list[str]]:
    """Return a heading as several rows, one for each word of the longest column name, so that columns stay narrow.

    >>> stacked(["step", "target_speed", "gap m"])
    [['', 'target_', 'gap'], ['step', 'speed', 'm']]
    """
    words = [re.findall(r"[^ _]+_?", name) for name in heading]
    rows = max(map(len, words))
    return [[([""] * (rows - len(name)) + name)[row] for name in words] for row in range(rows)]


def _item(array: NDArray[np.generic], place: tuple[int, ...], shape: tuple[int, ...]) -> Any:
    """Return one number of an observation; for a value of any length, its text."""
    return describe_value(array) if is_opaque(shape) else array[place].item()


def _action_cell(array: NDArray[np.generic], place: tuple[int, ...] | None, channel: AgentChannel) -> Any:
    """Return one number of an action; for a whole action, its text."""
    return describe_action(array, channel) if place is None else array[place].item()


def describe_action(array: NDArray[np.generic], channel: AgentChannel) -> str:
    """Return a wide action as text: the end of a trajectory, or the first numbers."""
    if is_opaque(channel.action_shape):
        return describe_value(array, _MAX_TEXT)
    if channel.action_shape == TRAJECTORY_SHAPE:
        time, x, y, _, speed = array[-1].tolist()
        return f"to ({x:.1f}, {y:.1f}) at {speed:.1f} m/s in {time:.1f} s"
    return f"{', '.join(f'{value:.6g}' for value in array.reshape(-1)[:4].tolist())}, … ({array.size} numbers)"


def is_wide(channel: AgentChannel) -> bool:
    """Return whether an action of an agent has too many numbers for a table, or is no array of numbers."""
    return is_opaque(channel.action_shape) or math.prod(channel.action_shape) > _MAX_COLUMNS


def _actions(channel: AgentChannel) -> dict[str, tuple[int, ...]]:
    """Return the index of each number of an action by its names, first the names of the columns of a table."""
    if is_opaque(channel.action_shape):
        return {}
    places = list(np.ndindex(*channel.action_shape))
    named = {channel.value_name("action", place).replace(" ", ""): place for place in places}
    flat = {f"action[{number}]": place for number, place in enumerate(places)}
    if channel.action_shape == TRAJECTORY_SHAPE:
        columns = ACTIONS["trajectory"].names
        named = {f"action[{row},{columns[column]}]": (row, column) for row, column in places} | named
    return dict(zip(channel.action_names, places, strict=False)) | named | flat


def _observed(channel: AgentChannel) -> dict[str, tuple[int, ...]]:
    """Return the index of each number of an observation by its name, such as ``observation[PART,ROW,COLUMN]``."""
    if is_opaque(channel.observation_shape):
        return {"observation": ()}
    places = np.ndindex(*channel.observation_shape)
    return {channel.value_name("observation", place).replace(" ", ""): place for place in places}


def _of_scene(step: StepRecord, agent: str, name: str) -> float | None:
    if name == "reward":
        return step.rewards.get(agent)
    scene = step.scene
    row = scene.roster.index.get(agent) if scene is not None else None
    return None if scene is None or row is None else float(scene.data[row, _SCENE_FIELDS.index(name)])


def _format(value: TableCell) -> str:
    if value is None:
        return "-"
    return f"{value:.6g}" if isinstance(value, float) else str(value)
