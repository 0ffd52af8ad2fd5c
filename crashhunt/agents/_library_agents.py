"""Agents that are shared libraries: ``lib:FILE.so``, with the C interface that ``crashhunt_agent.h`` defines."""

from __future__ import annotations

import ctypes
import json
import math
import os
import time
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from crashhunt.agents._programs import _signature_in, write_road_map
from crashhunt.agents._protocol import ForeignFactory, shown_space
from crashhunt.base.agent_locators import describe_library, library_file, load_order
from crashhunt.base.errors import CrashhuntError, PluginError, ProgramError
from crashhunt.base.foreign_code import supports
from crashhunt.base.library_probe import declaration_of, loaded_files, missing_symbols
from crashhunt.base.text import one_line
from crashhunt.simulators import ObservesParts

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
    from pathlib import Path

    from gymnasium import Space
    from numpy.typing import NDArray

    from crashhunt.simulators import Simulator
    from crashhunt.trial import CallSignature, Value

    Getter = Callable[[Any], object]  # returns a part of an observation

_MAX_SHOWN_CHARACTERS: Final = 300
_GUARD_VALUES: Final = 4  # after an action; a library that writes more numbers than the action has changes them
_GUARD: Final = [-1.2345e300] * _GUARD_VALUES


class _Argument(ctypes.Structure):
    _fields_ = (("name", ctypes.c_char_p), ("text", ctypes.c_char_p), ("number", ctypes.c_double))


class _Array(ctypes.Structure):
    _fields_ = (
        ("name", ctypes.c_char_p),
        ("dimensions", ctypes.c_int64),
        ("shape", ctypes.POINTER(ctypes.c_int64)),
        ("size", ctypes.c_int64),
        ("column_count", ctypes.c_int64),
        ("columns", ctypes.POINTER(ctypes.c_char_p)),
        ("values", ctypes.c_void_p),
        ("bytes", ctypes.c_void_p),
    )


class _Setup(ctypes.Structure):
    _fields_ = (
        ("agent", ctypes.c_char_p),
        ("step_length_s", ctypes.c_double),
        ("argument_count", ctypes.c_int64),
        ("arguments", ctypes.POINTER(_Argument)),
        ("part_count", ctypes.c_int64),
        ("parts", ctypes.POINTER(_Array)),
        ("action", ctypes.POINTER(_Array)),
        ("map", ctypes.c_char_p),
    )


class _Observation(ctypes.Structure):
    _fields_ = (
        ("step", ctypes.c_int64),
        ("time_s", ctypes.c_double),
        ("part_count", ctypes.c_int64),
        ("parts", ctypes.POINTER(_Array)),
    )


class LibraryFactory(ForeignFactory):
    """Creates the agents of one ``lib:`` locator.

    Attributes:
        reads_map: whether the library, which has been loaded, asks for the road map.
    """

    def __init__(self, locator: str) -> None:
        self._locator = locator
        self.reads_map = False
        self._library: ctypes.CDLL | None = None
        self._defaults: dict[str, Value] = {}

    def declared_signature(
        self, agent: str = "", simulator: Simulator | None = None, *, limit_s: float = 0.0
    ) -> CallSignature:
        """Return the arguments that the library declares for every vehicle; another process loads it for this."""
        return self._signature(describe_library(self._locator, library_file(self._locator)).declaration)

    def load(self, files: Mapping[str, str], scratch: Path) -> None:
        """Load the library into this process, unless it is loaded.

        Args:
            files: file of the snapshot by the text that names the original file; empty if there is no snapshot.
            scratch: not used, because a library is loaded from where it lies.

        Raises:
            CrashhuntError: the library cannot be used, or needs another library that is not loaded from the snapshot.
        """
        if self._library is not None:
            return
        try:
            # A library that is loaded already is not searched for, so those of the snapshot come first.
            library = [ctypes.CDLL(str(path)) for path in load_order(self._locator, files)][-1]
        except OSError as error:
            raise PluginError(
                f"{self._locator!r}: it cannot be loaded: {one_line(str(error))}", fix="install what is missing"
            ) from None
        if missing := missing_symbols(library):
            raise PluginError(f"{self._locator!r}: it does not export {', '.join(missing)}")
        _check_origins(self._locator, files)
        arguments = self._signature(declaration_of(library)).arguments
        self._defaults = {name: one.default for name, one in arguments.items() if one.default is not None}
        library.crashhunt_create.argtypes = [ctypes.c_void_p, ctypes.c_void_p]
        library.crashhunt_reset.argtypes = [ctypes.c_void_p, ctypes.c_uint64]
        library.crashhunt_act.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p]
        library.crashhunt_destroy.argtypes = [ctypes.c_void_p]
        for function in (library.crashhunt_create, library.crashhunt_reset, library.crashhunt_act):
            function.restype = ctypes.c_char_p
        library.crashhunt_destroy.restype = None
        self._library = library

    def agent(
        self, name: str, simulator: Simulator, arguments: Mapping[str, Value], *, folder: Path,
        files: Mapping[str, str], limit_s: float | None = None, is_forked: bool = False,
    ) -> LibraryAgent:  # fmt: skip
        """Return the agent of a vehicle. The limit holds for each call of ``crashhunt_act``.

        A fork of the process contains the agent, so it does not matter whether there are forks.
        """
        self.load(files, folder)
        assert self._library is not None
        form = simulator.actions[name]
        return LibraryAgent(
            self._library, name=name, parts=ObservationArrays.of(simulator, name),
            action=ActionArray(form.space, form.names), step_length_s=simulator.step_length_s,
            arguments={**self._defaults, **arguments}, limit_s=limit_s,
            road_map=write_road_map(folder, simulator, name) if self.reads_map else None,
        )  # fmt: skip

    def _signature(self, declaration: str) -> CallSignature:
        try:
            ready = json.loads(declaration)
            # The macro for an argument ends with a comma, and an argument without a range has an empty text.
            declared = {name: facts for name, facts in ready["arguments"].items() if name}
            observed, action = str(declared.pop("<observation>", "")), str(declared.pop("<action>", ""))
            self.reads_map = bool(declared.pop("<map>", False))
            ready["arguments"] = {
                name: {key: value for key, value in facts.items() if value != ""} for name, facts in declared.items()
            }
        except (ValueError, TypeError, KeyError, AttributeError):
            fix = 'write CRASHHUNT_AGENT(CRASHHUNT_ARGUMENT("speed", "5.0:25.0", "m/s", 12.0))'
            text = one_line(declaration)[:_MAX_SHOWN_CHARACTERS]
            raise PluginError(f"{self._locator!r}: its declaration is not JSON: {text}", fix=fix) from None
        try:
            return _signature_in({**ready, "observation": [*filter(None, observed.split(","))], "action": action})
        except ProgramError as error:
            fix = error.fix or "correct its CRASHHUNT_AGENT(...)"
            raise PluginError(f"{self._locator!r}: {error.message}", fix=fix) from None


def _check_origins(locator: str, files: Mapping[str, str]) -> None:
    """Check that the originals of the libraries in the snapshot were not loaded.

    Raises:
        CrashhuntError: the loader has found the original.
    """
    saved = {os.path.realpath(name.partition(":")[2]) for name in files if name.startswith("lib:")}
    for path in loaded_files() if saved else ():
        if os.path.realpath(path) in saved:
            name = os.path.basename(path)  # noqa: PTH119 - of a text
            raise CrashhuntError(
                f"{locator!r} needs {path}, which was not loaded from the snapshot, because it has no name of its own",
                fix=f"link {name} with -Wl,-soname,{name}",
            )


class LibraryAgent:
    """An agent whose actions a shared library computes.

    The library creates the agent in the first step. Therefore a failure is an error of the agent, with a recorded
    trial, as in any other step.

    Args:
        library: the loaded library.
        name: identifier of the vehicle.
        parts: the arrays of an observation.
        action: the array of an action.
        step_length_s: time from one step to the next, in s.
        arguments: arguments of the agent.
        limit_s: time limit for each call of ``crashhunt_act``, in s; None if only that of the trial applies. A call
            cannot be interrupted, so a call that never returns is a hang of the trial.
        road_map: path of the road map; None if the library does not ask for it, or there is none.
    """

    def __init__(
        self, library: ctypes.CDLL, *, name: str, parts: ObservationArrays, action: ActionArray, step_length_s: float,
        arguments: Mapping[str, Value], limit_s: float | None = None, road_map: str | None = None,
    ) -> None:  # fmt: skip
        self._limit_s = limit_s
        self._library, self._name, self._parts, self._action = library, name, parts, action
        self._step_length_s = step_length_s
        self._seed = self._step = 0
        self._is_created = False
        self._handle = ctypes.c_void_p()
        self._arguments = (_Argument * len(arguments))(*[_argument(*pair) for pair in arguments.items()])
        described = [part.described(with_data=False) for part in parts.leaves]
        self._setup = _Setup(
            name.encode(), step_length_s, len(arguments), self._arguments, len(described),
            (_Array * len(described))(*described), ctypes.pointer(action.described),
            None if road_map is None else os.fsencode(road_map),
        )  # fmt: skip
        filled = [part.described(with_data=True) for part in parts.leaves]
        self._seen = _Observation(0, 0.0, len(filled), (_Array * len(filled))(*filled))
        # What does not change from step to step, as `crashhunt_act` receives it.
        self._call = library.crashhunt_act
        self._seen_at, self._action_at = ctypes.addressof(self._seen), action.address
        self._write, self._clear, self._read = parts.write, action.clear, action.read

    def reset(self, seed: int) -> None:
        """Begin an episode; the library receives the seed in the first step."""
        self._seed, self._step = int(seed), 0

    def act(self, observation: object) -> object:
        """Return the action that the library computes for an observation.

        Raises:
            ProgramError: the library reports a failure, or has written more numbers than an action has.
        """
        step = self._step
        if step == 0:
            self._begin()
        seen = self._seen
        seen.step = step
        seen.time_s = step * self._step_length_s
        self._write(observation)
        self._clear()
        why = (
            self._call(self._handle, self._seen_at, self._action_at)
            if self._limit_s is None
            else self._call_within(self._limit_s)
        )
        if why is not None:
            raise self._error(f"crashhunt_act failed in step {step + 1}", why)
        self._step = step + 1
        action = self._read()
        if action is None:
            count = self._action.described.size
            raise ProgramError(
                f"{self._name}: crashhunt_act has written more than the {count} {'value' if count == 1 else 'values'} "
                f"of an action in step {step + 1}",
                fix="write as many values as setup->action->size says",
            )
        return action

    def _call_within(self, limit_s: float) -> bytes | None:
        """Call ``crashhunt_act``; a call that takes longer than a limit is an error."""
        latest = time.monotonic() + limit_s
        why: bytes | None = self._call(self._handle, self._seen_at, self._action_at)
        if time.monotonic() > latest:
            message = f"crashhunt_act has not returned within {limit_s:g} s in step {self._step + 1}"
            raise ProgramError(f"{self._name}: {message}")
        return why

    def close(self) -> None:
        """Have the library release the agent."""
        if self._is_created:
            self._is_created = False
            self._library.crashhunt_destroy(self._handle)

    def _begin(self) -> None:
        """Have the library create the agent, unless it has, and begin the episode."""
        if not self._is_created:
            why = self._library.crashhunt_create(ctypes.addressof(self._setup), ctypes.addressof(self._handle))
            if why is not None:
                raise self._error("crashhunt_create failed", why)
            self._is_created = True
        why = self._library.crashhunt_reset(self._handle, self._seed)
        if why is not None:
            raise self._error("crashhunt_reset failed", why)

    def _error(self, place: str, why: bytes) -> ProgramError:
        text = one_line(why.decode("utf-8", "replace"))[:_MAX_SHOWN_CHARACTERS]
        return ProgramError(f"{self._name}: {place}: {text or '(no reason given)'}")


def _argument(name: str, value: Value) -> _Argument:
    if isinstance(value, str):
        return _Argument(name.encode(), value.encode(), math.nan)
    return _Argument(name.encode(), None, float(value))


class _Leaf:
    """An array of an observation, with a copy of its values at a fixed address."""

    def __init__(self, name: str, space: Space[object], columns: Collection[str], get: Getter) -> None:
        self.name, self.get = name, get
        self.shape = tuple(space.shape or ())
        self.columns = tuple(columns) if self.shape and len(columns) == self.shape[-1] else ()
        is_bytes = space.dtype == np.uint8 and len(self.shape) > 0
        self.values: NDArray[np.generic] = np.zeros(self.shape, np.uint8 if is_bytes else np.float64)

    def described(self, *, with_data: bool) -> _Array:
        """Return the C structure of the array."""
        data = self.values.ctypes.data if with_data else None
        is_bytes = self.values.dtype == np.uint8
        return _described(self.name, self.shape, self.columns, None if is_bytes else data, data if is_bytes else None)


class ObservationArrays:
    """The arrays of an observation.

    Args:
        space: the observation space.
        columns: the names of the columns of each part.
        top: the name of an observation that is one array.

    Raises:
        PluginError: the space has parts that are no arrays of a fixed shape.
    """

    def __init__(self, space: Space[object], columns: Mapping[str, Collection[str]], top: str) -> None:
        found = [(name or top, one, get) for name, one, get in _leaves(space)]
        self.leaves = [_Leaf(name, one, columns.get(name, ()), get) for name, one, get in found]
        is_single = len(self.leaves) == 1 and self.leaves[0].name == top
        self._single = self.leaves[0].values if is_single else None

    @classmethod
    def of(cls, simulator: Simulator, agent: str) -> ObservationArrays:
        """Return the arrays of the observations of a vehicle.

        Raises:
            PluginError: the observations have parts that are no arrays of a fixed shape.
        """
        layouts = simulator.observation_layouts if supports(simulator, ObservesParts) else {}
        if agent in layouts:
            return cls(layouts[agent].space, layouts[agent].columns, "")
        space, names = shown_space(simulator, agent)
        return cls(space, {"kinematics": names}, "kinematics" if names else "observation")

    def write(self, observation: object) -> None:
        """Copy an observation to the addresses that the library reads."""
        if self._single is not None:
            self._single[...] = observation  # type: ignore[assignment]  # in a third of the time of `np.copyto`
            return
        for leaf in self.leaves:
            leaf.values[...] = leaf.get(observation)  # type: ignore[assignment]


def _leaves(space: Space[object]) -> Iterator[tuple[str, Space[object], Getter]]:
    """Yield the path, the space and the getter of each array in a space."""
    from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete, Tuple

    if isinstance(space, Dict | Tuple):
        inner = space.spaces.items() if isinstance(space, Dict) else enumerate(space.spaces)
        for key, part in inner:
            for name, one, get in _leaves(part):
                yield f"{key}/{name}" if name else str(key), one, _chained(key, get)
    elif isinstance(space, Box | Discrete | MultiBinary | MultiDiscrete):
        yield "", space, _whole
    else:
        fix = "use another observation, or an agent in Python"
        raise PluginError(f"a library cannot receive observations of the space {one_line(str(space))}", fix=fix)


def _whole(observation: object) -> object:
    return observation


def _chained(key: object, get: Getter) -> Getter:
    return lambda observation: get(observation[key])


class ActionArray:
    """The array of an action at a fixed address, followed by values that the library must not change.

    Args:
        space: the action space.
        names: the names of the values; empty if they have none.

    Raises:
        PluginError: the space does not consist of a fixed number of values.
    """

    def __init__(self, space: Space[object], names: Sequence[str]) -> None:
        from gymnasium.spaces import Box, Discrete, MultiBinary, MultiDiscrete, Tuple

        parts = space.spaces if isinstance(space, Tuple) else [space]
        is_known = isinstance(space, Box | Discrete | MultiBinary | MultiDiscrete)
        if not is_known and not (isinstance(space, Tuple) and all(part.shape == () for part in parts)):
            fix = "use another action, or an agent in Python"
            raise PluginError(f"a library cannot return actions of the space {one_line(str(space))}", fix=fix)
        self._is_tuple = isinstance(space, Tuple)
        shape = (len(parts),) if self._is_tuple else tuple(space.shape or ())
        self._is_whole = [np.dtype(part.dtype).kind in "iub" for part in parts]
        self._whole_places = [place for place, is_whole in enumerate(self._is_whole) if is_whole]
        self._size = math.prod(shape)
        self._all = np.zeros(self._size + _GUARD_VALUES)
        self._all[self._size :] = _GUARD
        self.values = self._all[: self._size]
        self._shaped = self.values.reshape(shape)
        self.values.fill(math.nan)
        self._raw, self._unwritten = self._all.data.cast("B"), self._all.tobytes()
        columns = tuple(names) if shape and len(names) == shape[-1] else ()
        self.address: int = self._all.ctypes.data
        self.described = _described("action", shape, columns, None, None)

    def clear(self) -> None:
        """Make each value NaN, which is refused, so that a value that the library does not write has no effect."""
        self._raw[:] = self._unwritten  # in half the time of `ndarray.fill`

    def read(self) -> object:
        """Return the action; None if the library has written more values."""
        values = self._all.tolist()
        if values[self._size :] != _GUARD:
            return None
        if self._is_tuple:
            del values[self._size :]
            for place in self._whole_places:
                if (value := values[place]).is_integer():  # another number is left to the check of all agents
                    values[place] = int(value)
            return tuple(values)
        if not self._shaped.shape:
            return _whole_number(values[0]) if self._is_whole[0] else values[0]
        action = self._shaped.copy()
        if self._is_whole[0] and bool(np.all(action == np.rint(action))) and bool(np.all(np.abs(action) < 2**53)):
            return action.astype(np.int64)
        return action


def _whole_number(value: float) -> float:
    """Return a whole number as an integer; another number unchanged, which the check of all agents refuses."""
    return int(value) if value.is_integer() else value


def _described(
    name: str, shape: tuple[int, ...], columns: tuple[str, ...], values: int | None, in_bytes: int | None
) -> _Array:
    lengths = (ctypes.c_int64 * len(shape))(*shape)
    texts = (ctypes.c_char_p * len(columns))(*[column.encode() for column in columns])
    return _Array(name.encode(), len(shape), lengths, math.prod(shape), len(columns), texts, values, in_bytes)
