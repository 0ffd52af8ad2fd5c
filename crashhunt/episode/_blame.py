"""Finds the origin of an exception: the simulator, a user's environment or oracle, or crashhunt."""

from __future__ import annotations

import traceback
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from crashhunt.base import layout
from crashhunt.base.errors import CrashhuntError, InternalError
from crashhunt.base.exceptions import format_error, in_words, is_users
from crashhunt.base.foreign_code import (
    Boundary,
    ForeignError,
    Party,
    describe_value,
    is_ours,
    number_of,
    supports,
    truth_of,
)
from crashhunt.base.resources import limit_behind
from crashhunt.base.text import count_of
from crashhunt.oracles import Finding
from crashhunt.simulators import RunsForeignCode
from crashhunt.world import Scene

if TYPE_CHECKING:
    from types import TracebackType

    from numpy.typing import NDArray

    from crashhunt.simulators import Simulator

_RESOURCE_ERRORS: Final = (OSError, MemoryError)
_MAX_CAUSES: Final = 16
_MAX_FRAMES: Final = 2_000
_STEP_FIX: Final = "return one number or bool for each agent from step()"
_REPORT_FIX: Final = "report it with the output of the same command with CRASHHUNT_TRACEBACK=1: {}"
_ISSUES_URL: Final = "https://github.com/crashhunt/crashhunt/issues"


@dataclass(frozen=True, slots=True)
class Blame:
    """The origin of an exception."""

    error: BaseException  # the exception itself, without its wrapper
    party: Party  # the origin, as text: the owner of the code that raised the exception
    place: str = ""  # the purpose for which the failed code was called; empty if it is unknown
    # whether memory or file handles ran out in crashhunt's own code, so that the origin is unknown
    is_resource: bool = False


def party_of_simulator(simulator: Simulator) -> Party:
    """Return the owner of the code that a simulator runs: a user's environment or the simulator."""
    return simulator.party if supports(simulator, RunsForeignCode) else Party.SIMULATOR


def blame(error: BaseException, simulator: Simulator, place: str = "") -> Blame:
    """Return the owner of the code that raised an exception, if the code is not an agent's.

    Code at a boundary wraps an exception and names the owner. Exceptions without a wrapper are crashhunt's own, except
    for two cases: an adapter has raised a `SimulatorError`, or the exception has passed through `foreign_packages`.
    ``place`` is the purpose for which the simulator was called.
    """
    if type(error) is ForeignError:
        return Blame(error.error, error.party, error.place)
    if issubclass(type(error), CrashhuntError) and not issubclass(type(error), InternalError):
        return Blame(error, party_of_simulator(simulator), place)
    if supports(simulator, RunsForeignCode) and _has_passed(error, simulator.foreign_packages):
        return Blame(error, Party.SIMULATOR, place)
    if has_users_code(error):
        # No boundary was passed: a signal handler, a finalizer, or a function that replaces another.
        party = party_of_simulator(simulator)
        is_agents = party is Party.SIMULATOR and is_ours(simulator)
        return Blame(error, Party.AGENT if is_agents else party, place)
    return Blame(error, Party.CRASHHUNT, place, is_resource=issubclass(type(error), _RESOURCE_ERRORS))


def has_users_code(error: BaseException) -> bool:
    """Return whether an exception or its cause has passed through a user's code."""
    seen: set[int] = set()
    left: list[BaseException | None] = [error]
    while left and len(seen) < _MAX_CAUSES:
        one = left.pop()
        if one is None or id(one) in seen:
            continue
        seen.add(id(one))
        left += (one.__cause__, one.__context__)
        link, frames = one.__traceback__, 0
        while link is not None and frames < _MAX_FRAMES:
            if is_users(link.tb_frame.f_code.co_filename):
                return True
            link, frames = link.tb_next, frames + 1
    return False


def _has_passed(error: BaseException, packages: Sequence[str]) -> bool:
    """Return whether an exception's class belongs to the given packages, or the exception passed through their code."""
    modules: set[object] = {type.__dict__["__module__"].__get__(type(error))}
    link: TracebackType | None = error.__traceback__
    while link is not None:
        modules.add(link.tb_frame.f_globals.get("__name__"))
        link = link.tb_next
    return any(isinstance(name, str) and name.partition(".")[0] in packages for name in modules)


# What foreign code returns is checked inside its boundary: otherwise crashhunt's own code would fail over it.


def guarded_reset(reset: Callable[..., Any]) -> Callable[..., Any]:
    """Return the reset function of a foreign simulator, wrapped so that its exceptions name their origin."""

    def checked(**given: object) -> tuple[dict[str, NDArray[Any]], object]:
        observations, info = reset(**given)
        return _arrays(observations), info

    return Boundary(Party.SIMULATOR, "reset").around(checked)


def guarded_step(step: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Return the step function of a foreign simulator, wrapped so that its exceptions name their origin."""

    def checked(actions: object) -> tuple[object, ...]:
        observations, rewards, terminations, truncations, infos = step(actions)
        _arrays(observations)
        rewards = {name: number_of(value, f"rewards[{name!r}]", _STEP_FIX) for name, value in rewards.items()}
        ended, cut = (
            {name: truth_of(value, f"{what}[{name!r}]", _STEP_FIX) for name, value in flags.items()}
            for what, flags in (("terminations", terminations), ("truncations", truncations))
        )
        return observations, rewards, ended, cut, infos

    return Boundary(Party.SIMULATOR, "step").around(checked)


def guarded_scene(scene: Callable[[], Any]) -> Callable[[], Scene]:
    """Return the method ``scene`` of a foreign simulator, wrapped so that its exceptions name their origin."""

    def checked() -> Scene:
        found = scene()
        if not isinstance(found, Scene):
            raise TypeError(f"scene() returned a {type(found).__name__}; it must return a Scene")
        return found

    return Boundary(Party.SIMULATOR, "scene").around(checked)


def guarded_check(check: Callable[..., Any]) -> Callable[..., Sequence[Finding]]:
    """Return the check of a user's oracle, wrapped so that its exceptions name their origin."""

    def checked(scene: Scene, agents: Sequence[str]) -> Sequence[Finding]:
        given: Any = check(scene, agents)
        if not isinstance(given, Iterable) and given not in (None, False):
            raise TypeError(f"check() returned {describe_value(given)}; it must return a list of Finding")
        found = list(given or ())
        for one in found:
            if not isinstance(one, Finding):
                raise TypeError(f"check() returned a {type(one).__name__}; it must return a list of Finding")
        return found

    return Boundary(Party.ORACLE, "check").around(checked)


def _arrays(observations: Any) -> dict[str, NDArray[Any]]:
    for name, array in observations.items():
        if not isinstance(array, np.ndarray):
            raise TypeError(f"the observation of {name} is a {type(array).__name__}; it must be a NumPy array")
    found: dict[str, NDArray[Any]] = observations
    return found


def internal_error(error: BaseException, trial: int | None = None, steps: int | None = None) -> InternalError:
    """Return the error that ends a hunt because crashhunt itself failed.

    The number of completed steps is -1 if the trial was being set up.
    """
    if type(error) is InternalError:
        return error
    frames = [
        frame for frame in traceback.extract_tb(error.__traceback__) if frame.filename.startswith(str(layout.PACKAGE))
    ]
    where = ""
    if frames:
        where = f"{Path(frames[-1].filename).relative_to(layout.PACKAGE.parent)}:{frames[-1].lineno}"
    when = ""
    if steps is not None:
        when = f" after {count_of(steps, 'step')}" if steps >= 0 else " while the episode was being set up"
    trial_words = "" if trial is None else f" in trial {trial}{when}"
    message = f"crashhunt itself failed{trial_words}: {in_words(error)}"
    fault = InternalError(message, fix=limit_behind(error) or _REPORT_FIX.format(_ISSUES_URL), where=where)
    fault.traceback = format_error(error) or message
    return fault
