"""Which agent an exception comes from that was raised while the simulator, an oracle or crashhunt itself was running.

Code of an agent runs at such times too: in a signal handler, a finalizer, a callback, or in place of a function that
the agent has replaced.
"""

from __future__ import annotations

import resource
import sys
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from types import FunctionType, ModuleType
from typing import TYPE_CHECKING

from crashhunt.base.blame import is_users
from crashhunt.base.signals import blocked_signals
from crashhunt.episode._failures import is_emptied
from crashhunt.scenario import Scenario

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence
    from types import FrameType
    from typing import Final

__all__ = ["Attribution", "attribute_error", "record_originals"]

_TRIES: Final = 3
_MAX_FRAMES: Final = 2_000  # of a traceback, from its outer end; the rest repeats
_MAX_CAUSES: Final = 8
_MAX_MODULES: Final = 2_000  # of a user's, that refer to each other
_MAX_HELD: Final = 200  # objects that a simulator or an agent consists of
_DEPTH_OF_HELD: Final = 3
_WATCHED: Final = frozenset({"builtins", "math", "random", "time"})  # of Python's own modules
_LIMITS: Final = {
    "RLIMIT_AS": resource.RLIMIT_AS,
    "RLIMIT_DATA": resource.RLIMIT_DATA,
    "RLIMIT_NOFILE": resource.RLIMIT_NOFILE,
    "RLIMIT_FSIZE": resource.RLIMIT_FSIZE,
}


@dataclass(frozen=True, slots=True)
class Attribution:
    """An exception that comes from an agent.

    Args:
        agent: identifier of the agent; empty where it is one of several.
        cause: what an agent has done to make another part fail, as a clause; empty where its own code raised.
    """

    agent: str
    cause: str = ""


@dataclass(slots=True)
class _Originals:
    """What code of the process was like before a trial ran."""

    packages: frozenset[str]
    functions: dict[str, dict[str, object]]
    classes: dict[type, dict[str, object]]
    recursion_limit: int
    limits: dict[str, int]


_originals: list[_Originals] = []


def record_originals() -> None:
    """Record the functions of simulators and their libraries, and the limits of this process.

    What an agent replaces later is found by comparison, when something fails. Call it once all code is imported and
    before a trial runs.
    """
    packages = _packages_of_simulators()
    functions: dict[str, dict[str, object]] = {}
    classes: dict[type, dict[str, object]] = {}
    for name, module in list(sys.modules.items()):
        if not isinstance(module, ModuleType) or (name not in _WATCHED and name.partition(".")[0] not in packages):
            continue
        held = {key: value for key, value in vars(module).items() if callable(value)}
        functions[name] = held
        for value in held.values():
            if isinstance(value, type) and value.__module__ == name and value not in classes:
                classes[value] = {key: one for key, one in vars(value).items() if callable(one)}
    limits = {name: resource.getrlimit(number)[0] for name, number in _LIMITS.items()}
    _originals[:] = [_Originals(packages, functions, classes, sys.getrecursionlimit(), limits)]


def _packages_of_simulators() -> frozenset[str]:
    """Return crashhunt and the installed packages that its simulators use, among them NumPy."""
    found = {"crashhunt"}
    for name, module in list(sys.modules.items()):
        if name.startswith("crashhunt.simulators"):
            found |= {_module_of_value(value).partition(".")[0] for value in vars(module).values()}
    return frozenset(found - sys.stdlib_module_names - {""})


def attribute_error(
    error: BaseException, agents: Mapping[str, object], simulator: object, observing: Sequence[object] = ()
) -> Attribution | None:
    """Return which agent an exception comes from; None where it comes from another part, or that is not known.

    It is an agent's where

    - a function on its traceback, or on that of its cause, is a method of the agent's class, or defined in a module
      that only the agent uses. A module that environment, oracles or observers use as well counts as theirs.
    - a function that the traceback refers to has been replaced since `record_originals`.
    - memory, files or recursion ran out and their limit was lowered since then.

    Args:
        error: the exception, with its traceback.
        agents: by identifier; those made so far.
        simulator: the simulator.
        observing: oracles and observers of the episode.
    """
    for _ in range(_TRIES):
        try:
            with blocked_signals():
                return _attribute(error, agents, simulator, observing)
        except BaseException:  # an agent may have damaged what this uses, and its signal handlers may raise here too
            continue
    return None


def _attribute(
    error: BaseException, agents: Mapping[str, object], simulator: object, observing: Sequence[object]
) -> Attribution | None:
    if is_emptied():
        return Attribution("")
    others = {module for part in (simulator, *observing) for module, _ in _classes_of(part)}
    classes = {name: set(_own_classes_of(agent)) for name, agent in agents.items()}
    for value in _attributes(simulator).values():
        if isinstance(value, Scenario):
            others.update(value.modules())
            for name, setup in value.agents.items():
                module, colon, attribute = setup.agent.partition(":")
                classes.setdefault(name, set()).update([(module, attribute)] if colon else [])
    if not any(classes.values()):
        return None
    frames = list(_frames_of(error))
    others = _with_helpers(others)
    agent = _agent_on_stack(frames, agents, classes, others)
    if agent is not None:
        return Attribution(agent)
    suspects = [name for name, found in classes.items() if found]
    cause = _replaced_function(frames, others) or _lowered_limit(error)
    return Attribution(suspects[0] if len(suspects) == 1 else "", cause) if cause else None


def _agent_on_stack(
    frames: list[FrameType],
    agents: Mapping[str, object],
    classes: Mapping[str, set[tuple[str, str]]],
    others: set[str],
) -> str | None:
    """Return the agent whose code is the innermost on a stack; empty where several share it, None where none is."""
    own = {name: {module for module, _ in found} - others for name, found in classes.items()}
    helpers = {name: _with_helpers(found) - others for name, found in own.items()}
    for frame in frames:
        module, code = frame.f_globals.get("__name__"), frame.f_code
        if not isinstance(module, str):
            continue
        owners = [
            name
            for name, found in classes.items()
            if module in own[name]
            or (module in helpers[name] and is_users(code.co_filename))
            or any(module == place and code.co_qualname.startswith(f"{one}.") for place, one in found)
        ]
        if len(owners) > 1 and code.co_varnames:
            first = frame.f_locals.get(code.co_varnames[0])
            owners = [name for name in owners if agents.get(name) is first] or owners
        if owners:
            return owners[0] if len(owners) == 1 else ""
    return None


def _frames_of(error: BaseException) -> Iterator[FrameType]:
    """Yield the frames that an exception came through, the innermost first, and then those of its causes."""
    one: BaseException | None = error
    for _ in range(_MAX_CAUSES):
        if one is None:
            return
        frames: list[FrameType] = []
        link = one.__traceback__
        while link is not None and len(frames) < _MAX_FRAMES:
            frames.append(link.tb_frame)
            link = link.tb_next
        yield from reversed(frames)
        one = one.__cause__


def _classes_of(thing: object) -> Iterator[tuple[str, str]]:
    """Yield module and qualified name of the classes of an object and of what it consists of, but for crashhunt's."""
    left: list[tuple[object, int]] = [(thing, 0)]
    seen: set[int] = set()
    while left and len(seen) < _MAX_HELD:
        one, depth = left.pop(0)
        if id(one) in seen:
            continue
        seen.add(id(one))
        for base in type(one).__mro__[:-1]:
            module = base.__dict__.get("__module__")
            if isinstance(module, str) and module != "builtins" and not module.startswith("crashhunt."):
                yield module, base.__qualname__
        if depth < _DEPTH_OF_HELD:
            left += ((value, depth + 1) for value in _attributes(one).values() if _is_instance(value))


def _own_classes_of(agent: object) -> Iterator[tuple[str, str]]:
    """Yield module and qualified name of the classes of an agent, without those of libraries that it only uses."""
    itself = vars(type(agent)).get("__module__")
    yield from (found for found in _classes_of(agent) if found[0] == itself or _is_users_module(found[0]))


def _attributes(thing: object) -> dict[str, object]:
    # Not by ``vars``, which calls what a user's class has made of ``__dict__``.
    with suppress(AttributeError, TypeError):
        found = object.__getattribute__(thing, "__dict__")
        return dict(islice(found.items(), _MAX_HELD)) if type(found) is dict else {}
    return {}


def _is_instance(value: object) -> bool:
    """Whether a value is an object of a class with attributes of its own, not a function, class or module."""
    return not isinstance(value, type | FunctionType | ModuleType) and bool(_attributes(value))


def _with_helpers(modules: Iterable[str]) -> set[str]:
    """Return modules of a user's, and those of the user's that they refer to, directly or by others."""
    found: set[str] = set()
    left = list(modules)
    while left and len(found) < _MAX_MODULES:
        name = left.pop()
        module = sys.modules.get(name)
        if name in found or module is None:
            continue
        found.add(name)
        for value in list(vars(module).values()):
            other = _module_of_value(value)
            if other and other not in found and _is_users_module(other):
                left.append(other)
    return found


def _module_of_value(value: object) -> str:
    if type(value) is ModuleType:
        return str(vars(value).get("__name__", ""))
    if type(value) is FunctionType:
        return str(value.__module__ or "")
    if type(value) is type:
        return str(vars(value).get("__module__", ""))
    found = vars(type(value)).get("__module__")  # of types in C it is a descriptor
    return found if isinstance(found, str) else ""


def _is_users_module(name: str) -> bool:
    file = getattr(sys.modules.get(name), "__file__", None)
    return isinstance(file, str) and is_users(file)


def _replaced_function(frames: list[FrameType], others: set[str]) -> str:
    """Return what an agent has replaced of the functions that frames refer to, as a clause; empty for nothing.

    crashhunt itself, the libraries that are watched, environments and oracles replace functions by some of their own.
    """
    if not _originals:
        return ""
    used = {name for frame in frames for name in frame.f_code.co_names}

    def is_foreign(value: object, original: object) -> bool:
        module = "" if value is None else _module_of_value(value)
        known = module in others or module in _WATCHED or module.partition(".")[0] in _originals[0].packages
        return value is not original and (not known or module == "builtins")

    replaced: dict[str, str] = {}
    for module_name, held in _originals[0].functions.items():
        now = vars(sys.modules[module_name]) if module_name in sys.modules else {}
        replaced |= {one: f"{module_name}.{one}" for one in used & held.keys() if is_foreign(now.get(one), held[one])}
    for kind, held in _originals[0].classes.items():
        place, present = f"{kind.__module__}.{kind.__qualname__}", vars(kind)
        replaced |= {one: f"{place}.{one}" for one in used & held.keys() if is_foreign(present.get(one), held[one])}
    for frame in frames:  # the innermost function that refers to one is the one that failed
        for name in frame.f_code.co_names:
            if name in replaced:
                return f"{replaced[name]} has been replaced"
    return ""


def _lowered_limit(error: BaseException) -> str:
    """Return which limit an agent has lowered that an exception is due to, as a clause; empty for none."""
    if not _originals:
        return ""
    before = _originals[0]
    kind = type(error)
    if issubclass(kind, RecursionError) and sys.getrecursionlimit() < before.recursion_limit:
        return f"the recursion limit has been lowered to {sys.getrecursionlimit()}"
    if not issubclass(kind, MemoryError | OSError):
        return ""
    for name, limit in before.limits.items():
        now = resource.getrlimit(_LIMITS[name])[0]
        if now != limit and now != resource.RLIM_INFINITY and (limit == resource.RLIM_INFINITY or now < limit):
            return f"{name} has been lowered to {now}"
    return ""
