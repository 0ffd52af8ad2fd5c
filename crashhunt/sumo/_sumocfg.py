"""Loading of a plain ``.sumocfg``, which was written only for SUMO, as a scenario."""

from __future__ import annotations

import os
import re
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base.errors import ScenarioError
from crashhunt.scenario import ArgumentSetup, ObservationSetup, Scenario
from crashhunt.sumo._ego_choice import choose_ego, number, seconds
from crashhunt.sumo._files import nested_files, read_xml, written_by
from crashhunt.sumo._omitted_demand import unsorted_notes
from crashhunt.sumo._options import (
    FIXED_OPTIONS,
    INPUTS,
    RESERVED,
    SumoSetup,
    canonical,
    is_output,
    is_shown,
    is_true,
    writes,
)
from crashhunt.sumo._scenario_check import check_options

if TYPE_CHECKING:
    from collections.abc import Mapping


# Reading a ``.sumocfg`` as SUMO does: sections, short names, environment variables.

_VARIABLE = re.compile(r"\$\{(.+?)\}")
# Why a trial has another value than the configuration; the rest of what is always so changes nothing on the road.
_REASONS = {
    "random": "a trial must be the same again",
    "threads": "results depend on their number",
    "device.rerouting.threads": "results depend on their number",
    "collision.action": "vehicles stay where they have met",
    "collision.check-junctions": "crossing traffic collides too",
    "collision.mingap-factor": "vehicles have crashed when they touch",
}


def read_config(path: Path) -> tuple[dict[str, str], list[str]]:
    """Return the options of a configuration by SUMO's names for them, and notes for the user about them.

    SUMO ignores the sections, and replaces ``${NAME}`` by the environment variable and ``~`` by the home directory.
    This function does the same once, so that a replay on another machine does not depend on these values.

    Raises:
        ScenarioError: the file is not a configuration of SUMO.
    """
    try:
        root = ET.parse(path).getroot()
    except (ET.ParseError, UnicodeDecodeError, LookupError, ValueError) as error:
        raise ScenarioError(f"not valid XML: {error}", fix="correct the file", where=str(path)) from None
    except OSError as error:
        raise ScenarioError(
            f"cannot be read: {error.strerror}", fix="check that the file exists and may be read", where=str(path)
        ) from None
    options: dict[str, str] = {}
    used: dict[str, str] = {}
    for element in root.iter():
        value = element.get("value", element.get("v"))
        if value is None and len(element) == 0 and element is not root:
            value = (element.text or "").strip()  # as it was written long ago
        if not value:
            continue
        name = canonical(element.tag)
        if name in options:
            fix = "remove one of the two elements"
            raise ScenarioError(f"the option {element.tag} is given twice", fix=fix, where=str(path))
        options[name] = _resolved(value, used)
    notes = [
        f"{path.name} names ${{{name}}}, which is {value!r} now" if value else f"{path.name}: ${{{name}}} is not set"
        for name, value in used.items()
    ]
    return options, notes


def _resolved(value: str, used: dict[str, str]) -> str:
    def variable(match: re.Match[str]) -> str:
        used[match[1]] = found = os.environ.get(match[1], "")
        return found

    if value.startswith("~"):
        value = "${HOME}" + value[1:]
    return _VARIABLE.sub(variable, value.replace(",~", ",${HOME}"))


def split_names(value: str) -> list[str]:
    """Split a list of file names; a space is part of a name."""
    return [name.strip() for name in value.split(",") if name.strip()]


def changes(options: Mapping[str, str]) -> list[str]:
    """Return the options of a configuration that a trial changes, each with the reason as text."""
    found = []
    for name, value in options.items():
        if name == "seed":
            found.append(f"seed {value} (each trial has its own)")
        elif name in _REASONS and not _is_equal(value, FIXED_OPTIONS[name]):
            found.append(f"{name} {value} (it is {FIXED_OPTIONS[name]}: {_REASONS[name]})")
        elif name == "load-state":
            found.append(f"load-state {value} (a trial begins with an empty road)")
        elif name == "end" and not value.startswith("-"):
            found.append(f"end {value} (until then traffic is added; a trial continues to its last step)")
    written = [name for name in options if writes(name) and not is_shown(name)]
    if written:
        found.append(f"{', '.join(written)} (nothing is written)")
    return found


def _is_equal(value: str, other: str) -> bool:
    if other in ("true", "false"):
        return is_true(value) is (other == "true")
    try:
        return float(value) == float(other)
    except ValueError:
        return value == other


def is_left_out(name: str) -> bool:
    """Return whether an option has no meaning in a trial, so that it is omitted."""
    return is_output(name) or is_shown(name) or name.startswith("load-state")


_FILE_OPTIONS = ("net-file", "route-files", "additional-files")
_KEY_OPTIONS = {"begin", "step-length", "scale"}  # a scenario has a key of its own for each of them
_TELEPORT_S = "300"  # SUMO's own
# A flow is not punctual, and a full road admits no vehicle.
_PATIENCE_S = 300.0


def load_sumocfg(path: Path, ego: str = "") -> Scenario:
    """Turn a SUMO configuration into a scenario.

    The network, routes, additional files and options of the configuration are kept. The output files that the
    configuration names are not written. Options that a trial sets itself (the seed, the number of threads) are ignored.
    The notes list both. The demand becomes the scenario argument ``scale``. ``ego`` is as for `choose_ego`.

    Raises:
        ScenarioError: the file is not a configuration of SUMO, or defines no vehicle and no route.
    """
    options, notes = read_config(path)
    if "net-file" not in options:
        raise ScenarioError("the configuration names no net-file", fix="add <net-file value=…/>", where=str(path))
    changed = changes(options)
    options = {key: value for key, value in options.items() if not is_left_out(key)}
    if "phemlight-path" in options:  # a folder of the installation, and the same for everybody
        options["phemlight-path"] = str(path.resolve().parent / options["phemlight-path"]) + os.sep
        notes.append(f"phemlight-path is {options['phemlight-path']}, which is not archived")
    folder, files = _files(options, path, "; ".join(note for note in notes if note.endswith("is not set")))
    (net, *_), routes, additional = (files[key] for key in _FILE_OPTIONS)
    begin, step_length = _times(options, path)
    driven = choose_ego(ego, [folder / file for file in (*routes, *additional)], begin, path)
    scale = number(options.get("scale", "1"), "scale", path)
    kept = {key: value for key, value in options.items() if key not in _KEY_OPTIONS | RESERVED}
    check_options(kept, str(path))
    kept |= {key: ",".join(files[key]) for key in INPUTS & files.keys()}
    changed += written_by(folder, (*routes, *additional))
    if changed:
        notes.append(f"of {path.name}, a trial does not take over: {'; '.join(changed)}")
    literal = any(b"${" in read_xml(folder / file) for file in (*routes, *additional))
    return Scenario(
        title=f"{path.name}, as it is",
        name=path.name.removesuffix(".sumocfg"),
        folder=folder,
        file=os.path.relpath(path.resolve(), folder),
        step_length_s=step_length,
        warmup_s=0.0,
        insertion_timeout_s=_PATIENCE_S,
        observation=ObservationSetup(),
        agents={driven.agent: driven.setup},
        arguments={
            "scale": ArgumentSetup(default=scale, help="scales the traffic demand", option="scale"),
            **driven.arguments,
        },
        tables={
            "sumo": SumoSetup(
                net=net,
                routes=routes,
                additional=additional,
                options={"begin": begin, "time-to-teleport": _TELEPORT_S, **kept},
                literal=literal or None,
            )
        },
        notes=(driven.note, *notes, *unsorted_notes(folder, routes, begin)),
    )


def _files(options: dict[str, str], path: Path, unset: str) -> tuple[Path, dict[str, tuple[str, ...]]]:
    """Return the folder that contains all files of the configuration, and their names in this folder by option."""
    base = path.resolve().parent
    named: dict[str, list[str]] = {key: [] for key in _FILE_OPTIONS}
    for key in [key for key in options if key in _FILE_OPTIONS or key in INPUTS]:
        for name in split_names(options.pop(key)):
            file = os.path.normpath(base / name)
            if not os.path.isfile(file):  # noqa: PTH113
                fix = f"set it ({unset})" if unset else "correct the path"
                raise ScenarioError(f"{key}: the file {file!r} does not exist", fix=fix, where=str(path))
            named.setdefault(key, []).append(file)
    for key in sorted(key for key in options if key.endswith(("-file", "-files"))):
        raise ScenarioError(
            f"the option {key} = {options[key]!r} names a file that crashhunt does not archive",
            fix="move its content into the additional-files, or remove the option",
            where=str(path),
        )
    if len(named["net-file"]) != 1:
        raise ScenarioError("the configuration names several net-files", fix="name one net-file", where=str(path))
    everything = [file for files in named.values() for file in files]
    read = [file for key in ("route-files", "additional-files") for file in named[key]]
    everything += [os.path.normpath(base / file) for file in nested_files(base, tuple(read))]
    folder = Path(os.path.commonpath([base, *map(os.path.dirname, everything)]))
    return folder, {key: tuple(os.path.relpath(file, folder) for file in files) for key, files in named.items()}


def _times(options: dict[str, str], path: Path) -> tuple[float, float]:
    """Return the start time of the simulation and the step length, in s."""
    begin = seconds(options.get("begin", "0"), path)
    end = seconds(options.get("end", "-1"), path)
    if 0 <= end < begin:
        raise ScenarioError(f"end = {end:g} is before begin = {begin:g}", fix="correct begin or end", where=str(path))
    # SUMO counts in whole milliseconds.
    step_length = round(seconds(options.get("step-length", "1"), path), 3)
    if not 0 < step_length < float("inf"):
        raise ScenarioError(
            f"step-length = {options['step-length']!r} is not a time step", fix="give at least 0.001", where=str(path)
        )
    return begin, step_length
