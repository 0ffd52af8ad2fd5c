"""Simulates the unmodified traffic of a scenario, without a controlled vehicle, and reports which vehicles enter when.

libsumo holds one simulation per process, so this module runs in its own process, with this command: ``python -m
crashhunt.sumo._traffic_survey JOB``. The module reads the job from the JSON file JOB and writes the answer
to another JSON file. SUMO's own output goes to standard output.
"""

from __future__ import annotations

import json
import os
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

import libsumo
from libsumo import _libsumo as sumo

from crashhunt.scenario import scenario_from_dict
from crashhunt.sumo._ego_choice import NOT_ON_A_ROAD, SurveyedRun
from crashhunt.sumo._files import StagedFiles

if TYPE_CHECKING:
    from crashhunt.scenario import SurveyJob
    from crashhunt.trial import Value

AFTER_FIRST_ENTRY_S = 600.0
"""Simulation time after the first road vehicle has entered: candidates are drawn from the first 500 s."""
WITHOUT_ROAD_VEHICLES_S = 3600.0
"""Simulation time after the first vehicle of any class has entered, while no road vehicle has."""
MAX_STEPS_BEFORE_FIRST_ENTRY = 500_000
MAX_VEHICLE_STEPS = 1_500_000
"""Sum over steps of the vehicles on the road: 5 to 20 s of processor time. The bound counts vehicles and not seconds,
so that every machine finds the same candidates."""
LOOK_EVERY_S = 5.0
GRIDLOCK_S = 120.0
"""Standstill that counts as a gridlock. SUMO's generated traffic lights have cycles of 90 s, so a red phase is none."""
GRIDLOCK_SHARE = 0.95
MIN_VEHICLES_IN_GRIDLOCK = 5
STANDING_MPS = 0.1
STOPPED_BIT = 1  # bit of SUMO's stop state


def main() -> None:
    """Simulate the runs of the job, and write the completed runs to the answer file."""
    job: SurveyJob = json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))
    # Processor time: on a busy machine, a limit of wall time would change the candidates, and with them the hunt.
    deadline_s = time.process_time() + job["processor_time_limit_s"]
    scenario = scenario_from_dict(job["scenario"], where="survey", folder=Path(job["folder"]), tolerant=True)
    stage = Path(job["stage"])
    stage.mkdir(exist_ok=True)
    files = StagedFiles(scenario, stage)
    runs: list[SurveyedRun] = []
    for asked in job["runs"]:
        if runs and time.process_time() >= deadline_s:
            runs[-1]["out_of_time"] = True
            break
        runs.append(_run(files, asked["seed"], asked["values"], deadline_s))
    answer = Path(job["answer"])
    temporary = answer.with_suffix(".part")
    temporary.write_text(json.dumps(runs), encoding="utf-8")
    temporary.replace(answer)
    sys.stdout.flush()
    os._exit(0)  # libsumo needs seconds to take down a large network


def _run(files: StagedFiles, seed: int, values: dict[str, Value], deadline_s: float) -> SurveyedRun:
    command = files.arguments(seed, values)
    if libsumo.isLoaded():
        libsumo.load(command)
    else:
        libsumo.start(["sumo", *command])
    begin = libsumo.simulation.getTime()
    dt = libsumo.simulation.getDeltaT()
    look_every = max(1, round(LOOK_EVERY_S / dt))
    found: SurveyedRun = {
        "begin_s": begin, "end_s": begin, "steps": 0, "entries": [], "gridlock": None, "cut_short": False,
        "out_of_time": False,
    }  # fmt: skip
    first_s = first_on_road_s = None
    vehicle_steps = standing_looks = 0
    while True:
        libsumo.simulationStep()
        found["steps"] += 1
        now = libsumo.simulation.getTime()
        found["end_s"] = now
        on_the_road = set(sumo.vehicle_getIDList()) if (departed := libsumo.simulation.getDepartedIDList()) else ()
        for vehicle in departed:
            if vehicle not in on_the_road:
                continue  # the vehicle left in the step in which it entered
            vehicle_class = sumo.vehicle_getVehicleClass(vehicle)
            parked = libsumo.vehicle.isStoppedParking(vehicle)
            found["entries"].append((vehicle, now, vehicle_class, parked))
            first_s = now if first_s is None else first_s
            if first_on_road_s is None and not parked and vehicle_class not in NOT_ON_A_ROAD:
                first_on_road_s = now
        if found["steps"] % look_every:
            continue
        present = sumo.vehicle_getIDList()
        vehicle_steps += len(present) * look_every
        standing, free = _standing(present)
        jammed = free >= MIN_VEHICLES_IN_GRIDLOCK and standing >= GRIDLOCK_SHARE * free
        standing_looks = standing_looks + 1 if jammed else 0
        if standing_looks * look_every * dt >= GRIDLOCK_S:
            since = now - (standing_looks - 1) * look_every * dt
            found["gridlock"] = {"since_s": since, "standing": standing, "vehicles": free}
            return found
        found["out_of_time"] = time.process_time() >= deadline_s
        if vehicle_steps > MAX_VEHICLE_STEPS or found["out_of_time"]:
            found["cut_short"] = True
            return found
        if first_on_road_s is not None:
            if now - first_on_road_s >= AFTER_FIRST_ENTRY_S:
                return found
        elif first_s is not None:
            if now - first_s >= WITHOUT_ROAD_VEHICLES_S:
                return found
        elif found["steps"] >= MAX_STEPS_BEFORE_FIRST_ENTRY:
            found["cut_short"] = True
            return found
        if libsumo.simulation.getMinExpectedNumber() == 0:  # every vehicle and person has left, and none is to come
            return found


def _standing(present: tuple[str, ...]) -> tuple[int, int]:
    """Return the number of vehicles that stand still, and of all vehicles; vehicles at a planned stop do not count."""
    free = [vehicle for vehicle in present if not sumo.vehicle_getStopState(vehicle) & STOPPED_BIT]
    return sum(sumo.vehicle_getSpeed(vehicle) < STANDING_MPS for vehicle in free), len(free)


if __name__ == "__main__":
    main()
