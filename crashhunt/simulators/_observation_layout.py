"""The parts that an agent asks for, and the observation that they form: its arrays, columns and space."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from crashhunt.base.errors import UsageError
from crashhunt.base.text import one_of
from crashhunt.scenario import refuse_repeated_settings
from crashhunt.simulators._observation_parts import (
    HISTORY,
    KINEMATICS,
    MODIFIERS,
    OCCLUSION,
    PARTS,
    REFERENCE_POINT,
    REFERENCE_SHARES,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    import numpy as np
    from gymnasium import spaces
    from numpy.typing import NDArray

    from crashhunt.base.program_message_types import SpaceDescription
    from crashhunt.scenario import AgentSetup
    from crashhunt.simulators._observation_parts import Part


_MAX_SIZE = 10**7  # of numbers of an observation, which is in the recording of each step


@dataclass(frozen=True, slots=True)
class RequestedPart:
    """A part with the values of its settings."""

    part: Part
    settings: Mapping[str, float]

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape of the array."""
        axes = [axis if isinstance(axis, int) else int(self.settings[axis]) for axis in self.part.axes]
        return (*axes, len(self.part.columns)) if self.part.columns else tuple(axes)

    @property
    def space(self) -> spaces.Box:
        """The Gymnasium space of the array."""
        import numpy as np
        from gymnasium import spaces

        part = self.part
        columns = part.values_of_last_axis
        low, high = (np.array([column[side] for column in columns]) for side in (2, 3))
        dtype = np.dtype(part.dtype)
        return spaces.Box(
            np.broadcast_to(low, self.shape).astype(dtype), np.broadcast_to(high, self.shape).astype(dtype), dtype=dtype
        )


def parse_parts(words: Iterable[str], available: Iterable[str] = PARTS, *, where: str) -> tuple[RequestedPart, ...]:
    """Return the parts that an agent observes; none for the default observation.

    Args:
        words: One word per part: its name, and its settings as ``:NAME=VALUE``, such as ``actors:rows=8:radius=50``;
            or only `KINEMATICS`. The words of `MODIFIERS`, such as ``history=4``, are checked, but not returned.
        available: Names of the parts that the simulator has.
        where: The option or key that contains the words, for messages.

    Raises:
        UsageError: A part or a setting does not exist, or a value is out of range.
    """
    known, found, given_words = tuple(available), dict[str, RequestedPart](), [str(word) for word in words]
    modifiers = tuple(MODIFIERS) if known else ()
    if KINEMATICS in given_words and known:
        if len(given_words) > 1:
            fix = f"name {KINEMATICS} alone, or only parts"
            raise UsageError(f"{where} names {KINEMATICS} and parts: {','.join(given_words)}", fix=fix)
        return ()
    for word in given_words:
        name, given = _split(word)
        if name not in known and name not in modifiers:
            fix = (
                one_of(name, (*known, *modifiers, KINEMATICS))
                if known
                else "omit it, because agents observe what it returns"
            )
            message = f"{where}: {name!r} is not a part of observations"
            if name in PARTS or not known:
                message = f"{where}: the simulator of this scenario has no part {name!r}"
            raise UsageError(message, fix=fix)
        if name in found:
            raise UsageError(f"{where} names the part {name!r} twice", fix="name each part once")
        part = PARTS[name] if name in PARTS else MODIFIERS[name]
        settings = {setting.name: setting.default for setting in part.settings}
        refuse_repeated_settings(name, given, where)
        for text in given:
            setting, value = _parse_setting(part, text, where)
            settings[setting] = value
            requires = next(one.requires for one in part.settings if one.name == setting)
            if value and requires and requires not in known:
                message = f"{where}: the simulator of this scenario does not have {word!r}"
                raise UsageError(message, fix=f"leave {setting} out")
        if settings.get("relation"):
            part = replace(part, columns=part.columns + part.relation)
        found[name] = RequestedPart(part, settings)
    parts = tuple(one for one in found.values() if one.part.name not in MODIFIERS)
    if found and not parts:
        raise UsageError(f"{where} names {next(iter(found))} and no part", fix="name at least one part as well")
    history = found[HISTORY.name].settings["steps"] if HISTORY.name in found else 1
    size = int(history * sum(math.prod(one.shape) for one in parts))
    if size > _MAX_SIZE:
        fix = f"give smaller parts or a shorter history, with at most {_MAX_SIZE:,} numbers"
        raise UsageError(f"{where}: an observation has {size:,} numbers", fix=fix)
    return parts


def _split(word: str) -> tuple[str, list[str]]:
    """Return the name of a word and its settings; ``history=4`` is short for ``history:steps=4``."""
    name, *given = word.split(":")
    short, has_value, value = name.partition("=")
    if has_value and short in MODIFIERS:
        return short, [f"{MODIFIERS[short].settings[0].name}={value}", *given]
    return name, given


def modifiers_of(words: Iterable[str]) -> dict[str, float]:
    """Return the value of each word of `MODIFIERS` that checked words contain, by name."""
    found = {}
    for word in words:
        name, given = _split(word)
        if name in MODIFIERS:
            part = MODIFIERS[name]
            found[name] = _parse_setting(part, given[-1], "")[1] if given else part.settings[0].default
    return found


def _parse_setting(part: Part, text: str, where: str) -> tuple[str, float]:
    """Return the name and the value of a setting.

    Raises:
        UsageError: The setting does not exist, or its value is out of range.
    """
    name, _, digits = text.partition("=")
    known = {setting.name: setting for setting in part.settings}
    if name not in known:
        fix = one_of(name, known, give="it has", none="no settings")
        raise UsageError(f"{where}: {part.name} has no setting {name!r}", fix=fix)
    setting = known[name]
    try:
        if setting.choices:
            value = float(setting.choices.index(digits))
        else:
            value = float(int(digits) if setting.is_whole else float(digits))
    except ValueError:
        value = math.nan
    if not setting.low <= value <= setting.high:
        raise UsageError(f"{where}: {part.name}:{name} is {digits!r}", fix=f"give {setting.allowed}")
    return name, value


class ObservationLayout:
    """The layout of an agent's observation: its parts, and their places in the recorded array.

    The recorded array is one-dimensional: the parts in the order of their names, each row by row.

    Args:
        parts: The parts that the agent observes.
        modifiers: The values of words of `MODIFIERS`, by name.

    Attributes:
        history: Number of observations that are stacked; 0 if none are.
        occlusion_rays: Number of rays that decide which actors are seen; 0 if no actor hides others.
        reference_share: How far the reference point is ahead of the centre, as a share of a vehicle's length.
        parts: The parts by name, in the order of the recorded array.
        reach_m: Largest distance at which a part shows actors.
        columns: The index of every column, by part and name of the column.
        shapes: The shape of every part, including the axis of the history.
        space: The space of the agent's observation.
        flat_space: The space of the recorded array.
    """

    def __init__(self, parts: Sequence[RequestedPart], modifiers: Mapping[str, float] = MappingProxyType({})) -> None:
        import numpy as np
        from gymnasium import spaces

        history = int(modifiers.get(HISTORY.name, 0))
        self.occlusion_rays = int(modifiers.get(OCCLUSION.name, 0))
        point = REFERENCE_POINT.settings[0].choices[int(modifiers.get(REFERENCE_POINT.name, 0))]
        self.reference_share = REFERENCE_SHARES[point]

        self.reach_m = max((one.settings.get(name, 0.0) for one in parts for name in ("radius", "range")), default=0.0)
        self.parts = {one.part.name: one for one in sorted(parts, key=lambda one: one.part.name)}
        self.columns: dict[str, dict[str, int]] = {
            name: {column.name: index for index, column in enumerate(one.part.columns)}
            for name, one in self.parts.items()
        }
        self.history = history
        self._boxes = {name: _stacked(one.space, history) for name, one in self.parts.items()}
        self.shapes = {name: box.shape for name, box in self._boxes.items()}
        self.space = spaces.Dict(dict(self._boxes))
        flat = spaces.flatten_space(self.space)
        assert isinstance(flat, spaces.Box)
        self.flat_space = flat
        self._dtype = flat.dtype
        self._places: list[tuple[str, slice, tuple[int, ...], np.dtype[np.generic]]] = []
        begin = 0
        for name, one in self.parts.items():
            shape = self._boxes[name].shape
            end = begin + math.prod(shape)
            self._places.append((name, slice(begin, end), shape, np.dtype(one.part.dtype)))
            begin = end

    @property
    def begins(self) -> dict[str, int]:
        """The index of the first value of every part in the recorded array."""
        return {name: place.start for name, place, *_ in self._places}

    @property
    def record(self) -> np.dtype[np.void] | None:
        """The recorded array as one value with a field per part; None if a part has another type of numbers."""
        import numpy as np

        is_one_type = all(dtype == self._dtype for *_, dtype in self._places)
        return np.dtype([(name, dtype, shape) for name, _, shape, dtype in self._places]) if is_one_type else None

    def flat(self, arrays: Mapping[str, NDArray[np.generic]]) -> NDArray[np.generic]:
        """Return the recorded array of an observation."""
        import numpy as np

        found = np.concatenate([arrays[name].ravel() for name in self.parts]).astype(self._dtype, copy=False)
        found.flags.writeable = False
        return found

    def blank(self) -> NDArray[np.generic]:
        """Return the recorded array of an agent that has left the simulation, which contains only zeros."""
        import numpy as np

        return np.zeros(self.flat_space.shape, self._dtype)

    def restore(self, array: NDArray[np.generic]) -> dict[str, NDArray[np.generic]]:
        """Return the observation that the agent receives, from its recorded array; whole numbers are read-only too."""
        found = {}
        for name, place, shape, dtype in self._places:
            found[name] = array[place].reshape(shape)
            if dtype is not array.dtype:
                found[name] = found[name].astype(dtype)
                found[name].flags.writeable = False
        return found

    def with_errors(
        self, array: NDArray[Any], factors: NDArray[np.float64], center: tuple[float, float]
    ) -> NDArray[Any]:
        """Return a recorded array whose measured values have errors.

        Args:
            array: The recorded array.
            factors: The factor of each value.
            center: The centre of the controlled vehicle, from which factors of positions are counted, in m.
        """
        import numpy as np

        found = array.copy()
        for name, place, shape, _ in self._places:
            part, values = self.parts[name].part, found[place].reshape(shape)
            wrong = factors[place].reshape(shape)
            box = self._boxes[name]
            if part.columns:
                is_empty = ~values.any(axis=-1)
                for column in part.measured:
                    index = self.columns[name][column]
                    origin = {"x": center[0], "y": center[1]}.get(column, 0.0)
                    changed = origin + (values[..., index] - origin) * wrong[..., index]
                    values[..., index] = np.where(is_empty, 0.0, changed)
            elif part.measured:
                values *= wrong
            np.clip(values, box.low, box.high, out=values)
        found.flags.writeable = False
        return found

    def with_earlier(self, array: NDArray[Any], other: NDArray[Any] | None, *, steps_before: int) -> NDArray[Any]:
        """Return a recorded array of a layout with a history, with the earlier observations of another array.

        Args:
            array: The recorded array.
            other: The other recorded array; None to repeat the last observation, as at the start of an episode.
            steps_before: How many steps the other array is before this one, 0 or 1.
        """
        found = array.copy()
        for _, place, shape, _ in self._places:
            stack, begin = found[place].reshape(shape), steps_before
            earlier = stack[-1:] if other is None else other[place].reshape(shape)[begin : len(stack) - 1 + begin]
            stack[:-1] = earlier
        found.flags.writeable = False
        return found

    def describe(self) -> dict[str, SpaceDescription]:
        """Return the shape, the columns and their units of every part as JSON-compatible data."""
        return {
            name: {
                "shape": list(self._boxes[name].shape),
                "columns": [column.name for column in one.part.columns],
                "units": [column.unit for column in one.part.values_of_last_axis],
            }
            for name, one in self.parts.items()
        }


def _stacked(box: spaces.Box, history: int) -> spaces.Box:
    """Return the space of several arrays of a space, stacked along a new first axis."""
    import numpy as np
    from gymnasium import spaces

    if not history:
        return box
    low, high = (np.repeat(bound[None], history, axis=0) for bound in (box.low, box.high))
    return spaces.Box(low, high, dtype=box.dtype.type)


class History:
    """The last observations of an agent in an episode, if its layout stacks them."""

    def __init__(self, layout: ObservationLayout) -> None:
        self._last: dict[str, deque[NDArray[Any]]] = {name: deque(maxlen=layout.history) for name in layout.parts}
        self._length = layout.history

    def add(self, arrays: Mapping[str, NDArray[Any]]) -> Mapping[str, NDArray[Any]]:
        """Add the present observation; return the observation that the agent receives."""
        if not self._length:
            return arrays
        import numpy as np

        for name, array in arrays.items():
            last = self._last[name]
            last.extend([array] * (1 if last else self._length))
        return {name: np.stack(last) for name, last in self._last.items()}


def layouts_of(setups: Mapping[str, AgentSetup], available: Iterable[str]) -> dict[str, ObservationLayout]:
    """Return the layout of the observation of each agent that observes parts.

    Raises:
        UsageError: A part or a setting does not exist, or a value is out of range.
    """
    known = tuple(available)
    parts = {
        agent: parse_parts(setup.observation or (), known, where=f"agents.{agent}.observation")
        for agent, setup in setups.items()
    }
    return {
        agent: ObservationLayout(found, modifiers_of(setups[agent].observation or ()))
        for agent, found in parts.items()
        if found
    }
