"""A bare ``.sumocfg`` that nobody wrote for us, as a scenario."""

from __future__ import annotations

import os
from pathlib import Path

from crashhunt.base.errors import ScenarioError
from crashhunt.scenario._scenario import Scenario
from crashhunt.scenario._tables import ArgumentSetup, ObservationSetup
from crashhunt.scenario.backends.sumo._check import check_options
from crashhunt.scenario.backends.sumo._config import changes, is_left_out, read_config, split_names
from crashhunt.scenario.backends.sumo._ego import choose_ego, number, seconds
from crashhunt.scenario.backends.sumo._options import INPUTS, RESERVED
from crashhunt.scenario.backends.sumo._table import SumoSetup
from crashhunt.scenario.backends.sumo._xml import nested_files, read_xml, written_by

__all__ = ["load_sumocfg"]

_FILES = ("net-file", "route-files", "additional-files")
_TAKEN = {"begin", "step-length", "scale"}  # a scenario has a key of its own for each of them
_TELEPORT_S = "300"  # SUMO's own
# A flow is not punctual, and a full road lets nobody in.
_PATIENCE_S = 300.0


def load_sumocfg(path: Path, *, ego: str = "") -> Scenario:
    """Turn a SUMO configuration into a scenario.

    Its network, routes, additional files and options are kept. What it would write is not written, and what a trial
    decides itself is left out (the seed, the number of threads); the notes say so. The demand becomes the scenario
    argument ``scale``.

    Args:
        path: the configuration.
        ego: ``VEHICLE``, ``vehicle=ID``, ``route=ID``, ``edges=FROM,TO`` or ``any``; empty: any, where one departs.

    Raises:
        ScenarioError: the configuration is not one, or names no vehicle and no route.
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
    (net, *_), routes, additional = (files[key] for key in _FILES)
    begin, step_length = _times(options, path)
    driven = choose_ego(ego, [folder / file for file in (*routes, *additional)], begin, path)
    scale = number(options.get("scale", "1"), "scale", path)
    kept = {key: value for key, value in options.items() if key not in _TAKEN | RESERVED}
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
        notes=(driven.note, *notes),
    )


def _files(options: dict[str, str], path: Path, unset: str) -> tuple[Path, dict[str, tuple[str, ...]]]:
    """Return the folder that holds all files of the configuration, and their names in it by option."""
    base = path.resolve().parent
    named: dict[str, list[str]] = {key: [] for key in _FILES}
    for key in [key for key in options if key in _FILES or key in INPUTS]:
        for name in split_names(options.pop(key)):
            file = os.path.normpath(base / name)
            if not os.path.isfile(file):  # noqa: PTH113
                fix = f"set it ({unset})" if unset else "mend the path"
                raise ScenarioError(f"{key}: the file {file!r} does not exist", fix=fix, where=str(path))
            named.setdefault(key, []).append(file)
    for key in sorted(key for key in options if key.endswith(("-file", "-files"))):
        raise ScenarioError(
            f"the option {key} = {options[key]!r} names a file that a trial would not archive",
            fix="move what it needs into the additional-files, or remove it",
            where=str(path),
        )
    if len(named["net-file"]) != 1:
        raise ScenarioError("the configuration names several net-files", fix="name one", where=str(path))
    everything = [file for files in named.values() for file in files]
    read = [file for key in ("route-files", "additional-files") for file in named[key]]
    everything += [os.path.normpath(base / file) for file in nested_files(base, tuple(read))]
    folder = Path(os.path.commonpath([base, *map(os.path.dirname, everything)]))
    return folder, {key: tuple(os.path.relpath(file, folder) for file in files) for key, files in named.items()}


def _times(options: dict[str, str], path: Path) -> tuple[float, float]:
    """Return when the simulation begins, and its step length, in s."""
    begin = seconds(options.get("begin", "0"), path)
    end = seconds(options.get("end", "-1"), path)
    if 0 <= end < begin:
        raise ScenarioError(f"end = {end:g} is before begin = {begin:g}", fix="mend one of the two", where=str(path))
    # SUMO counts in whole milliseconds.
    step_length = round(seconds(options.get("step-length", "1"), path), 3)
    if not 0 < step_length < float("inf"):
        raise ScenarioError(
            f"step-length = {options['step-length']!r} is no time step", fix="give at least 0.001", where=str(path)
        )
    return begin, step_length
