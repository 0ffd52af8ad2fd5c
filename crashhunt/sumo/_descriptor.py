"""Descriptor of SUMO: the table of a scenario, its files, and its consequences."""

from __future__ import annotations

from dataclasses import replace
from importlib import metadata
from typing import TYPE_CHECKING

from crashhunt.base.doors import import_at_call
from crashhunt.scenario import ACTIONS, Backend, CompiledCore, Configuration, LoadOrder, TrafficSurvey
from crashhunt.simulators import PARTS
from crashhunt.sumo._options import INPUTS, SIGNAL_ARGUMENTS, SumoSetup, canonical, writes
from crashhunt.world import EVENT_WORDS

if TYPE_CHECKING:
    from collections.abc import Iterator

    from crashhunt.scenario import Scenario

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


def _notes(scenario: Scenario) -> Iterator[str]:
    """Yield notes on output files that a trial does not write, and on demand that SUMO omits."""
    from crashhunt.sumo._files import written_by
    from crashhunt.sumo._omitted_demand import unsorted_notes

    sumo = scenario.table(SumoSetup)
    named = [name for option in sumo.options if writes(name := canonical(option))]
    found = [f"{', '.join(named)} (nothing is written)"] if named else []
    found += written_by(scenario.folder, (*sumo.routes, *sumo.additional))
    if found:
        yield f"of {scenario.file}, a trial does not take over: {'; '.join(found)}"
    begin_s = sumo.options.get("begin", 0.0)
    yield from unsorted_notes(scenario.folder, sumo.routes, float(begin_s) if isinstance(begin_s, int | float) else 0.0)


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
    check=import_at_call("crashhunt.sumo._scenario_check:check"),
    check_names=import_at_call("crashhunt.sumo._scenario_check:check_names"),
    files=_files,
    texts=_texts,
    relocated=import_at_call("crashhunt.sumo._files:movable"),
    notes=_notes,
    versions=("libsumo",),
    one_per_process=True,
    variables=("SUMO_HOME",),
    reported_events=tuple(EVENT_WORDS),
    disturbances=("brake", "stop", "dawdle", "speed", "cut_in", "late_merge", "step_out", "ignore_priority", "unseen"),
    actions=tuple(ACTIONS),
    observations=tuple(PARTS),
    configurations=(
        Configuration(
            endings=(".sumocfg", ".sumo.cfg"),
            load=import_at_call("crashhunt.sumo._sumocfg:load_sumocfg"),
            arguments=("scale", "vehicle"),
            waiting="simulating the plain traffic, to find vehicles that enter (60 s of processor time at most)",
        ),
        *(
            Configuration(
                endings=endings,
                load=import_at_call("crashhunt.sumo.maps._cache:load_map"),
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
    explained=import_at_call("crashhunt.sumo._scenario_check:explained"),
    side_effect=import_at_call("crashhunt.sumo._side_effects:side_effect"),
    right_of_way=import_at_call("crashhunt.sumo._junction_rules:right_of_way"),
    stop_lines=import_at_call("crashhunt.sumo._junction_rules:stop_lines"),
    survey=TrafficSurvey(
        module="crashhunt.sumo._traffic_survey",
        refine=import_at_call("crashhunt.sumo._ego_choice:refine"),
        restore=import_at_call("crashhunt.sumo._ego_choice:restore"),
    ),
)
