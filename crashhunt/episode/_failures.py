"""Failures of episodes: the origin of an exception, the reported evidence, and the end of the episode."""

from __future__ import annotations

import resource
import sys
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import chain, islice
from types import FunctionType, ModuleType
from typing import TYPE_CHECKING, Any, Final

from crashhunt.agents import Closes
from crashhunt.base.errors import (
    ActionError,
    EpisodeError,
    InvalidEpisodeError,
    ProgramError,
    RecorderError,
    SimulatorError,
    UnusableValueError,
)
from crashhunt.base.exceptions import class_name, format_error, is_users, message_of
from crashhunt.base.foreign_code import ForeignError, Party, supports
from crashhunt.base.resources import limit_behind
from crashhunt.base.signals import blocked_signals
from crashhunt.episode._blame import Blame, blame, internal_error, party_of_simulator
from crashhunt.scenario import SIMULATOR_PACKAGES, Scenario
from crashhunt.trial import BAD_ACTION, UNUSABLE_VALUE, Failure, Outcome, TrialResult

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
    from types import FrameType

    from crashhunt.agents import Agent
    from crashhunt.episode._observers import Observer
    from crashhunt.oracles import Oracle
    from crashhunt.simulators import Simulator
    from crashhunt.trial import TrialSpec
    from crashhunt.world import Scene


# The text of an exception. An agent's exception may be of any class and any size.

_MIN_RECURSION_LIMIT: Final = 1000
_PARTY_BY_ERROR: tuple[tuple[type[BaseException], str], ...] = (
    (ActionError, BAD_ACTION),
    (InvalidEpisodeError, "invalid"),
    (ProgramError, "program"),
    (UnusableValueError, UNUSABLE_VALUE),
    (SimulatorError, "simulator error"),
)


def failure_of(error: BaseException, agent: str, *, cause: str = "", party: str = "", place: str = "") -> Failure:
    """Return the evidence on an exception for the result of a trial.

    A long message or traceback is cut, and a note says so. ``cause`` is a clause that says why the exception was
    raised; empty if its message does. ``place`` is the purpose for which the failed code was called.
    """
    with blocked_signals(), _deep_enough():
        # crashhunt's own messages are complete, so they need no traceback.
        own = InvalidEpisodeError | ProgramError | UnusableValueError
        text = "" if issubclass(type(error), own) else format_error(error)
        words = message_of(error)
        # A class of a user's may have a metaclass of any kind, so nothing is looked up by it.
        kind = next((kind for one, kind in _PARTY_BY_ERROR if type(error) is one), None) or class_name(error)
    message = words if issubclass(type(error), EpisodeError) else " ".join(words.split())
    if limit := limit_behind(error):
        message = f"{message} ({limit})" if message else limit
    if not cause and is_emptied():
        cause = "the code has emptied sys.modules"
    return Failure(
        kind=kind,
        message=f"{cause}, upon which this fails: {message}" if cause else message,
        traceback=text,
        agent=agent,
        party=party,
        place=place,
    )


@contextmanager
def _deep_enough() -> Iterator[None]:
    """Return a context with Python's default recursion limit, which an agent may have changed."""
    limit = sys.getrecursionlimit()
    sys.setrecursionlimit(max(limit, _MIN_RECURSION_LIMIT))
    try:
        yield
    finally:
        with suppress(RecursionError):
            sys.setrecursionlimit(limit)


def is_emptied() -> bool:
    """Return whether imported modules have been removed from ``sys.modules``.

    No simulator removes modules. If an agent has removed them, the next import fails, for example an import inside
    NumPy.
    """
    return __name__ not in sys.modules


def restore_modules() -> None:
    """Restore ``sys.modules`` if it has been emptied, so that crashhunt and NumPy can import again.

    Modules that were imported again since then may be broken copies, such as a module ``sys`` without attributes.
    """
    if is_emptied() and _originals:
        sys.modules.update(_originals[0].modules)
        _originals[0].was_emptied = True


def close_agent(agent: Agent) -> None:
    """Close an agent; its exceptions are ignored because the episode is over."""
    try:
        if supports(agent, Closes):
            agent.close()
    except BaseException as error:
        with suppress(BaseException):
            sys.stderr.write(format_error(error))


# Which agent an exception comes from that was raised while the simulator, an oracle or crashhunt itself was running.
#
# Code of an agent runs at such times too: in a signal handler, a finalizer, a callback, or in place of a function that
# the agent has replaced.

_MAX_ATTRIBUTION_ATTEMPTS: Final = 3
_MAX_FRAMES: Final = 2_000  # of a traceback, from its outer end; the rest repeats
_MAX_CAUSES: Final = 8
_MAX_MODULES: Final = 2_000  # of a user's, that refer to each other
_MAX_HELD: Final = 200  # objects that a simulator or an agent consists of
_MAX_ATTRIBUTE_DEPTH: Final = 3
_WATCHED_MODULES: Final = frozenset({"builtins", "math", "random", "time"})  # of Python's own modules
_USED_FUNCTIONS: Final = frozenset(
    {"collections", "contextlib", "dataclasses", "functools", "hashlib", "io", "json", "json.decoder", "json.encoder",
     "logging", "mmap", "os", "pathlib", "re", "resource", "signal", "struct", "sys", "threading", "traceback"}
)  # fmt: skip
"""Modules of Python that crashhunt itself needs to record and to report; see `are_functions_replaced`."""
_LIMITS: Final = {
    "RLIMIT_AS": resource.RLIMIT_AS,
    "RLIMIT_DATA": resource.RLIMIT_DATA,
    "RLIMIT_NOFILE": resource.RLIMIT_NOFILE,
    "RLIMIT_FSIZE": resource.RLIMIT_FSIZE,
}


@dataclass(frozen=True, slots=True)
class Attribution:
    """The agent that caused an exception, and how."""

    agent: str  # identifier of the agent; empty if one of several agents caused the exception, but it is unknown which
    # the action by which the agent made another part fail, as a clause; empty if the agent's own code raised the
    # exception
    cause: str = ""


@dataclass(slots=True)
class _Originals:
    """The functions and limits of the process before any trial ran."""

    packages: frozenset[str]
    modules: dict[str, ModuleType]
    functions: dict[str, dict[str, object]]
    classes: dict[str, dict[type, dict[str, object]]]
    used: dict[str, dict[str, object]]
    recursion_limit: int
    limits: dict[str, int]
    was_emptied: bool = False


_originals: list[_Originals] = []


def record_originals() -> None:
    """Record the functions of simulators and their libraries, and the limits of this process.

    After a failure, a comparison shows which functions an agent has replaced. Call this function after all imports and
    before the first trial.
    """
    packages = _packages_of_simulators()
    functions: dict[str, dict[str, object]] = {}
    classes: dict[str, dict[type, dict[str, object]]] = {}
    for name, module in list(sys.modules.items()):
        if isinstance(module, ModuleType) and (name in _WATCHED_MODULES or name.partition(".")[0] in packages):
            functions[name], classes[name] = _contents_of(name, module)
    limits = {name: resource.getrlimit(number)[0] for name, number in _LIMITS.items()}
    _originals[:] = [
        _Originals(
            packages=packages,
            modules=dict(sys.modules),
            functions=functions,
            classes=classes,
            used={name: _contents_of(name, sys.modules[name])[0] for name in _USED_FUNCTIONS if name in sys.modules},
            recursion_limit=sys.getrecursionlimit(),
            limits=limits,
        )
    ]


def _contents_of(name: str, module: ModuleType) -> tuple[dict[str, object], dict[type, dict[str, object]]]:
    """Return the functions and classes of a module, and the functions of each class that it defines."""
    held = _callables(module)
    own = (value for value in held.values() if isinstance(value, type) and value.__module__ == name)
    return held, {kind: _callables(kind) for kind in own}


def _callables(thing: ModuleType | type) -> dict[str, object]:
    return {key: value for key, value in vars(thing).items() if callable(value)}


def are_functions_replaced() -> bool:
    """Return whether functions of crashhunt, or functions that it needs, have been replaced since `record_originals`.

    If so, a failure of crashhunt itself is not a defect of crashhunt. A library or a simulator may replace its own
    functions by other functions of its own, so only replacements from elsewhere count.
    """
    if is_emptied():
        return True
    if not _originals:
        return False
    before = _originals[0]
    if before.was_emptied:
        return True
    modules = chain(before.used.items(), before.functions.items())
    parts = chain(((sys.modules.get(name), held) for name, held in modules), _recorded_classes(before))
    return any(
        (now := getattr(part, "__dict__", {}).get(key)) is not value and _is_users_or_nothing(now)
        for part, held in parts
        for key, value in held.items()
    )


def _recorded_classes(originals: _Originals) -> Iterator[tuple[type, dict[str, object]]]:
    """Yield each recorded class with its recorded functions."""
    for classes in originals.classes.values():
        yield from classes.items()


def _is_users_or_nothing(value: object) -> bool:
    """Return whether the replacement of a function is not a function, or is a function of the user."""
    return not callable(value) or _is_users_module(_module_of_value(value))


def _packages_of_simulators() -> frozenset[str]:
    """Return the names of crashhunt and of the installed packages that its simulators use, including NumPy."""
    found = {"crashhunt"}
    for name, module in list(sys.modules.items()):
        if name.startswith(SIMULATOR_PACKAGES):
            found |= {_module_of_value(value).partition(".")[0] for value in vars(module).values()}
    return frozenset(found - sys.stdlib_module_names - {""})


def attribute_error(
    error: BaseException, agents: Mapping[str, object], simulator: object, observing: Sequence[object] = ()
) -> Attribution | None:
    """Return the agent that caused an exception; None if another part caused it, or if the cause is unknown.

    The exception is attributed to an agent if one of these conditions holds:

    - a function on its traceback, or on the traceback of its cause, is a method of the agent's class, or is defined in
      a module that only the agent uses. A module that environment, oracles or observers use as well does not count.
    - a function on the traceback has been replaced since `record_originals`.
    - memory, file handles or recursion depth ran out, and their limit was lowered since then.
    """
    for _ in range(_MAX_ATTRIBUTION_ATTEMPTS):
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
    """Return the agent whose code is the innermost on a stack; empty if several share it, None if none has."""
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
    """Yield the frames of an exception's traceback, the innermost first, and then the frames of its causes."""
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
    """Yield module and qualified name of the classes of an object and its parts, except crashhunt's classes."""
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
        if depth < _MAX_ATTRIBUTE_DEPTH:
            left += ((value, depth + 1) for value in _attributes(one).values() if _is_instance(value))


def _own_classes_of(agent: object) -> Iterator[tuple[str, str]]:
    """Yield module and qualified name of the classes of an agent, except classes of libraries that it only uses."""
    itself = vars(type(agent)).get("__module__")
    yield from (found for found in _classes_of(agent) if found[0] == itself or _is_users_module(found[0]))


def _attributes(thing: object) -> dict[str, object]:
    # Not by ``vars``, which calls what a user's class has made of ``__dict__``.
    with suppress(AttributeError, TypeError):
        found = object.__getattribute__(thing, "__dict__")
        return dict(islice(found.items(), _MAX_HELD)) if type(found) is dict else {}
    return {}


def _is_instance(value: object) -> bool:
    """Return whether a value is an instance of a class with attributes, not a function, class or module."""
    return not isinstance(value, type | FunctionType | ModuleType) and bool(_attributes(value))


def _with_helpers(modules: Iterable[str]) -> set[str]:
    """Return the given modules of a user, and all modules of the user to which they refer, directly or indirectly."""
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
    """Return the function on the given frames that an agent has replaced, as a clause; empty if there is none.

    Replacements by crashhunt, by the watched libraries, by environments and by oracles do not count.
    """
    if not _originals:
        return ""
    used = {name for frame in frames for name in frame.f_code.co_names}

    def is_foreign(value: object, original: object) -> bool:
        module = "" if value is None else _module_of_value(value)
        known = module in others or module in _WATCHED_MODULES or module.partition(".")[0] in _originals[0].packages
        return value is not original and (not known or module == "builtins")

    replaced: dict[str, str] = {}
    for module_name, held in _originals[0].functions.items():
        now = vars(sys.modules[module_name]) if module_name in sys.modules else {}
        replaced |= {one: f"{module_name}.{one}" for one in used & held.keys() if is_foreign(now.get(one), held[one])}
    for kind, held in _recorded_classes(_originals[0]):
        place, present = f"{kind.__module__}.{kind.__qualname__}", vars(kind)
        replaced |= {one: f"{place}.{one}" for one in used & held.keys() if is_foreign(present.get(one), held[one])}
    for frame in frames:  # the innermost function that refers to one is the one that failed
        for name in frame.f_code.co_names:
            if name in replaced:
                return f"{replaced[name]} has been replaced"
    return ""


def _lowered_limit(error: BaseException) -> str:
    """Return the limit whose lowering by an agent caused an exception, as a clause; empty if there is none."""
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


# The end of an episode with an error.


class Ending:
    """The part of an `Episode` that ends the episode."""

    spec: TrialSpec
    simulator: Simulator
    agents: dict[str, Agent]
    names: tuple[str, ...]
    steps: int
    result: TrialResult | None
    error: BaseException | None
    _on_end: list[Callable[[TrialResult], TrialResult]]
    _scene: Scene | None
    _look: Callable[[], Scene] | None
    _oracles: tuple[Oracle, ...]
    _observers: tuple[Observer, ...]

    def _fail(
        self,
        outcome: Outcome,
        error: BaseException,
        agent: str = "",
        cause: str = "",
        *,
        party: Party = Party.AGENT,
        place: str = "",
    ) -> TrialResult:
        """End the episode with an exception that foreign code raised, by default an agent's code."""
        self.error = error
        return self._end(outcome, failure=failure_of(error, agent, cause=cause, party=party, place=place))

    def _fail_in_simulator(self, error: BaseException, place: str = "step", *, is_set_up: bool = False) -> TrialResult:
        """End the episode with an exception that the simulator or an agent raised outside the agents' own methods.

        Before the first step (``is_set_up``), the trial is invalid.

        Raises:
            RecorderError: the disk is full.
            InternalError: the exception is crashhunt's own.
        """
        blamed, found = self._blame(error, place)
        if found is not None:
            outcome = Outcome.INVALID if is_set_up else Outcome.AGENT_ERROR
            return self._fail(outcome, blamed.error, found.agent, found.cause)
        if blamed.party is Party.CRASHHUNT and not blamed.is_resource:
            raise internal_error(error, self.spec.number, -1 if is_set_up else self.steps) from error
        party = party_of_simulator(self.simulator) if blamed.is_resource else blamed.party
        # Neither the agent nor the simulator has failed: the adapter cannot observe or control a vehicle any more.
        is_invalid = is_set_up or type(blamed.error) is InvalidEpisodeError
        outcome = Outcome.INVALID if is_invalid else Outcome.SIMULATOR_ERROR
        return self._fail(outcome, blamed.error, party=party, place=blamed.place)

    def _fail_in_conversion(self, error: BaseException, agent: str) -> TrialResult:
        """End the episode with an exception that was raised while an agent's action was encoded.

        Raises:
            RecorderError: the disk is full.
            InternalError: the exception is crashhunt's own.
        """
        # crashhunt raises no other than ordinary exceptions: the rest comes from methods of the agent's object.
        if type(error) is ActionError or not issubclass(type(error), Exception):
            return self._fail(Outcome.AGENT_ERROR, error, agent, place="action conversion")
        return self._break(error)

    def _blame(self, error: BaseException, place: str = "") -> tuple[Blame, Attribution | None]:
        """Return the owner of the code that raised an exception, and the agent if it is an agent's code.

        Raises:
            RecorderError: the disk is full.
        """
        blamed = blame(error, self.simulator, place)
        found = self._attribute(blamed.error)
        if found is None and type(blamed.error) is ActionError:  # a refused call, whose error the agent has hidden
            found = Attribution(self.names[0] if len(self.names) == 1 else "")
        if found is None and blamed.party is Party.AGENT:
            found = Attribution("")
        # A user's environment or oracle that raises it has not recorded anything.
        is_ours = type(error) is not ForeignError or blamed.party is Party.SIMULATOR
        if found is None and isinstance(blamed.error, RecorderError) and is_ours:
            raise blamed.error
        return blamed, found

    def end_by_agent(self, error: BaseException) -> TrialResult | None:
        """End the episode with an exception that an agent raised between two steps, as in a signal handler.

        Returns:
            The result; None if no agent caused the exception.
        """
        if self.result is not None:
            return self.result
        found = self._attribute(error)
        return None if found is None else self._fail(Outcome.AGENT_ERROR, error, found.agent, found.cause)

    def _attribute(self, error: BaseException) -> Attribution | None:
        """Return the agent that caused a failure; None if no agent is known to have caused it."""
        return attribute_error(error, self.agents, self.simulator, (*self._oracles, *self._observers))

    def _end(self, outcome: Outcome, **evidence: Any) -> TrialResult:
        """End the episode, and let all observers add their data to the result."""
        restore_modules()
        # A user's simulator that has failed may fail again. The last scene of crashhunt's own may not have been read.
        scene = self._scene if self._scene is None or self._look is not None else self.simulator.scene()
        time_s = 0.0 if scene is None else scene.time_s
        return self._add(TrialResult(self.spec, outcome, steps=self.steps, sim_time_s=time_s, **evidence))

    def _add(self, result: TrialResult) -> TrialResult:
        restore_modules()  # otherwise, an observer that fails would leave a result without its digest
        for tell in self._on_end:
            result = tell(result)
        self.result = result
        return result

    def _break(self, error: BaseException) -> TrialResult:
        """End an episode that cannot continue because an oracle, a conversion or crashhunt itself has failed.

        Raises:
            RecorderError: the disk is full.
            InternalError: the exception is crashhunt's own, and no agent is known to have caused it.
        """
        blamed, found = self._blame(error)
        if found is None and blamed.party is Party.CRASHHUNT and not blamed.is_resource:
            raise internal_error(error, self.spec.number, self.steps) from error
        self.error = blamed.error
        # Memory and files that run out in crashhunt's own code were used up by others, or closed.
        is_agents = found is not None or blamed.is_resource
        found = found or Attribution("")
        outcome = Outcome.AGENT_ERROR if is_agents else Outcome.SIMULATOR_ERROR
        party = "" if blamed.is_resource else Party.AGENT if is_agents else blamed.party
        place = "" if is_agents else blamed.place
        failure = failure_of(blamed.error, found.agent, cause=found.cause, party=party, place=place)
        self.result = TrialResult(self.spec, outcome, steps=self.steps, failure=failure)
        with suppress(BaseException):
            self._add(self.result)
        return self.result
