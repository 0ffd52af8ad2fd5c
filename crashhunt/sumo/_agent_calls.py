"""Refuses calls with which an agent would change the simulation other than by its action.

An agent runs in the process of the simulation, so it can import libsumo. It may read everything. A call that changes
something, such as ``vehicle.setSpeed`` of another vehicle, ``simulationStep`` or ``close``, would reach round the
agent's action. Such a call raises an `ActionError` in the agent, and SUMO does not receive it. If the agent
hides the error, the next step raises it again.

Calls of crashhunt, of a user's simulator, oracle or disturbance, and of a program that uses the environment of
Gymnasium, are not restricted. If such a call of a user's code commands the speed of a vehicle, `Followers` leaves this
vehicle alone. The nearest function of crashhunt on the stack shows whether an agent calls. Only
functions that change something are wrapped, so reading costs nothing.
"""

from __future__ import annotations

import functools
import sys
from typing import TYPE_CHECKING

from libsumo import _libsumo as sumo

from crashhunt.base.errors import ActionError

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import FrameType

_READING = ("get", "is", "has", "convert", "domain", "subscribe", "unsubscribe", "addSubscription", "find", "save")
"""Beginnings of the names of functions that change nothing."""
_NOT_THE_TRAFFIC = ("gui",)
_CALLERS_OF_AGENTS = {
    "crashhunt.episode._episode": ("step", "_act", "_make"),
    "crashhunt.episode._fast_path": ("resume_after",),
    "crashhunt.episode._parts": ("agent",),
    "crashhunt.episode._action_override": ("act", "drive", "reset", "close"),
    "crashhunt.episode._failures": ("close_agent",),
}
"""The functions that call agents, by module."""
_STEP = "simulation.step"
_NEW_SIMULATION = ("simulation.start", "simulation.load")
_SPEED_COMMANDS = {"vehicle.setSpeed", "vehicle.setSpeedMode", "vehicle.slowDown", "vehicle.setAcceleration"}

commanded_elsewhere: set[str] = set()
"""The vehicles whose speed a user's code commands in this episode."""
refused_calls: list[ActionError] = []
"""The error of the first call of an agent that was refused, until the next step, episode or simulation."""


def forget_calls() -> None:
    """Forget the calls of the last episode."""
    commanded_elsewhere.clear()
    refused_calls.clear()


def guard_against_agents() -> None:
    """Wrap the functions of libsumo that change the simulation; a second call does nothing."""
    domains = {name.partition("_")[0] for name in dir(sumo) if name.endswith("_domainID")} - {*_NOT_THE_TRAFFIC}
    for name in dir(sumo):
        domain, _, what = name.partition("_")
        if domain in domains and what and not what.startswith((*_READING, "swig")):
            function = getattr(sumo, name)
            if not hasattr(function, "__wrapped__"):
                setattr(sumo, name, _guarded(f"{domain}.{what}", function))


def _guarded(name: str, function: Callable[..., object]) -> Callable[..., object]:
    @functools.wraps(function)
    def call(*given: object, **named: object) -> object:
        caller = sys._getframe(1)
        if not caller.f_globals.get("__name__", "").startswith("crashhunt.sumo."):
            if _is_by_agent(caller):
                shown = name.replace(_STEP, "simulationStep").replace("simulation.close", "close")
                message = f"the agent called libsumo's {shown}, which changes the simulation"
                error = ActionError(message, fix="return an action; agents may only read the simulation")
                refused_calls[:] = refused_calls or [error]
                raise error
            if name in _SPEED_COMMANDS:
                _note_command(name, *given, **named)
        if name in _NEW_SIMULATION:
            refused_calls.clear()
        if refused_calls and name == _STEP:
            raise refused_calls.pop()
        return function(*given, **named)

    return call


def _note_command(name: str, vehicle: object = "", speed: object = 0.0, *_: object, **named: object) -> None:
    """Note that a user's code commands the speed of a vehicle, or returns it to SUMO by ``setSpeed`` with -1."""
    vehicle, speed = named.get("vehID", vehicle), named.get("speed", speed)
    is_returned = name == "vehicle.setSpeed" and isinstance(speed, int | float) and speed < 0
    (commanded_elsewhere.discard if is_returned else commanded_elsewhere.add)(str(vehicle))


def _is_by_agent(caller: FrameType | None) -> bool:
    """Return whether a call comes from an agent: from below a function of crashhunt that calls agents."""
    while caller is not None:
        module = caller.f_globals.get("__name__", "")
        if module.startswith("crashhunt."):
            return caller.f_code.co_name in _CALLERS_OF_AGENTS.get(module, ()) or module.startswith("crashhunt.agents.")
        caller = caller.f_back
    return False
