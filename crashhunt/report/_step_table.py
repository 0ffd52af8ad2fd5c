"""A table with selected fields of every step of a recording."""

from __future__ import annotations

import math
import re
from contextlib import suppress
from itertools import product
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from crashhunt.base.errors import CrashhuntError, UsageError
from crashhunt.base.plugins import locate
from crashhunt.base.text import aligned, did_you_mean
from crashhunt.crashes import Encounter
from crashhunt.recording import describe_value, is_opaque
from crashhunt.snapshots import latest_snapshot
from crashhunt.trial import signature_of
from crashhunt.world import approaches, join_frames

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    import numpy as np
    from numpy.typing import NDArray

    from crashhunt.plans import HuntSettings
    from crashhunt.recording import AgentChannel, Recording, StepRecord


TableCell: TypeAlias = "bool | int | float | str | None"
TableRow: TypeAlias = dict[str, TableCell]
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
    known = [*_SCENE_FIELDS, "reward", *NEAREST, *_PARTNER_FIELDS, *actions, *observed]
    names: list[str] = []
    for field in fields:
        name = field.replace(" ", "")
        if name != "action" and name not in known:
            hint = did_you_mean(name, known)
            shown = ", ".join(
                [*_SCENE_FIELDS, "reward", *NEAREST, *_PARTNER_FIELDS, "action", *actions, *list(observed)[:3]]
            )
            raise UsageError(f"--print: there is no field {field!r}", fix=f"{hint} there are {shown}, …".lstrip())
        names += actions if name == "action" else (name,)
    return names


def steps_table(recording: Recording, fields: Sequence[str], agent: str, other: str = "") -> list[TableRow]:
    """Return one row for each step: the step, the time and the fields; None for a missing value.

    Args:
        recording: recording of the episode.
        fields: names of the columns: ``x``, ``y``, ``heading``, ``speed``, ``reward``, ``time_to_collision_s``,
            ``gap_m``, ``required_deceleration`` (relative to the nearest actor), ``gap_to_other_m``,
            ``time_to_other_s``, ``closing_speed`` (relative to the collision partner), ``observation[ROW,NAME]``, the
            components of the action by name, or ``action`` for all components.
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
            elif name in actions:
                array = step.actions.get(agent)
                row[name] = None if array is None else _item(array, (actions.index(name),), channel.action_shape)
            elif name in observed:
                array = step.observations.get(agent)
                row[name] = None if array is None else _item(array, observed[name], channel.observation_shape)
            else:
                row[name] = _of_scene(step, agent, name)
        rows.append({name: None if _is_nothing(value) else value for name, value in row.items()})
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
    """Return one number of an action, flattened, or of an observation; for a value of any length, its text."""
    if is_opaque(shape):
        return describe_value(array)
    return (array.reshape(-1) if len(place) == 1 else array)[place].item()


def _actions(channel: AgentChannel) -> tuple[str, ...]:
    if is_opaque(channel.action_shape):
        return ("action",)
    return tuple(channel.action_names) or tuple(f"action[{n}]" for n in range(math.prod(channel.action_shape)))


def _observed(channel: AgentChannel) -> dict[str, tuple[int, ...]]:
    shape = tuple(channel.observation_shape)
    if is_opaque(shape):
        return {"observation": ()}
    if channel.observation_parts:
        return _observed_in_parts(channel)
    if len(shape) == 2:
        names = channel.observation_names or tuple(map(str, range(shape[1])))
        return {
            f"observation[{row},{name}]": (row, column) for row in range(shape[0]) for column, name in enumerate(names)
        }
    if len(shape) == 1:
        return {f"observation[{place}]": (place,) for place in range(shape[0])}
    return {}


def _observed_in_parts(channel: AgentChannel) -> dict[str, tuple[int, ...]]:
    """Return the place of each value of an observation with parts, by ``observation[PART,ROW,COLUMN]``."""
    found: dict[str, tuple[int, ...]] = {}
    begin = 0
    for part in channel.observation_parts:
        for number, place in enumerate(product(*map(range, part.shape))):
            *rows, last = place
            words = [part.name, *map(str, rows), part.columns[last] if part.columns else str(last)]
            found[f"observation[{','.join(words)}]"] = (begin + number,)
        begin += part.size
    return found


def _of_scene(step: StepRecord, agent: str, name: str) -> float | None:
    if name == "reward":
        return step.rewards.get(agent)
    scene = step.scene
    row = scene.roster.index.get(agent) if scene is not None else None
    return None if scene is None or row is None else float(scene.data[row, _SCENE_FIELDS.index(name)])


def _is_nothing(value: TableCell) -> bool:
    return isinstance(value, float) and not math.isfinite(value)


def _format(value: TableCell) -> str:
    if value is None:
        return "-"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


# The units of a hunt's arguments, for the axes of plots.


def argument_units(directory: Path, settings: HuntSettings) -> dict[tuple[str, str], str]:
    """Return the known units of arguments. The keys are (agent, or empty for the scenario; name of the argument).

    The units come from the snapshot's scenario and from the signatures of crashhunt's agents. No code of a bundle runs.
    """
    try:
        found = latest_snapshot(directory)
        scenario = found.scenario() if found is not None else None
    except CrashhuntError:  # a page without units is better than none
        scenario = None
    units = {} if scenario is None else {("", name): setup.unit for name, setup in scenario.arguments.items()}
    for agent, chosen in settings.agents.items():
        if chosen.agent.startswith("crashhunt.agents:"):
            # Another version of crashhunt may have an agent that this one does not have.
            with suppress(CrashhuntError):
                arguments = signature_of(locate("agents", chosen.agent)).arguments
                units |= {(agent, name): argument.unit for name, argument in arguments.items()}
        setup = scenario.agents.get(agent) if scenario is not None else None
        if setup is not None and setup.agent == chosen.agent:
            units |= {(agent, name): known.unit for name, known in setup.arguments.items() if known.unit}
    # "vehicles (vehicles)" says nothing.
    return {(agent, name): unit for (agent, name), unit in units.items() if unit and unit != name}
