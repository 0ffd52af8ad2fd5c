"""Agents that are programs: ``exec:PROGRAM``, in lock-step over standard input and output (protocol 1).

Each message is one JSON object on one line, or after ``ready`` MessagePack if the program asks for it. crashhunt
sends ``hello``, ``reset``, ``observe`` and ``close``. The program answers with ``ready``, ``ok`` and ``act``, and ends
after ``close``. Anything else is an error of the agent.
"""

from __future__ import annotations

import math
import os
import tempfile
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from pydantic_core import to_json

from crashhunt.agents._program_exchange import ProgramExchange, excerpt_of
from crashhunt.agents._program_processes import (
    ReusedProgram,
    reused_folder,
)
from crashhunt.agents._protocol import ForeignFactory, shown_space
from crashhunt.base import forks
from crashhunt.base.agent_locators import command_of, is_path, library_path, words_of
from crashhunt.base.errors import ArgumentError, ProgramError
from crashhunt.base.foreign_code import supports
from crashhunt.base.text import one_line
from crashhunt.scenario import ACTIONS
from crashhunt.simulators import NamesMetaActions, ObservesParts, ProvidesRoadMaps
from crashhunt.trial import Argument, CallSignature, Constant, kind_of, parse_spec
from crashhunt.world import describe_road_map

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from gymnasium import Space

    from crashhunt.base.program_message_types import Hello, Observe, Reset, SpaceDescription
    from crashhunt.panels import Panel
    from crashhunt.simulators import ActionForm, Simulator
    from crashhunt.trial import Kind, Value

PROTOCOL: Final = 1
_FORMATS: Final = ("json", "msgpack")
_DESCRIPTION_S: Final = 60.0  # as long as a module may take to import
_MAX_REVISION_CHARACTERS: Final = 100
_UNITS: Final = {
    "vx": "m/s", "vy": "m/s",
    **{component.name: component.unit for form in ACTIONS.values() for component in form.components},
}  # fmt: skip
_DECLARATION_KEYS: Final = ("range", "unit", "default")


class ProgramFactory(ForeignFactory):
    """Creates the agents of one ``exec:`` locator: one process per trial and vehicle.

    Args:
        locator: the locator, such as ``exec:./planner --mode test``.
    """

    def __init__(self, locator: str) -> None:
        self._locator = locator
        words_of(locator)  # refuses what is not a command line

    def declared_signature(
        self, agent: str = "", simulator: Simulator | None = None, *, limit_s: float = 0.0
    ) -> CallSignature:
        """Run the program once, and return the arguments that it declares in its first answer.

        The program receives ``hello`` without arguments, and then ``close``. Without a simulator, ``hello`` has no
        spaces.
        """
        command = command_of(self._locator)
        with tempfile.TemporaryDirectory(prefix="crashhunt-agent-") as folder, tempfile.TemporaryFile() as log:
            program = ProgramExchange(command, Path(folder), log.fileno())
            try:
                program.start()
                limit = max(limit_s, _DESCRIPTION_S)
                return _signature_in(program.ask(hello_of(agent, simulator, {}), "hello", limit))
            except ProgramError as error:
                raise ProgramError(f"{error.message}{_last_line(log)}", fix=error.fix) from None
            finally:
                program.close()

    def agent(
        self, name: str, simulator: Simulator, arguments: Mapping[str, Value], *, folder: Path,
        files: Mapping[str, str], limit_s: float | None = None, is_forked: bool = False,
    ) -> ProgramAgent:  # fmt: skip
        """Return the agent of a vehicle; its program runs in a folder of its own."""
        given = {key: _absolute(value) for key, value in arguments.items()}
        hello = hello_of(name, simulator, given)
        is_scalar = simulator.actions[name].space.shape == ()
        process = ProgramExchange(
            command_of(self._locator, files), folder / f"agent-{name}", libraries=library_path(self._locator, files),
            is_forked=is_forked,
        )  # fmt: skip
        return ProgramAgent(
            process, hello, partial(write_road_map, folder, simulator, name), is_scalar=is_scalar, limit_s=limit_s,
            reused=reused_folder(name),
        )  # fmt: skip

    def reused(self, folder: Path, files: Mapping[str, str]) -> ReusedProgram:
        """Return the program for several trials, which has not been started.

        Args:
            folder: the folder for the files of the program.
            files: file of the snapshot by the word that names the original file.
        """
        return ReusedProgram(command_of(self._locator, files), folder, library_path(self._locator, files))


class ProgramAgent:
    """An agent whose actions a program computes.

    The program starts in the first step. Therefore a program that does not start is an error of the agent, with a
    recorded trial, as in any other step.

    Args:
        process: the process of the program, which has not been started.
        hello: the first message.
        write_map: function that writes the road map, and returns its path; None if there is none.
        is_scalar: whether an action is one number, which the program sends as a list of one.
        limit_s: time limit for the answer to each observation, in s; None if only that of the trial applies.
        reused: folder of a program that has been started for several trials; None to start a program of its own.
    """

    def __init__(
        self, process: ProgramExchange, hello: Hello, write_map: Callable[[], str | None], *, is_scalar: bool,
        limit_s: float | None, reused: Path | None = None,
    ) -> None:  # fmt: skip
        self._process = process
        self._write_map = write_map
        self._reads_map = False
        self._map: str | None = None
        self._reused = reused
        self._limit_s = limit_s
        self._hello = hello
        self._is_scalar = is_scalar
        self._step_length_s = float(hello["step_length_s"])
        self._panels: Any = None
        self._seed = 0
        self._step = 0

    def reset(self, seed: int) -> None:
        """Begin an episode; the program receives the seed in the first step."""
        self._seed, self._step = int(seed), 0

    def act(self, observation: Any) -> Any:
        """Return the action that the program sends for an observation.

        Raises:
            ProgramError: the program has failed, or has sent something that the protocol does not contain.
        """
        try:
            return self._act(observation)
        except ProgramError as error:
            raise ProgramError(f"{self._hello['agent']}: {error.message}", fix=error.fix) from None

    def _act(self, observation: Any) -> Any:
        process, step = self._process, self._step
        if step == 0:
            self._begin()
        elif process.is_inherited:
            self._repeat()
        message: Observe = {
            "type": "observe", "step": step, "time_s": round(step * self._step_length_s, 9),
            "observation": _plain(observation),
        }  # fmt: skip
        answer = process.ask(message, f"observe of step {step}", self._limit_s)
        if "action" not in answer:
            raise ProgramError(
                f"its answer to observe of step {step} has no action", fix='send {"type": "act", "action": […]}'
            )
        self._step, self._panels = step + 1, answer.get("panels")
        action = answer["action"]
        return action[0] if self._is_scalar and isinstance(action, list) and len(action) == 1 else action

    def _begin(self, *, again: bool = False) -> None:
        """Start the program unless it runs, and begin the episode.

        Args:
            again: whether this is a fork of a trial, in which the road map has been written.
        """
        process = self._process
        if not process.is_started or process.is_inherited:
            if self._reused is None or process.is_inherited:
                process.start()
            else:
                process.attach(self._reused)
            try:
                ready = process.ask(self._hello, "hello")
                _signature_in(ready)
            except ProgramError as error:
                fix = "answer hello before each reset, or omit reuse" if process.is_reused else error.fix
                raise ProgramError(error.message, fix=fix) from None
            self._reads_map = bool(ready.get("map"))
        message: Reset = {"type": "reset", "seed": self._seed}
        if self._reads_map:
            self._map = message["map"] = self._map if again else self._write_map()
        process.ask(message, "reset")

    def _repeat(self) -> None:
        """Start the program for this fork of the trial, and have it answer all earlier observations again.

        A fork whose program answers otherwise ends without an answer, because it is no copy of the trial.
        """
        exchanges = self._process.exchanges
        try:
            self._begin(again=True)
            for step, (data, action) in enumerate(exchanges):
                answer = self._process.exchange(data, "act", f"observe of step {step}", self._limit_s)
                if answer.get("action") != action:
                    raise ProgramError(
                        f"it answered observe of step {step} with {excerpt_of(answer.get('action'))}, and before with "
                        f"{excerpt_of(action)}"
                    )
        except ProgramError as error:
            forks.abandon(f"could not repeat the program of {self._hello['agent']}: {error.message}")

    def panels(self) -> dict[str, Panel]:
        """Return the panels in the last answer of the program; see `panels_in`."""
        from crashhunt.agents._program_panels import panels_in

        return panels_in(self._panels)

    def close(self) -> None:
        """Send ``close`` to the program, and end it with all processes that it has started."""
        self._process.close()


_PARTS_FIX = "see crashhunt list observations"


def write_road_map(folder: Path, simulator: Simulator, agent: str) -> str | None:
    """Write the road map and the data of a vehicle into a folder as JSON, and return the path of the file.

    Without road maps in the simulator, return None.
    """
    if not supports(simulator, ProvidesRoadMaps):
        return None
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / f"map-{agent}.json"
    file.write_bytes(to_json(describe_road_map(simulator.road_map(agent), simulator.vehicle_data(agent))))
    return str(file)


def hello_of(agent: str, simulator: Simulator | None, arguments: Mapping[str, Value]) -> Hello:
    """Return the first message, which describes the spaces of a vehicle if there is a simulator."""
    found: Hello = {
        "type": "hello", "protocol": PROTOCOL, "agent": agent, "arguments": dict(arguments), "observation": {},
        "action": {"shape": [], "columns": [], "units": []}, "step_length_s": 0.0,
    }  # fmt: skip
    if simulator is not None:
        layouts = simulator.observation_layouts if supports(simulator, ObservesParts) else {}
        layout = layouts.get(agent)
        found["observation"] = (
            layout.describe() if layout is not None else _described_observation(*shown_space(simulator, agent))
        )
        found["action"] = _described_action(simulator.actions[agent])
        found["step_length_s"] = simulator.step_length_s
    return found


def _check_ready(ready: Mapping[str, Any]) -> None:
    """Refuse the first answer of a program that wants another protocol.

    Raises:
        ProgramError: the program wants another protocol or format.
    """
    protocol, form = ready.get("protocol", PROTOCOL), ready.get("format", "json")
    if protocol != PROTOCOL:
        raise ProgramError(
            f"its protocol is {excerpt_of(protocol)} (allowed: {PROTOCOL})", fix=f'send "protocol": {PROTOCOL}'
        )
    if form not in _FORMATS:
        allowed = " or ".join(_FORMATS)
        raise ProgramError(f"its format is {excerpt_of(form)} (allowed: {allowed})", fix='send "format": "json"')


def _signature_in(ready: Mapping[str, Any]) -> CallSignature:
    """Return what a program declares; a program that declares no arguments accepts any.

    Raises:
        ProgramError: the program wants another protocol, or does not declare ranges, units and defaults.
    """
    _check_ready(ready)
    declared = ready.get("arguments") or {}
    if not isinstance(declared, dict):
        raise ProgramError(f"its arguments are {excerpt_of(declared)}, not an object")
    arguments = {name: _argument(name, facts) for name, facts in declared.items()}
    required = tuple(name for name, one in arguments.items() if one.default is None)
    observation, action = ready.get("observation") or [], ready.get("action") or ""
    revision = ready.get("revision") or ""
    if not isinstance(revision, str):
        raise ProgramError(f"its revision is {excerpt_of(revision)}, not a text")
    if not isinstance(ready.get("map", False), bool):
        raise ProgramError(f"its map is {excerpt_of(ready['map'])} (allowed: true, false)", fix='send "map": true')
    if not isinstance(observation, list) or not all(isinstance(part, str) for part in observation):
        raise ProgramError(f"its observation is {excerpt_of(observation)}, not a list of names", fix=_PARTS_FIX)
    if not isinstance(action, str):
        raise ProgramError(f"its action is {excerpt_of(action)}, not a name", fix="see crashhunt list actions")
    return CallSignature(
        arguments=arguments, open=not arguments, given=(), required=required, action=action,
        observation=tuple(observation), revision=one_line(revision)[:_MAX_REVISION_CHARACTERS],
    )  # fmt: skip


def _argument(name: str, facts: object) -> Argument:
    if not isinstance(facts, dict) or (odd := sorted(facts.keys() - set(_DECLARATION_KEYS))):
        said = excerpt_of(facts) if not isinstance(facts, dict) else ", ".join(odd)
        raise ProgramError(f"its argument {name} has {said} (allowed: {', '.join(_DECLARATION_KEYS)})")
    default, unit, text = facts.get("default"), facts.get("unit") or "", facts.get("range")
    if not (default is None or isinstance(default, bool | int | float | str)) or not isinstance(unit, str):
        raise ProgramError(f"its argument {name} has the default {excerpt_of(default)} and the unit {excerpt_of(unit)}")
    if not (text is None or isinstance(text, bool | int | float | str)):
        raise ProgramError(f"its argument {name} has the range {excerpt_of(text)}", fix='write it as "5:40" or "a|b|c"')
    # JSON does not tell 12 from 12.0, so whether an argument takes whole numbers follows from the texts of its values.
    kind: Kind | None = None if default is None or type(default) is int else kind_of(default)
    try:
        distribution = None if text is None else parse_spec(str(text), kind)
        if isinstance(distribution, Constant) and ":" in str(distribution.value):
            raise ArgumentError(f"{excerpt_of(text)} is not a range", fix='write it as "5:40", "a|b|c" or "log:1e-3:1"')
    except ArgumentError as error:
        raise ProgramError(f"its argument {name}: {error.message}", fix=error.fix) from None
    return Argument(name=name, kind=kind, default=default, distribution=distribution, unit=unit)


def _absolute(value: Value) -> Value:
    """Return a value; one that names a file of the current folder becomes its absolute path."""
    is_file = isinstance(value, str) and is_path(value) and os.path.isfile(value)  # noqa: PTH113
    return str(Path(str(value)).absolute()) if is_file else value


def _described_observation(space: Space[object], names: Sequence[str]) -> dict[str, SpaceDescription]:
    """Return the shape, columns and units of each part of an observation."""
    from gymnasium.spaces import Box, Dict

    if isinstance(space, Dict):
        return {str(part): _described_space(one, ()) for part, one in space.spaces.items()}
    found = _described_space(space, names)
    if isinstance(space, Box) and names:
        # Normalised values are at most 1. The scale of values without a bound, as highway-env has them, is unknown.
        highest = space.high.reshape(-1, len(names)).max(axis=0)
        found["units"] = [
            unit if 1 < high < math.inf else "" for unit, high in zip(found["units"], highest, strict=True)
        ]
    return {"kinematics" if names else "observation": found}


def _described_action(form: ActionForm) -> SpaceDescription:
    """Return the shape, columns, units and bounds of an action."""
    found = _described_space(form.space, form.names)
    if supports(form.space, NamesMetaActions):
        found["meanings"] = list(form.space.meanings)
    return found


def _described_space(space: Space[object], names: Sequence[str]) -> SpaceDescription:
    from gymnasium.spaces import Box, Tuple

    shape = [int(length) for length in space.shape or ()]
    units = [_UNITS.get(name, "") for name in names]
    found: SpaceDescription = {"shape": shape, "columns": list(names), "units": units}
    if isinstance(space, Tuple):
        found |= {"shape": [len(space.spaces)], "bounds": [_bounds(one) for one in space.spaces]}
    elif isinstance(space, Box) and len(shape) == 1:
        found["bounds"] = [_ends(low, high) for low, high in zip(space.low, space.high, strict=True)]
    elif (bounds := _bounds(space)) is not None:
        found["bounds"] = [bounds]
    return found


def _bounds(space: Space[object]) -> list[float | None] | None:
    """Return the least and the greatest value of a space of single numbers; None for other spaces."""
    from gymnasium.spaces import Box, Discrete

    if isinstance(space, Discrete):
        return [int(space.start), int(space.start + space.n) - 1]
    return _ends(space.low, space.high) if isinstance(space, Box) and space.shape == () else None


def _ends(low: Any, high: Any) -> list[float | None]:
    return [float(end) if np.isfinite(end) else None for end in (low, high)]


def _plain(value: Any) -> Any:
    """Return an observation as nested lists and objects of JSON."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, dict):
        return {str(key): _plain(inner) for key, inner in value.items()}
    return [_plain(inner) for inner in value] if isinstance(value, list | tuple) else value


def _last_line(log: Any) -> str:
    """Return the last line that a program has written to its standard error, in brackets; empty if there is none."""
    size = log.seek(0, os.SEEK_END)
    log.seek(max(0, size - 4000))
    lines = log.read().decode("utf-8", "replace").split("\n")
    last = next((line for line in reversed(lines) if line.strip()), "")
    return f" (its last output: {one_line(last)[:300]})" if last else ""
