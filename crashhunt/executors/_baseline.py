"""How a worker is before its first trial, and whether it still is: a trial must not depend on those before it.

What a user's modules set when they are imported stays. What an *episode* changes there, in the simulator's classes, or
in Python itself would reach the next one. It is not mended here, but found: the worker that it happened to is not used
again. What cannot be seen, such as the state of a compiled library, is what ``--audit`` is for.
"""

from __future__ import annotations

import gc
import itertools
import os
import random
import resource
import signal
import sys
import sysconfig
import types
from collections import deque
from contextlib import suppress
from operator import is_
from typing import TYPE_CHECKING, Any

import numpy as np

from crashhunt.base.processes import children_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping
    from pathlib import Path

__all__ = ["OPEN_FILES", "Baseline"]

OPEN_FILES = "which files are open"

# What everybody uses, and somebody may patch.
_SHARED = (
    "builtins", "sys", "os", "posixpath", "io", "random", "json", "json.encoder", "json.decoder", "math", "time",
    "copy", "pickle", "struct", "collections", "itertools", "functools", "threading", "subprocess", "socket", "numpy",
    "numpy.random", "numpy.linalg", "gymnasium",
)  # fmt: skip
_IGNORED = frozenset({
    "__warningregistry__", "__builtins__", "_abc_impl", "__annotations__", "__weakref__", "__abstractmethods__",
    "last_exc", "last_type", "last_value", "last_traceback", "_",
})  # fmt: skip
_LIBRARY = tuple(os.path.join(sysconfig.get_path(name), "") for name in ("stdlib", "platstdlib"))  # noqa: PTH118
_MOST = 50_000  # values of a user's that are looked at
_DEEPEST = 6  # containers within containers; deeper ones are taken for unchanged
_LIMITS = (
    resource.RLIMIT_NOFILE,
    resource.RLIMIT_AS,
    resource.RLIMIT_CPU,
    resource.RLIMIT_STACK,
    resource.RLIMIT_FSIZE,
)
_SIGNALS = tuple(number for number in signal.Signals if number not in (signal.SIGKILL, signal.SIGSTOP))

# What has a state that does not lie in attributes.
_STATES: dict[type, Callable[[Any], object]] = {
    np.random.Generator: lambda generator: str(generator.bit_generator.state),
    np.random.RandomState: lambda generator: str(generator.get_state(legacy=False)),
    random.Random: lambda generator: generator.getstate(),
    itertools.count: repr,
    np.ndarray: lambda array: array.tobytes() if array.nbytes <= 1 << 16 and not array.dtype.hasobject else b"",
    bytearray: bytes,
    deque: tuple,
    set: frozenset,
}


class Baseline:
    """What a process was like when this was made, just before its first trial.

    Args:
        code: folders of the user's code.
        scratch: where files are the worker's own, and its simulator's.
        files: of the scenario. SUMO reads routes as it goes on, through links in the scratch folder.
        simulators: the packages of simulators in whose classes an episode may change something.
    """

    def __init__(
        self, code: tuple[str, ...], scratch: Path, files: Iterable[Path] = (), simulators: tuple[str, ...] = ()
    ) -> None:
        self._simulators = simulators
        # A folder, and not what begins like it.
        self._scratch = tuple(os.path.join(place, "") for place in (scratch, scratch.resolve()))  # noqa: PTH118
        self._read = {os.devnull, *(str(file.resolve()) for file in files)}  # and where nobody reads what is written
        self._code = tuple(os.path.join(folder, "") for folder in (*code, os.getcwd()))  # noqa: PTH109, PTH118
        self.children = frozenset(children_of(os.getpid()))
        self._modules: dict[str, types.ModuleType] = {}
        self._seen: dict[int, object] = {}
        self._tables: list[tuple[str, Any, dict[Any, Any]]] = []
        self._lists: list[tuple[str, list[Any], list[Any]]] = []
        self._states: list[tuple[str, Any, object, Callable[[Any], object]]] = []
        self._add_modules()
        self._process = self._look()
        self._files = _open_files()

    def begin(self) -> None:
        """Take note of the files that are open; a trial is about to begin."""
        self._files = _open_files()

    def change(self) -> str:
        """Return what is not as it was, in words; empty where everything is."""
        files = _open_files()
        for descriptor in files.keys() | self._files.keys() if files != self._files else ():
            one, other = self._files.get(descriptor, ""), files.get(descriptor, "")
            known = (one or other).startswith(self._scratch) or (one or other) in self._read
            if one != other and not known:
                return OPEN_FILES
        for aspect, now in self._look().items():
            if now != self._process[aspect]:
                return aspect
        for name, module in self._modules.items():
            if sys.modules.get(name) is not module:
                return f"sys.modules[{name!r}]"
        for label, table, was in self._tables:
            if len(table) != len(was) or not all(map(is_, table.values(), was.values())):
                changed = _difference(table, was)
                if changed is not None:
                    return f"{label}.{changed}"
        for label, items, before in self._lists:
            if len(items) != len(before) or not all(map(is_, items, before)):
                return label
        for label, value, before_state, state in self._states:
            if state(value) != before_state:
                return label
        if len(sys.modules) != len(self._modules):
            self._add_modules()  # what was first imported by this trial
        return ""

    def _look(self) -> dict[str, object]:
        """What belongs to the process itself."""
        return {
            "which threads run": set(sys._current_frames()),
            "os.environ": dict(os.environ),
            "sys.path": list(sys.path),
            "handlers of signals": [signal.getsignal(number) for number in _SIGNALS],
            "resource limits": [resource.getrlimit(limit) for limit in _LIMITS],
            "settings of the interpreter": (
                sys.getrecursionlimit(), gc.isenabled(), sys.gettrace(), sys.getprofile(), sys.getswitchinterval(),
            ),
            "settings of NumPy": np.geterr(),
        }  # fmt: skip

    def _add_modules(self) -> None:
        for name, module in list(sys.modules.items()):
            if name in self._modules:
                continue
            self._modules[name] = module
            if name in _SHARED:
                self._table(name, vars(module))
            elif name.partition(".")[0] in self._simulators:
                self._table(name, vars(module))
                for thing in list(vars(module).values()):
                    if isinstance(thing, type) and thing.__module__ == name:
                        self._table(f"{name}.{thing.__qualname__}", vars(thing))
            elif self._is_users(module):
                self._walk(name, module, 0)

    def _is_users(self, module: object) -> bool:
        # crashhunt itself is in the folders of code too, where it comes from a snapshot.
        if getattr(module, "__name__", "").partition(".")[0] == "crashhunt":
            return False
        file = getattr(module, "__file__", None)
        return (
            isinstance(file, str)
            and file.startswith(self._code)
            and "site-packages" not in file
            and not file.startswith(_LIBRARY)  # which a working directory such as / has below it as well
        )

    def _table(self, label: str, table: Mapping[Any, Any]) -> None:
        self._tables.append((label, table, dict(table)))

    def _walk(self, label: str, value: Any, depth: int) -> None:
        """Remember a value of a user's, and what it consists of."""
        if depth > _DEEPEST or len(self._seen) > _MOST or id(value) in self._seen:
            return
        kind = type(value)
        for probed, state in _STATES.items():
            if isinstance(value, probed):
                self._seen[id(value)] = value
                with suppress(Exception):
                    self._states.append((label, value, state(value), state))
                return
        if kind is list:
            self._lists.append((label, value, list(value)))
        elif kind is dict:
            self._table(label, value)
        elif isinstance(value, types.ModuleType):
            if not self._is_users(value):
                return
            self._table(label, vars(value))
        elif isinstance(value, type | types.FunctionType) or hasattr(value, "__dict__"):
            owner = value if isinstance(value, type | types.FunctionType) else kind
            if not self._is_users(sys.modules.get(getattr(owner, "__module__", None) or "")):
                return
            self._table(label, vars(value))
        elif kind is not tuple:
            return
        self._seen[id(value)] = value
        for name, part in _parts(value):
            self._walk(f"{label}.{name}", part, depth + 1)


def _parts(value: Any) -> Iterator[tuple[object, Any]]:
    if isinstance(value, list | tuple):
        yield from enumerate(value)
    elif isinstance(value, dict):
        yield from list(value.items())
    else:
        yield from list(vars(value).items())
    if isinstance(value, types.FunctionType):
        yield "__defaults__", value.__defaults__
        yield "__kwdefaults__", value.__kwdefaults__
    if isinstance(value, staticmethod | classmethod):
        yield "__func__", value.__func__


def _difference(now: Mapping[Any, Any], was: dict[Any, Any]) -> object | None:
    """The first name whose value is another; None where nothing is that matters."""
    for name in [*now, *(was.keys() - now.keys())]:
        before, after = was.get(name, was), now.get(name, was)
        # That a module was first imported shows in its package.
        if before is not after and name not in _IGNORED and not (before is was and isinstance(after, types.ModuleType)):
            return name  # type: ignore[no-any-return]
    was.clear()
    was.update(now)
    return None


def _open_files() -> dict[str, str]:
    found = {}
    with suppress(OSError):
        for descriptor in os.listdir("/proc/self/fd"):  # noqa: PTH208 - names are enough
            with suppress(OSError):  # the one that was listed by
                found[descriptor] = os.readlink(f"/proc/self/fd/{descriptor}")  # noqa: PTH115
    return found
