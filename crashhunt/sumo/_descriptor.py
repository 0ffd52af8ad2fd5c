"""Descriptor of SUMO: the table of a scenario, its files, and its consequences."""

from __future__ import annotations

from dataclasses import replace
from importlib import metadata
from typing import TYPE_CHECKING

from crashhunt.scenario import ACTIONS, Backend, CompiledCore, Configuration, LoadOrder, TrafficSurvey
from crashhunt.sumo._options import INPUTS, SIGNAL_ARGUMENTS, SumoSetup, canonical, writes
from crashhunt.world import EVENT_WORDS

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping
    from pathlib import Path

    from crashhunt.base.errors import ScenarioError
    from crashhunt.base.json_types import Json
    from crashhunt.scenario import Scenario
    from crashhunt.trial import Value
    from crashhunt.world import RightOfWay, StopLine

_VEHICLE_KEYS = (
    "existing",
    "replaces",
    "type",
    "route",
    "edges",
    "depart_s",
    "depart_lane",
    "depart_pos",
    "depart_speed",
)
_DRIVING_KEYS = ("action", "observation", "target_speeds", "speed_mode")


OSM_ENDINGS, OPENDRIVE_ENDINGS = (".osm", ".osm.gz", ".osm.xml", ".pbf"), (".xodr", ".xodr.gz")
MAP_ARGUMENTS = ("demand", "imperfection", "speed_spread", "trucks_per_100_cars", "ego_route")


# A listing of backends imports this module, so everything else is imported where it is needed.


def _check(scenario: Scenario, where: str) -> None:
    from crashhunt.sumo._setup_check import check

    check(scenario, where)


def _check_names(scenario: Scenario, ego: str) -> None:
    from crashhunt.sumo._names import check_names

    check_names(scenario, ego)


def _files(scenario: Scenario) -> Iterator[str]:
    sumo = scenario.table(SumoSetup)
    yield sumo.net
    yield from _texts(scenario)
    for option, value in sumo.options.items():
        if canonical(option) in INPUTS:
            yield from (name.strip() for name in str(value).split(",") if name.strip())


def _texts(scenario: Scenario) -> Iterator[str]:
    """Yield route files, additional files, and the files that these make SUMO read."""
    from crashhunt.sumo._files import nested_files

    sumo = scenario.table(SumoSetup)
    named = (*sumo.routes, *sumo.additional)
    yield from named
    yield from nested_files(scenario.folder, named, inside=True)


def _relocated(path: Path) -> bytes | None:
    from crashhunt.sumo._files import movable

    return movable(path)


def _notes(scenario: Scenario) -> Iterator[str]:
    """Yield notes on output files that a trial does not write, and on demand that SUMO omits."""
    from crashhunt.sumo._demand_order import unsorted_notes
    from crashhunt.sumo._files import written_by

    sumo = scenario.table(SumoSetup)
    named = [name for option in sumo.options if writes(name := canonical(option))]
    found = [f"{', '.join(named)} (nothing is written)"] if named else []
    found += written_by(scenario.folder, (*sumo.routes, *sumo.additional))
    if found:
        yield f"of {scenario.file}, a trial does not take over: {'; '.join(found)}"
    begin_s = sumo.options.get("begin", 0.0)
    yield from unsorted_notes(scenario.folder, sumo.routes, float(begin_s) if isinstance(begin_s, int | float) else 0.0)


def _load(path: Path, ego: str) -> Scenario:
    from crashhunt.sumo._sumocfg import load_sumocfg

    return load_sumocfg(path, ego=ego)


def _load_map(path: Path, ego: str) -> Scenario:
    from crashhunt.sumo._map import load_map

    return load_map(path, ego)


def _explained(message: str, output: str, scenario: Scenario) -> ScenarioError | None:
    from crashhunt.sumo._names import explained

    return explained(message, output, scenario)


def _right_of_way(scenario: Scenario) -> RightOfWay | None:
    from crashhunt.sumo._right_of_way import right_of_way

    return right_of_way(scenario)


def _stop_lines(scenario: Scenario) -> tuple[StopLine, ...]:
    from crashhunt.sumo._right_of_way import stop_lines

    return stop_lines(scenario)


def _side_effect(scenario: Scenario, values: Mapping[str, Value], specifications: Iterable[str]) -> str:
    from crashhunt.sumo._side_effects import side_effect

    return side_effect(scenario, values, specifications)


def _refined(scenario: Scenario, answer: Json) -> Scenario:
    from crashhunt.sumo._ego import refine

    return refine(scenario, answer)


def _restored(scenario: Scenario, kept: Scenario) -> Scenario | None:
    from crashhunt.sumo._ego import restore

    return restore(scenario, kept)


def _without_core(scenario: Scenario) -> Scenario:
    return scenario.with_table(replace(scenario.table(SumoSetup), native=False))


def _why_no_core(scenario: Scenario) -> str:
    from crashhunt.native import why_not

    if scenario.table(SumoSetup).native is False:
        return "the scenario says so"
    return why_not(metadata.version("libsumo"))


def _keep_link_order(scenario: Scenario) -> Scenario:
    return scenario.with_table(replace(scenario.table(SumoSetup), fix_link_order=False))


def _why_no_link_order(scenario: Scenario) -> str:
    from crashhunt.native import why_no_link_order

    if scenario.table(SumoSetup).fix_link_order is False:
        return "the scenario says so"
    return why_no_link_order(metadata.version("libsumo"))


BACKEND: Backend = Backend(
    title="SUMO",
    table=SumoSetup,
    example="net and routes",
    keys=frozenset({"warmup_s", "insertion_timeout_s", *(f"agents.{key}" for key in (*_VEHICLE_KEYS, *_DRIVING_KEYS))}),
    check=_check,
    check_names=_check_names,
    files=_files,
    texts=_texts,
    relocated=_relocated,
    notes=_notes,
    versions=("libsumo",),
    one_per_process=True,
    variables=("SUMO_HOME",),
    reported_events=tuple(EVENT_WORDS),
    disturbances=("brake", "stop", "dawdle", "speed", "cut_in", "late_merge", "step_out", "ignore_priority", "unseen"),
    actions=tuple(ACTIONS),
    observations=(
        "ego",
        "actors",
        "actor_ids",
        "lanes",
        "route",
        "route_state",
        "signals",
        "right_of_way",
        "stop_line",
        "speed_limit",
        "crossings",
        "predictions",
        "prediction_covariance",
        "lidar2d",
        "grid",
        "image",
    ),
    configurations=(
        Configuration(
            endings=(".sumocfg", ".sumo.cfg"),
            load=_load,
            arguments=("scale", "vehicle"),
            waiting="simulating the plain traffic, to find vehicles that enter (60 s of processor time at most)",
        ),
        *(
            Configuration(
                endings=endings,
                load=_load_map,
                arguments=MAP_ARGUMENTS,
                takes_ego=False,
                waiting="making a scenario from the map, which is kept for the next hunt",
            )
            for endings in (OSM_ENDINGS, OPENDRIVE_ENDINGS)
        ),
    ),
    varying_disturbances=("brake", "stop", "step_out"),
    signal_arguments=lambda scenario: SIGNAL_ARGUMENTS.get(scenario.table(SumoSetup).manoeuvre or "", ()),
    plays_paths=True,
    forkable=True,
    core=CompiledCore(switched_off=_without_core, why_not=_why_no_core),
    load_order=LoadOrder(what="SUMO's links", keep=_keep_link_order, why_not=_why_no_link_order),
    explained=_explained,
    side_effect=_side_effect,
    right_of_way=_right_of_way,
    stop_lines=_stop_lines,
    survey=TrafficSurvey(module="crashhunt.sumo._traffic_survey", refine=_refined, restore=_restored),
)
