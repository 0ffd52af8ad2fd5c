"""Scenarios from the parameters of ASAM OpenSCENARIO files of the test cases of UN R157 (ALKS).

The storyboard of a file is not run. The names of its parameters identify the test case, as in the public ALKS scenarios
of ASAM. The values become the arguments of the scenario of crashhunt for the same test case.
"""

from __future__ import annotations

import math
import operator
import re
from dataclasses import dataclass, field
from typing import TYPE_CHECKING
from xml.etree import ElementTree as ET

from crashhunt.base import layout
from crashhunt.base.errors import ScenarioError
from crashhunt.base.files import whole_file
from crashhunt.base.text import listed, one_line
from crashhunt.scenario import copy_shipped_scenario

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from crashhunt.base.codec import JsonObject

_MAX_BYTES = 10_000_000
_EGO = "Ego_InitSpeed_Ve0_kph"
_FAR = "TargetBlocking_InitPosition_LongitudinalOffset_m"
_OFFSET = "TargetBlocking_InitPosition_LateralOffset_m"


def _same(value: float) -> float:
    return value


def _kmh(value: float) -> float:
    return -3.6 * value


_LATERAL = "LaneChange_MaxLateralVelocity_Vy_mps"
# Scenario, the parameter by which its files are recognized, and each parameter's argument with its conversion.
_CASES: tuple[tuple[str, str, Mapping[str, tuple[str, Callable[[float], float]]]], ...] = (
    ("r157-cut-in", "CutInVehicle_HeadwayDistanceTrigger_dx0_m", {
        "CutInVehicle_HeadwayDistanceTrigger_dx0_m": ("gap_m", _same),
        "CutInVehicle_RelativeInitSpeed_Ve0_Vo0_kph": ("slower_kmh", operator.neg),
        f"CutInVehicle_{_LATERAL}": ("lateral_mps", _same),
        "CutInVehicle_InitPosition_RelativeLaneId": ("side", _same),
    }),
    ("r157-cut-out", "FrontOfLead_Distance_dx0_f_m", {
        "FrontOfLead_Distance_dx0_f_m": ("front_m", _same),
        f"CutOutVehicle_{_LATERAL}": ("lateral_mps", _same),
        "CutOutVehicle_RelativeTargetLane": ("side", _same),
    }),
    ("r157-deceleration", "LeadVehicle_Deceleration_Rate_mps2", {
        "LeadVehicle_Deceleration_Rate_mps2": ("decel_mps2", _same),
        "LeadVehicle_Init_HeadwayTime_s": ("headway_s", _same),
    }),
    ("r157-following", "LeadVehicle_VaryingSpeed_Negative_Offset_mps", {
        "LeadVehicle_VaryingSpeed_Negative_Offset_mps": ("slower_kmh", _kmh),
        "LeadVehicle_Init_HeadwayTime_s": ("headway_s", _same),
        "LeadVehicle_Init_LateralOffset_m": ("offset_m", _same),
    }),
    ("r157-lane-keeping", "Swerve_Offset_Left_m", {"Swerve_Offset_Left_m": ("swerve_m", _same)}),
    ("r157-lane-keeping", "SideVehicle_InitPosition_RelativeLaneId", {
        "SideVehicle_InitPosition_RelativeLaneId": ("side", _same),
        "SideVehicle_InitLongitudinalOffset_m": ("beside_m", _same),
    }),
    ("r157-pedestrian", "TargetBlocking_Speed_kph", {
        "TargetBlocking_Speed_kph": ("walk_kmh", _same), _FAR: ("distance_m", _same),
    }),
    ("r157-multiple-targets", "TargetBlocking2_Model", {_FAR: ("distance_m", _same)}),
    ("r157-detection-range", "", {_FAR: ("distance_m", _same), _OFFSET: ("offset_m", _same)}),
    ("r157-blocked-lane", _FAR, {_FAR: ("distance_m", _same), _OFFSET: ("offset_m", _same)}),
)  # fmt: skip
_SLOWER = """[arguments.slower_kmh]
default = 20
range = "10:50"
unit = "km/h"
help = "speed of the controlled vehicle minus speed of the vehicle that cuts in"
"""


@dataclass(frozen=True, slots=True)
class ReadParameters:
    """A scenario that was made from the parameters of an OpenSCENARIO file."""

    directory: Path  # folder of the scenario
    scenario: str  # the included scenario of which it is a variant
    read: Mapping[str, str]  # the argument and its values for each parameter that was read
    not_read: tuple[str, ...]  # the other parameters, each with the reason or its value

    def to_json(self) -> JsonObject:
        """Return JSON-compatible data."""
        return {
            "dir": str(self.directory),
            "scenario": self.scenario,
            "read": dict(self.read),
            "not_read": list(self.not_read),
        }


@dataclass(slots=True)
class _Parameters:
    """The parameters of a file: default values, distributions, and what was not understood."""

    title: str = ""
    defaults: dict[str, str] = field(default_factory=dict)
    values: dict[str, list[str] | tuple[str, str, str | None]] = field(default_factory=dict)
    unknown: list[str] = field(default_factory=list)

    @property
    def names(self) -> list[str]:
        return list({**self.defaults, **self.values})


def scenario_from_openscenario(file: Path, directory: Path) -> ReadParameters:
    """Make a scenario from the parameters of an OpenSCENARIO file of a test case of UN R157.

    The file has ParameterDeclarations, or is a ParameterValueDistribution. An existing folder must be empty.

    Raises:
        ScenarioError: the file cannot be read, or is of no known test case.
        HuntDirectoryError: the folder cannot be written, or is not empty.
    """
    found = _read(file)
    scenario, known = _recognize(found, file)
    values: dict[str, tuple[str, str]] = {}
    read: dict[str, str] = {}
    not_read = list(found.unknown)
    for name in found.names:
        argument, convert = known.get(name, ("", _same))
        try:
            if not argument:
                raise ValueError
            values[argument] = _specification(found, name, convert)
            read[name] = f"{argument} = {values[argument][1] or values[argument][0]}"
        except ValueError:
            shown = found.values.get(name, found.defaults.get(name, ""))
            words = listed(shown) if isinstance(shown, list) else shown
            not_read.append(one_line(f"{name} ({words if isinstance(words, str) else ':'.join(filter(None, words))})"))
    if not read:
        raise ScenarioError("no parameter has a number that can be read", fix="give another file", where=str(file))
    copy_shipped_scenario(scenario, directory)
    target = directory / layout.SCENARIO
    text = target.read_text(encoding="utf-8")
    if "slower_kmh" in values and scenario == "r157-cut-in":
        text = re.sub(r"\[arguments\.other_kmh\].*?(?=\n\[)", _SLOWER, text, flags=re.DOTALL)
    for argument, (default, specification) in values.items():
        text = _with_argument(text, argument, default, specification)
    with whole_file(target) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return ReadParameters(directory=directory, scenario=scenario, read=read, not_read=tuple(not_read))


def _recognize(found: _Parameters, file: Path) -> tuple[str, Mapping[str, tuple[str, Callable[[float], float]]]]:
    is_detection = "detection" in f"{found.title} {file.name}".lower()
    for scenario, sign, known in _CASES:
        if sign in found.names or (not sign and is_detection and _OFFSET in found.names):
            return scenario, {_EGO: ("ego_kmh", _same), **known}
    raise ScenarioError(
        f"the parameters are of no test case that crashhunt knows: {listed(found.names) or 'none'}",
        fix="give a file of a cut-in, cut-out, deceleration, following, swerving or side vehicle, blocked lane, "
        "pedestrian, several targets or forward detection, with the parameter names of ASAM's ALKS scenarios",
        where=str(file),
    )


def _read(file: Path, *, is_template: bool = False) -> _Parameters:
    root = _parsed(file)
    header = root.find("FileHeader")
    found = _Parameters(title=header.get("description", "") if header is not None else "")
    for one in root.iterfind("./ParameterDeclarations/ParameterDeclaration"):
        found.defaults[one.get("name", "")] = one.get("value", "")
    distribution = root.find("ParameterValueDistribution")
    if distribution is None:
        return found
    template = distribution.find("ScenarioFile")
    if template is not None and not is_template:
        path = file.parent / template.get("filepath", "")
        try:
            base = _read(path, is_template=True)
            found.defaults = {**base.defaults, **found.defaults}
            found.title += f" {base.title}"
        except ScenarioError as error:
            found.unknown.append(f"defaults of {template.get('filepath', '')}: {error.message}")
    for part in distribution:
        if part.tag == "Deterministic":
            for one in part:
                _add_deterministic(one, found)
        elif part.tag == "Stochastic":
            for one in part.iterfind("StochasticDistribution"):
                _add_stochastic(one, found)
    return found


def _parsed(file: Path) -> ET.Element:
    try:
        if file.stat().st_size > _MAX_BYTES:
            raise ScenarioError("is larger than 10 MB", fix="give a scenario file", where=str(file))
        root = ET.fromstring(file.read_bytes())
    except (OSError, ValueError) as error:
        reason = (error.strerror if isinstance(error, OSError) else "") or str(error)
        raise ScenarioError(f"cannot be read: {reason}", fix="give an .xosc file", where=str(file)) from None
    except ET.ParseError as error:
        raise ScenarioError(f"is not valid XML: {error}", fix="correct the file", where=str(file)) from None
    if root.tag != "OpenSCENARIO":
        raise ScenarioError(f"is <{one_line(root.tag)}>, not <OpenSCENARIO>", fix="give an .xosc file", where=str(file))
    return root


def _add_deterministic(one: ET.Element, found: _Parameters) -> None:
    name = one.get("parameterName", "")
    range_, set_ = one.find("DistributionRange"), one.find("DistributionSet")
    if one.tag == "DeterministicSingleParameterDistribution" and set_ is not None:
        found.values[name] = [element.get("value", "") for element in set_.iterfind("Element")]
    elif one.tag == "DeterministicSingleParameterDistribution" and range_ is not None:
        _add_range(name, range_.find("Range"), range_.get("stepWidth"), found)
    else:
        names = dict.fromkeys(each.get("parameterRef", "") for each in one.iter("ParameterAssignment"))
        found.unknown.append(f"{one.tag} of {listed(names) or name}: values that depend on each other are not read")


def _add_stochastic(one: ET.Element, found: _Parameters) -> None:
    name = one.get("parameterName", "")
    uniform = one.find("UniformDistribution")
    if uniform is not None:
        _add_range(name, uniform.find("Range"), None, found)
    else:
        found.unknown.append(f"{name}: only a uniform distribution is read, not {listed(part.tag for part in one)}")


def _add_range(name: str, ends: ET.Element | None, step: str | None, found: _Parameters) -> None:
    if ends is None:
        found.unknown.append(f"{name}: the range has no limits")
    else:
        found.values[name] = ends.get("lowerLimit", ""), ends.get("upperLimit", ""), step


def _specification(found: _Parameters, name: str, convert: Callable[[float], float]) -> tuple[str, str]:
    """Return the default of an argument, and its range in the notation of ``--set``, which may be empty.

    Raises:
        ValueError: a value is not a number.
    """

    def text(value: str) -> str:
        number = float(value)
        if not math.isfinite(number):
            raise ValueError
        return f"{round(convert(number), 9) + 0.0:g}"

    values = found.values.get(name)
    default = text(found.defaults[name]) if name in found.defaults else ""
    if values is None:
        return default, ""
    if isinstance(values, list):
        options = list(dict.fromkeys(map(text, values)))
        if not options:
            raise ValueError
        return default if default in options else options[0], "|".join(options)
    low, high = sorted((text(values[0]), text(values[1])), key=float)
    step = "" if values[2] is None else f":{abs(float(values[2]) * (convert(1.0) - convert(0.0))):g}"
    inside = default and float(low) <= float(default) <= float(high)
    return default if inside else low, f"{low}:{high}{step}" if low != high else low


def _with_argument(text: str, argument: str, default: str, specification: str) -> str:
    """Return the text of a scenario with other values of an argument."""
    begin = text.index(f"[arguments.{argument}]")
    end = text.index("\n[", begin)
    part = text[begin:end]
    is_float = re.search(r"^default = -?\d+\.", part, re.MULTILINE) is not None
    is_float = is_float or "." in f"{default}{specification}"
    whole = default if not is_float or "." in default else f"{default}.0"
    part = re.sub(r"^default = .*$", f"default = {whole}", part, flags=re.MULTILINE)
    if specification:
        part = re.sub(r"^range = .*$", f'range = "{specification}"', part, flags=re.MULTILINE)
    else:
        part = re.sub(r"^range = .*\n", "", part, flags=re.MULTILINE)
    return text[:begin] + part + text[end:]
