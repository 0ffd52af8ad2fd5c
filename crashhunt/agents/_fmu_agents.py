"""Agents that are FMUs: ``fmu:FILE.fmu``, co-simulation by FMI 2 or 3, through FMPy (extra ``fmi``).

A place of an observation is the name of a part, indices and a column, such as ``kinematics[1].x``. A table next to the
FMU says which input has the value of which place, and which output is which value of the action. Without it, the
variables have the names of the places and of the action's values.
"""

from __future__ import annotations

import importlib
import math
import re
import tempfile
import time
import tomllib
import zipfile
from collections import defaultdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Protocol, TypeAlias

import numpy as np

from crashhunt.agents._library_agents import ActionArray, ObservationArrays
from crashhunt.agents._programs import hello_of
from crashhunt.agents._protocol import ForeignFactory
from crashhunt.base.agent_locators import fmu_files
from crashhunt.base.binaries import length_by_headers
from crashhunt.base.errors import ArgumentError, PluginError, ProgramError
from crashhunt.base.text import listed, one_line
from crashhunt.simulators import PARTS
from crashhunt.trial import Argument, CallSignature, parse_spec

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Mapping, Sequence

    from crashhunt.base.program_message_types import Hello, SpaceDescription
    from crashhunt.simulators import Simulator
    from crashhunt.trial import Kind, Value

_PLACE: Final = re.compile(r"([^\[\].]+)((?:\[\d+\])*)(?:\.(\w+))?")
_NAME: Final = re.compile(r"[A-Za-z_]\w*")
_INTEGERS: Final = ("Integer", "Enumeration", "Int8", "UInt8", "Int16", "UInt16", "Int32", "UInt32", "Int64", "UInt64")
_REALS: Final = ("Real", "Float32", "Float64")
_MAX_SHOWN_CHARACTERS: Final = 300
_SEED: Final = "seed"
_WIDTH_OF_INTEGERS: Final = 2**32 - 1
_TABLE_KEYS: Final = ("inputs", "action")
_EXPONENTS: Final = {
    "m": (1, 0, 0), "m²": (2, 0, 0), "s": (0, 1, 0), "m/s": (1, -1, 0), "m/s²": (1, -2, 0), "rad": (0, 0, 1),
    "rad/s": (0, -1, 1),
}  # fmt: skip
"""The exponents of m, s and rad in each unit of observations and actions."""
_SAME_UNIT: Final = (1.0, 0.0)


class _Variable(Protocol):
    """A variable of a model description of FMPy."""

    name: str
    valueReference: int  # noqa: N815
    type: str
    causality: str
    start: str | None
    min: str | None
    max: str | None
    unit: str | None
    dimensions: Sequence[_Dimension]


class _Dimension(Protocol):
    start: str | None


class _Instance(Protocol):
    """An instance of an FMU in FMPy; the methods for values have the types of variables in their names."""

    def instantiate(self) -> None: ...
    def setupExperiment(self) -> None: ...  # noqa: N802
    def enterInitializationMode(self) -> None: ...  # noqa: N802
    def exitInitializationMode(self) -> None: ...  # noqa: N802
    def doStep(self, currentCommunicationPoint: float, communicationStepSize: float) -> Any: ...  # noqa: N802, N803
    def terminate(self) -> None: ...
    def freeInstance(self) -> None: ...  # noqa: N802


class FmuFactory(ForeignFactory):
    """Creates the agents of one ``fmu:`` locator."""

    def __init__(self, locator: str) -> None:
        self._locator = locator
        self._model: _Model | None = None
        self._folder: Path | None = None

    def declared_signature(
        self, agent: str = "", simulator: Simulator | None = None, *, limit_s: float = 0.0
    ) -> CallSignature:
        """Return the parameters of the FMU as arguments, which are the same for every vehicle.

        Options may choose other observations and actions than the scenario, so the simulator is not used.
        """
        model = self._read({})
        try:
            return model.signature()
        except ArgumentError as error:
            raise self._refusal(f"{error.where}: {error.message}", error.fix) from None

    def load(self, files: Mapping[str, str], scratch: Path) -> None:
        """Extract the FMU into a folder, unless this has been done.

        Args:
            files: file of the snapshot by the text that names the original file; empty if there is no snapshot.
            scratch: the folder in which the FMU gets a folder of its own.

        Raises:
            PluginError: the FMU cannot be used.
        """
        if self._model is None:
            self._model = self._read(files)
            scratch.mkdir(parents=True, exist_ok=True)
            self._folder = Path(tempfile.mkdtemp(prefix=f"fmu-{self._model.path.stem}-", dir=scratch))
            _fmpy().extract(str(self._model.path), str(self._folder))
            for binary in sorted(self._folder.glob("binaries/*/*.so")):
                if binary.stat().st_size < length_by_headers(binary):  # it would end this process with SIGBUS
                    raise self._refusal(f"its {binary.name} is cut: it is shorter than its headers say", _EXPORT)
            self._instance()  # so that what cannot be loaded is an error before the first trial

    def agent(
        self, name: str, simulator: Simulator, arguments: Mapping[str, Value], *, folder: Path,
        files: Mapping[str, str], limit_s: float | None = None, is_forked: bool = False,
    ) -> FmuAgent:  # fmt: skip
        """Return the agent of a vehicle. The limit holds for each step of the FMU.

        A fork of the process contains the agent, so it does not matter whether there are forks.
        """
        self.load(files, folder)
        assert self._model is not None
        return FmuAgent(
            self._instance, self._model, self._wired(self._model, name, simulator), name=name,
            step_length_s=simulator.step_length_s, arguments=arguments, limit_s=limit_s,
        )  # fmt: skip

    def _instance(self) -> _Instance:
        assert self._model is not None
        model, module = self._model, importlib.import_module(f"fmpy.fmi{self._model.version}")
        create = module.FMU2Slave if model.version == 2 else module.FMU3Slave
        try:
            made: _Instance = create(
                guid=model.token, modelIdentifier=model.identifier, unzipDirectory=str(self._folder)
            )
        except Exception as error:  # FMPy has no class of its own
            text = one_line(str(error).replace(f"{self._folder}/", "")).rstrip(".")
            raise self._refusal(f"it cannot be loaded: {text}", "see what the FMU needs") from None
        return made

    def _read(self, files: Mapping[str, str]) -> _Model:
        path, table = fmu_files(self._locator, files)
        try:
            return _Model(path, table)
        except _UnusableError as error:
            raise self._refusal(str(error), error.fix) from None

    def _wired(self, model: _Model, name: str, simulator: Simulator) -> _Wiring:
        form = simulator.actions[name]
        try:
            parts, action = ObservationArrays.of(simulator, name), ActionArray(form.space, form.names)
            return _Wiring(model, parts, action, form.names, hello_of(name, simulator, {}))
        except _UnusableError as error:
            raise self._refusal(str(error), error.fix) from None

    def _refusal(self, message: str, fix: str) -> PluginError:
        return PluginError(f"{self._locator!r}: {message}", fix=fix)


class _UnusableError(Exception):
    """The FMU or its table of variables cannot be used."""

    def __init__(self, message: str, fix: str) -> None:
        super().__init__(message)
        self.fix = fix


def _fmpy() -> Any:
    """Return the package FMPy.

    Raises:
        PluginError: the package is not installed.
    """
    try:
        return importlib.import_module("fmpy")
    except ImportError as error:
        raise PluginError(f"an FMU needs the package fmpy: {error}", fix="pip install 'crashhunt[fmi]'") from error


class _Model:
    """The description of an FMU, and its table of variables.

    Args:
        path: path of the FMU.
        table: path of the table; None if there is none.

    Raises:
        _UnusableError: the FMU is damaged, or offers no co-simulation on this machine, or the table is no such table.
    """

    def __init__(self, path: Path, table: Path | None) -> None:
        fmpy = _fmpy()
        self.path = path
        try:
            with path.open("rb") as file, zipfile.ZipFile(file) as archive:
                names = archive.namelist()
                described = fmpy.read_model_description(file)
        except Exception as error:  # of FMPy, lxml or zipfile
            raise _UnusableError(f"it is not an FMU: {one_line(str(error))}"[:_MAX_SHOWN_CHARACTERS], _EXPORT) from None
        self.version = int(str(described.fmiVersion).partition(".")[0])
        if self.version not in (2, 3):
            raise _UnusableError(f"it is of FMI {described.fmiVersion} (allowed: 2, 3)", _EXPORT)
        if described.coSimulation is None:
            raise _UnusableError("it offers no co-simulation", _EXPORT)
        self.token, self.identifier = str(described.guid), str(described.coSimulation.modelIdentifier)
        machine = str(fmpy.platform if self.version == 2 else fmpy.platform_tuple)
        binaries = sorted(
            {name.split("/")[1] for name in names if name.startswith("binaries/") and name.count("/") > 1}
        )
        if machine not in binaries:
            has = f"it has: {listed(binaries)}" if binaries else "it has none"
            raise _UnusableError(f"it has no binary for {machine} ({has})", _EXPORT)
        self.variables: dict[str, _Variable] = {one.name: one for one in described.modelVariables}
        self._units = {one.name: one.baseUnit for one in described.unitDefinitions}
        self.inputs, self.action = _tables(table)

    def of(self, causality: str) -> list[_Variable]:
        """Return the variables that are inputs, outputs or parameters."""
        return [one for one in self.variables.values() if one.causality == causality]

    def conversion(self, variable: _Variable, units: Collection[str]) -> tuple[float, float]:
        """Return the factor and the offset that convert a value of a variable to the unit of its place.

        ``units`` has the units of the values of the place; an empty unit is not known, and nothing is converted.

        Raises:
            _UnusableError: the unit of the variable is another kind of unit, or is not defined.
        """
        found = {self._conversion(variable.unit or "", unit) for unit in units}
        if len(found) == 1 and (one := found.pop()) is not None:
            return one
        ours = listed(sorted(filter(None, {*units})))
        raise _UnusableError(
            f"its variable {variable.name} has the unit {variable.unit}, which cannot be converted to {ours}",
            f"export it with the unit {ours}, or define {variable.unit} by a BaseUnit in UnitDefinitions",
        )

    def _conversion(self, unit: str, ours: str) -> tuple[float, float] | None:
        if not ours or unit in ("", "1", "-") or unit.replace("^", "").replace("²", "2") == ours.replace("²", "2"):
            return _SAME_UNIT
        base, (m, s, rad) = self._units.get(unit), _EXPONENTS[ours]
        if base is None or (base.m, base.s) != (m, s) or base.rad not in (0, rad):
            return None
        is_other = base.factor == 0 or any((base.kg, base.A, base.K, base.mol, base.cd))
        return None if is_other else (base.factor, base.offset)

    def signature(self) -> CallSignature:
        """Return the parameters as arguments, with the ranges between their minima and maxima."""
        found = {}
        for one in self.of("parameter"):
            if one.name == _SEED or not _NAME.fullmatch(one.name) or one.dimensions:
                continue
            kind = _kind(one)
            text = f"{one.min}:{one.max}" if _is_bounded(one) else ""
            distribution = parse_spec(text, kind, where=f"its parameter {one.name}") if text else None
            default = None if one.start is None else _value(one, one.start)
            found[one.name] = Argument(
                name=one.name, kind=kind, default=default, distribution=distribution, unit=one.unit or ""
            )
        # Without --observe, the parts that the inputs need are observed.
        sources = [self.inputs.get(one.name, one.name) for one in self.of("input")]
        places = [_PLACE.fullmatch(source) for source in sources if isinstance(source, str)]
        parts = dict.fromkeys(place[1] for place in places if place is not None and place[1] in PARTS)
        return CallSignature(arguments=found, open=False, given=(), observation=tuple(parts))


_EXPORT = "export it as an FMU for co-simulation by FMI 2 or 3, with a binary for this machine"


def _tables(path: Path | None) -> tuple[dict[str, str | float], dict[str, str | float]]:
    """Return the tables ``inputs`` and ``action`` of a file."""
    if path is None:
        return {}, {}
    fix = 'write [inputs] with VARIABLE = "PLACE", and [action] with VALUE = "VARIABLE"'
    try:
        tables = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise _UnusableError(f"{path.name} cannot be read: {one_line(str(error))}", fix) from None
    for key, table in tables.items():
        is_table = isinstance(table, dict) and all(isinstance(one, str | int | float) for one in table.values())
        if key not in _TABLE_KEYS or not is_table:
            raise _UnusableError(f"{path.name} has {key} (allowed: the tables {listed(_TABLE_KEYS)})", fix)
    return dict(tables.get("inputs", {})), dict(tables.get("action", {}))


class _Group:
    """Variables of the same type, which FMPy sets or gets at once.

    Attributes:
        type_name: type of the variables in the names of FMPy's methods.
        conversion: factor and offset from the unit of the variables to that of their places.
    """

    def __init__(self) -> None:
        self.type_name, self.conversion = "", _SAME_UNIT
        self.references: list[int] = []
        self.places: list[tuple[np.ndarray[Any, np.dtype[np.generic]], int]] = []
        """For each value, the flat array that contains it, and its index."""


_Groups: TypeAlias = defaultdict[tuple[str, tuple[float, float]], _Group]


class _Wiring:
    """The places in observations and actions to which the variables of an FMU belong.

    Raises:
        _UnusableError: an input or a value of the action has no source, or the source or the unit does not fit.
    """

    def __init__(
        self, model: _Model, parts: ObservationArrays, action: ActionArray, names: Sequence[str], hello: Hello
    ) -> None:
        self.parts, self.action = parts, action
        self.constants: list[tuple[_Variable, float]] = []
        self.fixed_actions: list[tuple[int, float]] = []
        inputs: _Groups = defaultdict(_Group)
        outputs: _Groups = defaultdict(_Group)
        arrays = {leaf.name: leaf.values for leaf in parts.leaves}
        columns = {leaf.name: leaf.columns for leaf in parts.leaves}
        known = {one.name for one in model.of("input")}
        if unknown := sorted(model.inputs.keys() - known):
            raise _UnusableError(f"it has no input {unknown[0]} (it has: {listed(sorted(known))})", _TABLE_FIX)
        for one in model.of("input"):
            source = model.inputs.get(one.name, one.name)
            if not isinstance(source, str):
                self.constants.append((one, float(source)))
                continue
            places = _places(source, arrays, columns)
            if places is None:
                raise _UnusableError(
                    f"its input {one.name} has no source: an observation has no place {source!r} "
                    f"(it has the parts {listed(sorted(arrays))})",
                    _TABLE_FIX,
                )
            units = _units_of(hello["observation"].get(source.partition("[")[0].partition(".")[0]))
            _add(inputs, model, one, places, {units[index % len(units)] for _, index in places})
        size = action.described.size
        values = {name: [index] for index, name in enumerate(names)} if len(names) == size else {}
        values |= {f"action[{index}]": [index] for index in range(size)} | {"action": list(range(size))}
        missing, given = set(range(size)), dict(model.action)
        given |= {name: name for name in values if name in model.variables and name not in given}
        for name, source in given.items():
            if name not in values:
                raise _UnusableError(f"an action has no value {name} (it has: {listed(values)})", _TABLE_FIX)
            missing -= set(values[name])
            if not isinstance(source, str):
                self.fixed_actions += [(index, float(source)) for index in values[name]]
                continue
            variable = model.variables.get(source)
            if variable is None or variable.causality != "output":
                has = listed(sorted(one.name for one in model.of("output")))
                raise _UnusableError(f"it has no output {source} for {name} (it has: {has})", _TABLE_FIX)
            units = _units_of(hello["action"])
            _add(
                outputs, model, variable, [(action.values, index) for index in values[name]],
                {units[index % len(units)] for index in values[name]},
            )  # fmt: skip
        if missing:
            name = names[min(missing)] if len(names) == size else f"action[{min(missing)}]"
            raise _UnusableError(f"no output has the name {name}, which is a value of the action", _TABLE_FIX)
        self.inputs, self.outputs = list(inputs.values()), list(outputs.values())


_TABLE_FIX = (
    'name the source in the .toml next to the FMU: [inputs] gap = "kinematics[1].x", [action] target_speed = "v"'
)


def _units_of(described: SpaceDescription | None) -> Sequence[str]:
    """Return the units of the values along the last axis of an array; one empty unit if they are not known."""
    return (described["units"] if described is not None else ()) or ("",)


def _add(
    groups: _Groups, model: _Model, variable: _Variable,
    places: list[tuple[np.ndarray[Any, np.dtype[np.generic]], int]], units: Collection[str],
) -> None:  # fmt: skip
    """Add a variable to the group of its type and its unit.

    Raises:
        _UnusableError: the variable has another number of values, another kind of unit, or a type that is no number.
    """
    if variable.type not in (*_REALS, *_INTEGERS, "Boolean"):
        raise _UnusableError(f"its variable {variable.name} is of type {variable.type}, which is no number", _EXPORT)
    lengths = [one.start for one in variable.dimensions or ()]
    count = math.prod(int(length) for length in lengths if length is not None)
    if None in lengths or count != len(places):
        raise _UnusableError(
            f"its variable {variable.name} has {count if None not in lengths else 'an unknown number of'} values, "
            f"and its place {len(places)}",
            _TABLE_FIX,
        )
    conversion = model.conversion(variable, units)
    group = groups[variable.type, conversion]
    group.type_name, group.conversion = _method(variable, model.version), conversion
    group.references.append(variable.valueReference)
    group.places += places


def _places(
    text: str, arrays: Mapping[str, np.ndarray[Any, np.dtype[np.generic]]], columns: Mapping[str, tuple[str, ...]]
) -> list[tuple[np.ndarray[Any, np.dtype[np.generic]], int]] | None:
    """Return the flat array and the index of each value of a place; None if the place does not exist."""
    found = _PLACE.fullmatch(text)
    if found is None or found[1] not in arrays:
        return None
    array, names = arrays[found[1]], columns[found[1]]
    chosen = np.arange(array.size).reshape(array.shape)
    for index in map(int, re.findall(r"\d+", found[2])):
        if chosen.ndim == 0 or index >= chosen.shape[0]:
            return None
        chosen = chosen[index]
    if found[3]:
        if chosen.ndim == 0 or found[3] not in names:
            return None
        chosen = chosen[..., names.index(found[3])]
    flat = array.reshape(-1)
    return [(flat, int(index)) for index in np.ravel(chosen)]


class FmuAgent:
    """An agent whose actions an FMU computes.

    The instance begins in the first step. Therefore a failure is an error of the agent, with a recorded trial, as in
    any other step.

    Args:
        create: function that returns a new instance.
        model: the description of the FMU.
        wiring: the places of its variables.
        name: identifier of the vehicle.
        step_length_s: time from one step to the next, in s.
        arguments: values of parameters.
        limit_s: time limit for each step of the FMU, in s; None if only that of the trial applies.
    """

    def __init__(
        self, create: Callable[[], _Instance], model: _Model, wiring: _Wiring, *, name: str, step_length_s: float,
        arguments: Mapping[str, Value], limit_s: float | None = None,
    ) -> None:  # fmt: skip
        self._limit_s = limit_s
        self._create, self._model, self._wiring, self._name = create, model, wiring, name
        self._step_length_s, self._arguments = step_length_s, dict(arguments)
        self._instance: _Instance | None = None
        self._seed = self._step = 0

    def reset(self, seed: int) -> None:
        """Begin an episode in a new instance; a parameter with the name ``seed`` receives the seed."""
        self.close()
        self._seed, self._step = int(seed), 0

    def act(self, observation: object) -> object:
        """Return the action that the FMU computes for an observation, after a step of its simulation.

        Raises:
            ProgramError: a function of the FMU has failed.
        """
        wiring, step = self._wiring, self._step
        wiring.parts.write(observation)
        try:
            if self._instance is None:
                self._begin()
            instance = self._instance
            self._set_inputs()
            wiring.action.clear()
            began = time.monotonic()
            ended = instance.doStep(step * self._step_length_s, self._step_length_s)  # type: ignore[union-attr]
            if self._model.version == 3 and ended[1]:
                raise ProgramError(f"{self._name}: the FMU asks to end the simulation in step {step + 1}")
            for group in wiring.outputs:
                self._get(group)
            if self._limit_s is not None and time.monotonic() > began + self._limit_s:
                raise ProgramError(
                    f"{self._name}: doStep of the FMU has not returned within {self._limit_s:g} s in step {step + 1}"
                )
        except ProgramError:
            raise
        except Exception as error:  # FMPy raises an exception without a class of its own too
            text = one_line(str(error))[:_MAX_SHOWN_CHARACTERS]
            raise ProgramError(f"{self._name}: the FMU has failed in step {step + 1}: {text}") from None
        for index, value in wiring.fixed_actions:
            wiring.action.values[index] = value
        self._step = step + 1
        return wiring.action.read()

    def close(self) -> None:
        """End the simulation of the FMU."""
        instance, self._instance = self._instance, None
        if instance is not None:
            try:
                instance.terminate()
            finally:
                instance.freeInstance()

    def _begin(self) -> None:
        instance = self._create()
        instance.instantiate()
        self._instance = instance
        if self._model.version == 2:
            instance.setupExperiment()
        variables = self._model.variables
        given = dict(self._arguments)
        if (seed := variables.get(_SEED)) is not None and seed.causality == "parameter":
            given[_SEED] = self._seed & 0x7FFFFFFF
        for name, value in given.items():
            self._set(variables[name], value)
        for variable, number in self._wiring.constants:
            self._set(variable, number)
        instance.enterInitializationMode()
        self._set_inputs()
        instance.exitInitializationMode()

    def _set(self, variable: _Variable, value: Value) -> None:
        method = f"set{_method(variable, self._model.version)}"
        getattr(self._instance, method)([variable.valueReference], [_value(variable, value)])

    def _set_inputs(self) -> None:
        for group in self._wiring.inputs:
            values: Iterable[float] = [array.item(index) for array, index in group.places]
            if group.conversion != _SAME_UNIT:
                factor, offset = group.conversion
                values = [(value - offset) / factor for value in values]
            if group.type_name not in _REALS:
                values = [self._whole(value) for value in values]
            getattr(self._instance, f"set{group.type_name}")(group.references, values)

    def _get(self, group: _Group) -> None:
        count = (len(group.places),) if self._model.version == 3 else ()
        values = getattr(self._instance, f"get{group.type_name}")(group.references, *count)
        if group.conversion != _SAME_UNIT:  # without it, a value keeps all its bits, such as the sign of -0.0
            factor, offset = group.conversion
            values = [value * factor + offset for value in values]
        for (array, index), value in zip(group.places, values, strict=True):
            array[index] = value

    def _whole(self, value: float) -> int:
        if value != int(value):
            raise ProgramError(
                f"{self._name}: an input of the FMU takes whole numbers, and the observation has {value}"
            )
        return int(value)


def _method(variable: _Variable, version: int) -> str:
    """Return the type of a variable in the names of FMPy's methods."""
    if variable.type == "Enumeration":
        return "Integer" if version == 2 else "Int64"
    return variable.type


def _is_bounded(variable: _Variable) -> bool:
    """Return whether a number has a minimum and a maximum, and not only INF or the limits of its type."""
    kind = _kind(variable)
    if kind not in ("int", "float") or not variable.min or not variable.max:
        return False
    return float(variable.max) - float(variable.min) < (_WIDTH_OF_INTEGERS if kind == "int" else math.inf)


def _kind(variable: _Variable) -> Kind:
    if variable.type in _REALS:
        return "float"
    return "int" if variable.type in _INTEGERS else "bool" if variable.type == "Boolean" else "str"


def _value(variable: _Variable, value: Value) -> Value:
    """Return a value in the type of a variable."""
    kind = _kind(variable)
    if kind == "bool":
        return value in (True, "true", "1")
    return float(value) if kind == "float" else int(value) if kind == "int" else str(value)
