"""The measurements behind every claim of speed and memory. Run it as ``scripts/bench``."""

from __future__ import annotations

import argparse
import importlib
import json
import math
import os
import shutil
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections import deque
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass, replace
from functools import partial
from operator import truediv
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from types import ModuleType

    import numpy as np
    from numpy.typing import NDArray

    from crashhunt.episode import WorkerSettings
    from crashhunt.trial import TrialResult, TrialSpec

CRASHHUNT = Path(sys.executable).parent / "crashhunt"


@dataclass(frozen=True, slots=True)
class Figure:
    """One measured figure.

    Args:
        name: of the figure.
        value: what was measured.
        unit: of the value.
        better: which way is better.
        target: what it should be at most (lower) or at least (higher); None where nothing was promised.
        note: how it was measured.
    """

    name: str
    value: float
    unit: str
    better: str
    target: float | None
    note: str = ""


@contextmanager
def folder() -> Iterator[Path]:
    """A scratch folder."""
    with tempfile.TemporaryDirectory(prefix="crashhunt-bench-") as name:
        yield Path(name)


def study(name: str) -> ModuleType:
    """Import the module of scripts/studies/NAME/NAME.py, which imports the other modules of its folder."""
    sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "studies" / name))
    return importlib.import_module(name)


def in_child(function: str, *arguments: str) -> dict[str, float]:
    """Run a function of this module in a process of its own: libsumo is one simulation per process."""
    done = subprocess.run(
        [sys.executable, __file__, "--child", function, *arguments], check=True, stdout=subprocess.PIPE,
        env={**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
    )  # fmt: skip
    found: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return found


def hunt(
    directory: Path, parallel: int, trials: int, max_steps: int, *options: str, cwd: Path | None = None
) -> dict[str, float]:
    """Hunt through the command line; return what ``--json`` says."""
    command = [str(CRASHHUNT), "run", str(directory), str(parallel), str(trials), str(max_steps), "--json", *options]
    done = subprocess.run(command, cwd=cwd, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, check=True)
    found: dict[str, float] = json.loads(done.stdout)
    return found


class Slot:
    """A supervisor in this process, with its zygote; counts the processor time that trials take.

    Args:
        settings: of the hunt.
    """

    def __init__(self, settings: WorkerSettings) -> None:
        from crashhunt.executors import Supervisor, worker_environment
        from crashhunt.executors._fork_server import be_zygote
        from crashhunt.executors._preparation import import_parts

        os.environ.update(worker_environment())
        ours, theirs = socket.socketpair()
        self.zygote = os.fork()
        if self.zygote == 0:
            ours.close()
            imported = import_parts(settings, lambda _: None)
            assert imported is not None
            be_zygote(theirs, settings, imported)
        theirs.close()
        self._supervisor = Supervisor(settings, ours)

    def run(self, spec: TrialSpec) -> TrialResult:
        """Run a trial, which has to get as far as its first step."""
        result = self._supervisor.run(spec).result
        if not result.steps:
            raise RuntimeError(f"the trial failed: {result.failure}")
        return result

    def cpu_s(self) -> float:
        """Processor time of this process, of the zygote and of all trials that have ended, in s."""
        fields = Path(f"/proc/{self.zygote}/stat").read_text().rpartition(")")[2].split()
        return time.process_time() + sum(map(int, fields[11:15])) / os.sysconf("SC_CLK_TCK")


# Episodes in which nothing but the machinery and the traffic differ from a bare loop.
QUIET = ("--agent", "keep-lane", "--arg", "speed=5", "--seed", "1", "--keep-going")


def child_step(scenario: str, observation: str = "") -> dict[str, float]:
    """A whole step against a bare libsumo loop over the same traffic, alternating in one process.

    Args:
        scenario: name of the scenario.
        observation: parts that the agents observe, separated by commas; empty for Kinematics.
    """
    import libsumo
    from libsumo import _libsumo as sumo

    from crashhunt.agents import KeepLaneWithSpeed
    from crashhunt.episode import FastEpisode, Nearness, Recorder
    from crashhunt.oracles import OffRoad, Overlap, ReportedCollision
    from crashhunt.recording import BlackBox
    from crashhunt.scenario import argument_values, load_scenario
    from crashhunt.sumo import Sight, SumoSimulator
    from crashhunt.trial import TrialSpec
    from crashhunt.world import ApproachMeter, DangerMeter

    steps, speed = 1000, 10.0
    clock = time.process_time  # what others do on this machine costs nothing
    chosen = load_scenario(scenario)
    if observation:
        seen = tuple(observation.split(","))
        setups = {agent: replace(setup, observation=seen) for agent, setup in chosen.agents.items()}
        chosen = replace(chosen, agents=setups)
    agents = list(chosen.agents)
    spent: dict[str, float] = {}
    within = [0.0]  # what has been spent in parts of the part that is going on, and of those around it

    def timed(inner: Callable[..., object], label: str) -> Callable[..., object]:
        def outer(*arguments: object, **options: object) -> object:
            within.append(0.0)
            began = clock()
            try:
                return inner(*arguments, **options)
            finally:
                took = clock() - began
                spent[label] = spent.get(label, 0.0) + took - within.pop()
                within[-1] += took

        return outer

    with folder() as stage:
        simulator = SumoSimulator(chosen, stage)
        box = BlackBox(stage / "blackbox.bin")
        arguments = argument_values(chosen)
        spec = TrialSpec(
            number=0, seed=1, arguments={}, scenario_arguments=arguments, max_steps=steps,
            digest_of_changes=bool(observation),  # as in a hunt
        )  # fmt: skip

        def whole(*, parts: bool = False) -> tuple[float, int]:
            box.begin(pid=os.getpid(), trial=0, started=time.monotonic())
            with FastEpisode(
                spec,
                simulator=simulator,
                make_agent=lambda *_: KeepLaneWithSpeed(speed),
                oracles=[ReportedCollision(), Overlap(), OffRoad()],
                crash_on=(),
                observers=[Recorder(box, simulator), Nearness(box.take_frames)],
            ) as episode:
                result = episode.start()
                if parts and episode._take is not None:
                    episode._take = timed(episode._take, "core")  # type: ignore[assignment]
                spent.clear()  # the warm-up is no part of a step
                began = clock()
                while result is None:
                    result = episode.step()
                taken = max(1, result.steps)
                return (clock() - began) / taken, taken

        def bare() -> tuple[float, float]:
            simulator.reset(seed=spec.seed, options={"arguments": arguments})
            guarded = {name: getattr(sumo, name) for name in ("simulation_step", "vehicle_setSpeed")}
            for name, function in guarded.items():  # a loop without crashhunt has no guard against agents
                setattr(sumo, name, function.__wrapped__)
            present, vehicles, taken = list(agents), 0, 0
            began = clock()
            while present and taken < steps:
                taken += 1
                for agent in present:
                    libsumo.vehicle.setSpeed(agent, speed)
                libsumo.simulationStep()
                vehicles += libsumo.vehicle.getIDCount()
                if libsumo.simulation.getArrivedNumber():
                    present = [agent for agent in agents if agent in libsumo.vehicle.getIDList()]
            spent_s = clock() - began
            for name, function in guarded.items():
                setattr(sumo, name, function)
            return spent_s / taken, vehicles / taken

        rounds = [(whole()[0], *bare()) for _ in range(7)]
        for owner, name, label in (
            (libsumo, "simulationStep", "simulate"),
            (KeepLaneWithSpeed, "act", "agent"),
            (Sight, "_see", "others in sight"),
            (Recorder, "lend", "others recorded"),
            (FastEpisode, "_complete", "steps in Python"),
            (FastEpisode, "_show_step", "oracles asked"),
            (Nearness, "_measure_frames", "frames"),
            (ApproachMeter, "measure", "closest approach"),
            (DangerMeter, "_summed", "danger"),
            (Recorder, "end", "digest"),
        ):
            setattr(owner, name, timed(getattr(owner, name), label))
        total, taken = whole(parts=True)
    found = {f"part {label}": 1e6 * seconds / taken for label, seconds in spent.items()}
    found["part everything else"] = 1e6 * total - sum(found.values())
    return {
        "ratio": statistics.median(ours / theirs for ours, theirs, _ in rounds),
        "vehicles": rounds[0][2],
        "whole": 1e6 * min(ours for ours, _, _ in rounds),
        "bare": 1e6 * min(theirs for _, theirs, _ in rounds),
        **found,
    }


def bench_observation() -> Iterator[Figure]:
    """A whole step with the parts of a planner in a town, against a bare loop."""
    for parts, target in (("ego,actors", 2.0), ("ego,actors,lanes,route,signals,right_of_way", 2.0)):
        found = in_child("child_step", "intersection", parts)
        note = f"{parts}; whole {found['whole']:.0f} µs, bare {found['bare']:.0f} µs"
        name = f"observation_ratio_{parts.count(',') + 1}_parts"
        yield Figure(name=name, value=found["ratio"], unit="x", better="lower", target=target, note=note)
    found = in_child("child_lidar")
    yield Figure(
        name="observation_lidar2d", value=found["whole"], unit="ms", better="lower", target=0.15,
        note="360 rays, 35 actors within 100 m, without the compiled core",
    )  # fmt: skip


def child_lidar() -> dict[str, float]:
    """The part lidar2d: the actors near ego, and the rays to their outlines."""
    import numpy as np

    from crashhunt.simulators import RayCaster, nearest_actors
    from crashhunt.world import Actor, Roster, Scene

    draw = np.random.default_rng(1)
    roster = Roster(tuple(Actor(str(number), "passenger", 4.5, 1.8) for number in range(36)))
    points = [(0.0, 0.0), *map(tuple, draw.uniform(-65.0, 65.0, (35, 2)).tolist())]
    scene = Scene(0.0, roster, points, draw.uniform(-3.0, 3.0, 36).tolist(), [5.0] * 36)
    caster = RayCaster(360, 100.0)
    spent = []
    for _ in range(20):
        began = time.process_time()
        for _ in range(50):
            near = nearest_actors(scene, 0, hidden=frozenset(), radius=104.5)
            caster.cast(scene, 0, [one.row for one in near])
        spent.append((time.process_time() - began) / 50)
    return {"whole": 1e3 * min(spent)}


TEN_NODES = "always (speed > 8 -> eventually[0:2] (headway_s >= 0.8))"


def child_requirement(scenario: str) -> dict[str, float]:
    """A step of the formula of ten nodes, with its signals and without, and a whole step without a requirement."""
    from crashhunt.agents import KeepLaneWithSpeed
    from crashhunt.episode import Episode, FastEpisode, Nearness, Recorder, TrialSignals
    from crashhunt.oracles import OffRoad, Overlap, ReportedCollision, RequirementOracle
    from crashhunt.recording import BlackBox
    from crashhunt.requirements import Monitor, parse
    from crashhunt.scenario import argument_values, load_scenario
    from crashhunt.sumo import SumoSimulator
    from crashhunt.trial import TrialSpec

    steps, clock, chosen = 1000, time.process_time, load_scenario(scenario)
    with folder() as stage:
        simulator, box = SumoSimulator(chosen, stage), BlackBox(stage / "blackbox.bin")
        arguments = argument_values(chosen)
        spec = TrialSpec(number=0, seed=1, arguments={}, scenario_arguments=arguments, max_steps=steps)

        def whole(*requirements: RequirementOracle) -> float:
            box.begin(pid=os.getpid(), trial=0, started=time.monotonic())
            with FastEpisode(
                spec,
                simulator=simulator,
                make_agent=lambda *_: KeepLaneWithSpeed(10.0),
                oracles=[ReportedCollision(), Overlap(), OffRoad(), *requirements],
                crash_on=(),
                observers=[Recorder(box, simulator), Nearness(box.take_frames)],
            ) as episode:
                result = episode.start()
                began = clock()
                while result is None:
                    result = episode.step()
                return (clock() - began) / max(1, result.steps)

        rounds = [(whole(), whole(RequirementOracle("calm", TEN_NODES))) for _ in range(5)]
        requirement = parse(TEN_NODES)
        with Episode(spec, simulator=simulator, make_agent=lambda *_: KeepLaneWithSpeed(10.0)) as episode:
            episode.start()
            episode.step()
            agent = episode.names[0]
            read = TrialSignals(episode).reader(requirement.signals, agent)

            def monitored() -> float:
                monitor = Monitor(requirement, simulator.step_length_s)
                began = clock()
                for _ in range(steps):
                    monitor.add((10.0, 2.0))
                return (clock() - began) / steps

            began = clock()
            for _ in range(steps):
                read()
            signals = (clock() - began) / steps
            formula = min(monitored() for _ in range(9))
    plain = min(without for without, _ in rounds)
    return {
        "formula": 1e6 * formula, "signals": 1e6 * signals, "whole": 1e6 * plain, "share": 100 * formula / plain,
        "ratio": statistics.median(with_one / without for without, with_one in rounds),
    }  # fmt: skip


def bench_requirement() -> Iterator[Figure]:
    """A requirement with a formula of ten nodes, as a share of a step."""
    for scenario in ("loop", "intersection"):
        found = in_child("child_requirement", scenario)
        note = f"formula {found['formula']:.1f} µs, step without a requirement {found['whole']:.0f} µs"
        name = f"requirement_{scenario}"
        yield Figure(name=f"{name}_share", value=found["share"], unit="%", better="lower", target=3.0, note=note)
        note = "whole trials of 1,000 steps; the compiled core runs the steps, and Python reads two signals"
        yield Figure(name=f"{name}_ratio", value=found["ratio"], unit="x", better="lower", target=1.1, note=note)


def bench_step() -> Iterator[Figure]:
    """A whole step against a bare loop."""
    for scenario in ("loop", "merge", "intersection"):
        found = in_child("child_step", scenario)
        note = f"{found['vehicles']:.0f} vehicles; whole {found['whole']:.0f} µs, bare {found['bare']:.0f} µs"
        target = 1.15 if found["vehicles"] > 40 else 1.6
        yield Figure(
            name=f"step_ratio_{scenario}", value=found["ratio"], unit="x", better="lower", target=target, note=note
        )
        if scenario == "loop":
            for label, value in found.items():
                if label.startswith("part "):
                    yield Figure(
                        name=f"step_{label.removeprefix('part ').replace(' ', '_')}",
                        value=value,
                        unit="µs",
                        better="lower",
                        target=None,
                    )


class _HoldsSpeed:
    """Holds 10 m/s straight ahead, in a form of actions.

    Args:
        form: name of the form.
    """

    def __init__(self, form: str) -> None:
        self._form = form

    def reset(self, seed: int) -> None:
        """Do nothing."""

    def act(self, observation: NDArray[np.float32]) -> object:
        """Return the action."""
        if self._form == "speed_and_lane":
            return 10.0, 0
        wanted = max(-4.0, min(2.0, 10.0 - float(observation[0, 3])))
        return (wanted, 0) if self._form == "acceleration" else (wanted, 0.0)


def child_actions(scenario: str) -> dict[str, float]:
    """A whole step in each form of actions, in turns in one process."""
    from crashhunt.episode import FastEpisode, Nearness, Recorder
    from crashhunt.oracles import OffRoad, Overlap, ReportedCollision
    from crashhunt.recording import BlackBox
    from crashhunt.scenario import argument_values, load_scenario, with_action, with_whole_vehicles_visible
    from crashhunt.sumo import SumoSimulator
    from crashhunt.trial import TrialSpec

    plain = load_scenario(scenario)
    spent: dict[str, list[float]] = {}
    with folder() as stage:
        box = BlackBox(stage / "blackbox.bin")
        spec = TrialSpec(number=0, seed=1, arguments={}, scenario_arguments=argument_values(plain), max_steps=1000)
        for _ in range(7):
            for form in ("speed_and_lane", "acceleration", "acceleration_steering"):
                simulator = SumoSimulator(with_whole_vehicles_visible(with_action(plain, "ego", form)), stage)
                box.begin(pid=os.getpid(), trial=0, started=time.monotonic())
                with FastEpisode(
                    spec,
                    simulator=simulator,
                    make_agent=lambda *_, form=form: _HoldsSpeed(form),
                    oracles=[ReportedCollision(), Overlap(), OffRoad()],
                    crash_on=(),
                    observers=[Recorder(box, simulator), Nearness(box.take_frames)],
                ) as episode:
                    result = episode.start()
                    began = time.process_time()
                    while result is None:
                        result = episode.step()
                    spent.setdefault(form, []).append((time.process_time() - began) / max(1, result.steps))
    usual = spent.pop("speed_and_lane")
    return {
        **{form: statistics.median(map(truediv, seconds, usual)) for form, seconds in spent.items()},
        "usual": 1e6 * min(usual),
    }


def bench_actions() -> Iterator[Figure]:
    """A step in a form of actions against a step with a target speed."""
    found = in_child("child_actions", "motorway")
    for form, target in (("acceleration", 1.05), ("acceleration_steering", 1.3)):
        note = f"against {found['usual']:.0f} µs with a target speed, on motorway"
        yield Figure(name=f"step_{form}", value=found[form], unit="x", better="lower", target=target, note=note)


def child_core(scenario: str) -> dict[str, float]:
    """Whole trials as a hunt runs them, with the compiled core and without, in turns."""
    from dataclasses import replace

    from crashhunt.episode import WorkerSettings
    from crashhunt.scenario import argument_values, load_scenario
    from crashhunt.sumo import SumoSetup
    from crashhunt.trial import TrialSpec

    chosen, rounds, at_once = load_scenario(scenario), 6, 8  # the kernel counts in hundredths of a second
    arguments = {"ego": {"speed": 8.0}} if scenario == "loop" else {}  # of the agents that they name
    spent: dict[tuple[int, bool], list[float]] = {}
    with folder() as scratch:
        slots: dict[bool, Slot] = {}
        for native in (True, False):
            (place := scratch / str(native)).mkdir()
            one = chosen.with_table(replace(chosen.table(SumoSetup), native=None if native else False))
            oracles = ("reported-collision", "overlap", "off-road")
            slots[native] = Slot(WorkerSettings(scenario=one, oracles=oracles, crash_on=(), scratch=place))
        for number in range(rounds + 1):
            for turn, steps in enumerate((85, 600)):
                for native, slot in slots.items():
                    began = slot.cpu_s()
                    for again in range(at_once if number else 1):
                        trial = (2 * number + turn) * at_once + again
                        slot.run(
                            TrialSpec(
                                number=trial,
                                seed=trial,
                                arguments=arguments,
                                scenario_arguments=argument_values(chosen),
                                max_steps=steps,
                            )
                        )
                    if number:  # the first warms everything up
                        spent.setdefault((steps, native), []).append((slot.cpu_s() - began) / at_once)
    found = {f"{steps}_{native}": statistics.median(seconds) for (steps, native), seconds in spent.items()}
    for steps in (85, 600):
        pairs = zip(spent[steps, False], spent[steps, True], strict=True)
        found[f"{steps}_ratio"] = statistics.median(without / with_it for without, with_it in pairs)
    return found


def child_isolation(scenario: str) -> dict[str, float]:
    """Trials in processes of their own against the same ones after each other in one process, in turns."""
    from crashhunt.episode import Parts, WorkerSettings, run_episode
    from crashhunt.recording import BlackBox
    from crashhunt.scenario import AgentSetup, Scenario, argument_values, load_scenario
    from crashhunt.trial import TrialSpec

    toy, rounds = scenario == "toy", 6
    chosen = (
        Scenario(simulator="toy", agents={"ego": AgentSetup(agent="keep-lane")}) if toy else load_scenario(scenario)
    )
    oracles = ("overlap",) if toy else ("reported-collision", "overlap", "off-road")
    arguments, values = {"ego": {"speed": 8.0}}, argument_values(chosen)
    spent: dict[tuple[int, str], list[float]] = {}
    with folder() as scratch:
        settings = WorkerSettings(scenario=chosen, oracles=oracles, crash_on=(), scratch=scratch)
        slot = Slot(settings)  # forked before this process runs anything
        parts = Parts(settings)
        parts.load()
        simulator, box = parts.simulator(), BlackBox(scratch / "box")

        def in_one_process(spec: TrialSpec) -> TrialResult:
            box.begin(pid=os.getpid(), trial=spec.number, started=time.monotonic())
            made = parts.oracles()
            return run_episode(spec, simulator=simulator, make_agent=parts.agent, box=box, oracles=made, crash_on=())

        for number in range(rounds + 1):
            for steps, at_once in ((1, 100),) if toy else ((85, 8), (600, 4)):
                for way, run in (("apart", slot.run), ("together", in_one_process)):
                    began, wall = slot.cpu_s(), time.perf_counter()
                    for again in range(at_once if number else 1):
                        trial = number * 1000 + again
                        run(
                            TrialSpec(
                                number=trial,
                                seed=trial,
                                arguments=arguments,
                                scenario_arguments=values,
                                max_steps=steps,
                            )
                        )
                    if number:  # the first warms everything up
                        spent.setdefault((steps, way), []).append((slot.cpu_s() - began) / at_once)
                        spent.setdefault((steps, f"{way}_wall"), []).append((time.perf_counter() - wall) / at_once)
    return {f"{steps}_{way}": statistics.median(seconds) for (steps, way), seconds in spent.items()}


def bench_isolation() -> Iterator[Figure]:
    """What it costs that every trial has a process of its own."""
    found = in_child("child_isolation", "loop")
    for steps, target in ((85, 1.15), (600, 1.05)):
        apart, together = found[f"{steps}_apart"], found[f"{steps}_together"]
        note = f"{apart * 1e3:.1f} ms of CPU a trial of {steps} steps on loop, {together * 1e3:.1f} ms in one process"
        yield Figure(
            name=f"isolation_loop_{steps}", value=apart / together, unit="x", better="lower", target=target, note=note
        )
    found = in_child("child_isolation", "toy")
    note = f"wall time of a trial of one step of the toy; {found['1_together_wall'] * 1e3:.2f} ms in one process"
    yield Figure(
        name="isolation_toy", value=found["1_apart_wall"] * 1e3, unit="ms", better="lower", target=1.5, note=note
    )


def bench_core() -> Iterator[Figure]:
    """Trials a minute with the compiled core against those without."""
    for scenario in ("loop", "merge", "intersection"):
        found = in_child("child_core", scenario)
        for steps in (85, 600):
            with_it, without = found[f"{steps}_True"], found[f"{steps}_False"]
            note = f"{60 / with_it:.0f} against {60 / without:.0f} trials a minute of CPU time, {steps} steps each"
            yield Figure(
                name=f"core_{scenario}_{steps}",
                value=found[f"{steps}_ratio"],
                unit="x",
                better="higher",
                target=None,
                note=note,
            )


def bench_parallel() -> Iterator[Figure]:
    """Trials a second with two workers against one."""
    ratios = []
    for _ in range(3):
        rates = {}
        for parallel in (1, 2):
            with folder() as place:
                found = hunt(place / "h", parallel, 60, 1000, *QUIET, "--crash-on", "hang")
                rates[parallel] = found["trials_run"] / found["wall_s"]
        ratios.append(rates[2] / rates[1])
    yield Figure(
        name="parallel_speedup",
        value=statistics.median(ratios),
        unit="x",
        better="higher",
        target=1.8,
        note="trials a second, 2 workers to 1",
    )


def child_price() -> dict[str, float]:
    """CPU time of trials of one step that costs nothing, and of forks that exit at once, in turns."""
    from crashhunt.episode import Parts, WorkerSettings
    from crashhunt.scenario import AgentSetup, Scenario
    from crashhunt.trial import TrialSpec

    rounds, at_once = 6, 50
    scenario = Scenario(simulator="toy", agents={"ego": AgentSetup(agent="keep-lane")})
    spent: dict[str, list[float]] = {"trial": [], "fork": []}
    with folder() as scratch:
        settings = WorkerSettings(scenario=scenario, oracles=("overlap",), crash_on=(), scratch=scratch)
        slot = Slot(settings)
        Parts(settings).load()  # so that a fork of this process is as large as one of the zygote
        for number in range(rounds + 1):
            began = slot.cpu_s()
            for again in range(at_once):
                trial = number * at_once + again
                arguments = {"ego": {"speed": 8.0}}
                slot.run(TrialSpec(number=trial, seed=trial, arguments=arguments, scenario_arguments={}, max_steps=1))
            trials_s, before = slot.cpu_s() - began, sum(os.times()[:4])
            for _ in range(at_once):
                if (pid := os.fork()) == 0:
                    os._exit(0)
                os.waitpid(pid, 0)
            if number:  # the first warms everything up
                spent["trial"].append(trials_s / at_once)
                spent["fork"].append((sum(os.times()[:4]) - before) / at_once)
    return {name: statistics.median(seconds) for name, seconds in spent.items()}


def bench_orchestration() -> Iterator[Figure]:
    """What a trial costs besides its steps: against a bare fork, and with few and many trials in the ledger."""
    from crashhunt.ledger import Ledger
    from crashhunt.trial import Outcome, TrialResult, TrialSpec

    price = in_child("child_price")
    note = f"CPU time: {price['trial'] * 1e3:.1f} ms a trial of one free step, {price['fork'] * 1e3:.1f} ms a bare fork"
    yield Figure(
        name="orchestration_forks",
        value=price["trial"] / price["fork"],
        unit="x",
        better="lower",
        target=2.5,
        note=note,
    )
    costs = {}
    for already in (100, 100_000):
        with folder() as place:
            directory = place / "h"
            trials = 4000
            options = ("--scenario", str(_toy(place)), "--seed", "1", "--keep-going")
            hunt(directory, 1, 1, 1, *options)
            (snapshot,) = (directory / "snapshots").iterdir()  # or the hunt refuses trials of other code
            ledger = Ledger(directory / "ledger.sqlite", writable=True)
            ledger._database.execute("BEGIN")
            for number in range(1, already):
                spec = TrialSpec(
                    number=number, seed=number, arguments={"ego": {"speed": 1.0}}, scenario_arguments={}, max_steps=1
                )
                ledger.record(TrialResult(spec, Outcome.SURVIVED, steps=1, wall_s=0.0), snapshot=snapshot.name)
            ledger._database.execute("COMMIT")
            ledger.close()
            few = hunt(directory, 1, already + 1, 1, *options)["wall_s"]
            many = hunt(directory, 1, already + 1 + trials, 1, *options)["wall_s"]
            costs[already] = 1e3 * (many - few) / trials
            note = f"ms of wall time of a trial of one step that costs nothing, {already} trials in the ledger"
            yield Figure(
                name=f"orchestration_{already}", value=costs[already], unit="ms", better="lower", target=None, note=note
            )
    yield Figure(
        name="orchestration_growth",
        value=costs[100_000] / costs[100],
        unit="x",
        better="lower",
        target=1.5,
        note="100,000 against 100 trials",
    )


def bench_waves() -> Iterator[Figure]:
    """Against a process per trial in waves, on short episodes."""
    steps, trials, parallel = 85, 40, 2
    with folder() as place:
        found = hunt(place / "h", parallel, 10 * trials, steps, *QUIET, "--crash-on", "hang")
        ours = found["trials_run"] / found["wall_s"]
    began = time.monotonic()
    for first in range(0, trials, parallel):
        wave = [
            subprocess.Popen([sys.executable, __file__, "--child", "child_trial", str(number), str(steps)],
                             stdout=subprocess.DEVNULL)
            for number in range(first, first + parallel)
        ]  # fmt: skip
        for process in wave:
            if process.wait() != 0:
                raise RuntimeError("a trial of the wave failed")
    theirs = trials / (time.monotonic() - began)
    note = f"{60 * ours:.0f} against {60 * theirs:.0f} trials a minute, {steps} steps each"
    yield Figure(name="waves_ratio", value=ours / theirs, unit="x", better="higher", target=5.0, note=note)


def child_agents(place: str) -> dict[str, float]:
    """A step and a start of an agent that is a program."""
    import bench_agents

    return bench_agents.measure(Path(place))


def child_library(place: str) -> dict[str, float]:
    """CPU time of a step on `loop`: a Python agent that does nothing and such a library drive in turns of 20 steps.

    Both act in the same trial, and their actions are equal. Each turn is compared with the turn before it.
    """
    import bench_agents

    from crashhunt.agents import LibraryFactory
    from crashhunt.episode import FastEpisode, Nearness, Recorder
    from crashhunt.oracles import OffRoad, Overlap, ReportedCollision
    from crashhunt.recording import BlackBox
    from crashhunt.scenario import argument_values, load_scenario
    from crashhunt.sumo import SumoSimulator
    from crashhunt.trial import TrialSpec

    class Nothing:
        def reset(self, seed: int) -> None: ...

        def act(self, observation: object) -> object:
            return 8.0, 0

    rounds, steps, turn, settling, clock = 10, 2000, 20, 2, time.thread_time_ns
    chosen, factory = load_scenario("loop"), LibraryFactory(bench_agents.build_library(Path(place)))

    class InTurns:
        """Passes each turn to another agent, and measures the time from each call to the next one."""

        def __init__(self, *agents: Any) -> None:
            self.agents, self.began, self.step = agents, 0, 0
            self.turns: list[list[int]] = []

        def reset(self, seed: int) -> None:
            for agent in self.agents:
                agent.reset(seed)

        def act(self, observation: object) -> object:
            now, place = clock(), self.step % turn
            if place > settling:
                self.turns[-1].append(now - self.began)
            elif place == 0:
                self.turns.append([])
            agent = self.agents[self.step // turn % 2]
            self.step += 1
            self.began = clock()
            return agent.act(observation)

    taken: tuple[list[float], list[float]] = [], []
    with folder() as stage:
        simulator, box = SumoSimulator(chosen, stage), BlackBox(stage / "blackbox.bin")
        for seed in range(rounds + 1):
            box.begin(pid=os.getpid(), trial=0, started=time.monotonic())
            made: list[InTurns] = []

            def make(name: str, simulator: Any, _: object, made: list[InTurns] = made) -> InTurns:
                made.append(InTurns(Nothing(), factory.agent(name, simulator, {}, folder=stage, files={})))
                return made[-1]

            spec = TrialSpec(
                number=0, seed=seed, arguments={}, scenario_arguments=argument_values(chosen), max_steps=steps
            )
            with FastEpisode(
                spec, simulator=simulator, make_agent=make, crash_on=(),
                oracles=[ReportedCollision(), Overlap(), OffRoad()],
                observers=[Recorder(box, simulator), Nearness(box.take_frames)],
            ) as episode:  # fmt: skip
                result = episode.start()
                while result is None:
                    result = episode.step()
            whole = [statistics.median(one) for one in made[0].turns if len(one) == turn - settling - 1]
            for python_ns, library_ns in zip(whole[::2], whole[1::2], strict=False):
                if seed:  # the first warms everything up
                    taken[0].append(python_ns / 1e9)
                    taken[1].append(library_ns / 1e9)
    python_s, library_s = map(statistics.median, taken)
    more_s = statistics.median(library - python for python, library in zip(*taken, strict=True))
    return {"python_s": python_s, "library_s": library_s, "more_s": more_s, "ratio": 1 + more_s / python_s}


def bench_agents() -> Iterator[Figure]:
    """A step and a start of an agent that is a program, an echo in C; a step of a library that does nothing."""
    with folder() as place:
        found = in_child("child_agents", str(place)) | in_child("child_library", str(place))
    pipes_us, step_us = 1e6 * found["pipes_s"], 1e6 * found["step_s"]
    yield Figure(
        "exec_step", step_us, "µs", "lower", 60.0, f"observe and act of an echo in C; bare pipes took {pipes_us:.3g} µs"
    )
    start_ms = 1e3 * (found["start_s"] - found["step_s"])
    yield Figure("exec_start", start_ms, "ms", "lower", 3.0, "start, hello, reset and close of an echo in C")
    python_us, library_us = 1e6 * found["python_s"], 1e6 * found["library_s"]
    note = (
        f"CPU time of a step on loop: {library_us:.3g} µs with a library, {python_us:.3g} µs with Python, "
        f"{1e6 * found['more_s']:.2g} µs more in pairs"
    )
    yield Figure("lib_step", found["ratio"], "x", "lower", 1.05, note)


def bench_pool() -> Iterator[Figure]:
    """A hunt on highway-fast-v0 against ``multiprocessing.Pool`` on plain highway-env, in turns, 200 steps a trial.

    CPU times depend less on other work of the machine. The limit is the CPU time of the same accelerated steps, each
    trial in a fork, without crashhunt.
    """
    import resource

    import bench_pool as theirs

    def other(*words: str) -> dict[str, float]:
        done = subprocess.run([sys.executable, theirs.__file__, *words], check=True, stdout=subprocess.PIPE)
        found: dict[str, float] = json.loads(done.stdout)
        return found

    def cpu_s() -> float:
        spent = resource.getrusage(resource.RUSAGE_CHILDREN)
        return spent.ru_utime + spent.ru_stime

    ratios, rates, trials_s = [], [], []
    with folder() as place:
        chosen = str(theirs.scenario(place))
        for number in range(3):
            options = ("--scenario", chosen, "--keep-going", "--crash-on", "hang")
            before = cpu_s()
            found = hunt(place / f"h{number}", 2, 600, 200, *options, cwd=place)
            trial_s = (cpu_s() - before) / found["trials_run"]
            ours = 60 * found["trials_run"] / found["wall_s"]
            pool = other("pool", "2", "12", "200")
            rates.append((ours, pool["per_minute"]))
            ratios.append(ours / pool["per_minute"])
            trials_s.append((trial_s, pool["cpu_s"], other("forks", "60", "200")["cpu_s"]))
    low, high = log_interval(ratios)
    ours, plain = (statistics.median(column) for column in zip(*rates, strict=True))
    note = f"95 %: {low:.1f} to {high:.1f}; {ours:.0f} against {plain:.1f} trials a minute"
    yield Figure(
        name="hunt_vs_pool", value=statistics.median(ratios), unit="x", better="higher", target=40.0, note=note
    )
    ms = [1e3 * statistics.median(column) for column in zip(*trials_s, strict=True)]
    for name, better, pairs, against in (
        ("hunt_vs_pool_cpu", "higher", [(pool, ours) for ours, pool, _ in trials_s], f"{ms[1]:.0f} ms in the pool"),
        ("hunt_vs_forks_cpu", "lower", [(ours, forks) for ours, _, forks in trials_s], f"{ms[2]:.1f} ms in bare forks"),
    ):
        quotients = [one / two for one, two in pairs]
        low, high = log_interval(quotients)
        note = f"95 %: {low:.2f} to {high:.2f}; CPU time of a trial: {ms[0]:.1f} ms in a hunt, {against}"
        yield Figure(name=name, value=statistics.median(quotients), unit="x", better=better, target=None, note=note)


def bench_warmup() -> Iterator[Figure]:
    """Trials in a few traffics, from one warm-up of each and from one of their own; and what a copy costs."""
    steps, few, many = 85, 12, 112
    for scenario, target in (("loop", 2.5), ("merge", None)):
        costs: dict[str, list[float]] = {"0": [], "8": []}
        worked: dict[str, list[float]] = {"0": [], "8": []}  # processor time, which a busy machine changes less
        for _ in range(2):
            for copies, spent in costs.items():
                wall_s, cpu_s = [], []
                for trials in (few, many):
                    with folder() as place:
                        options = (*QUIET, "--crash-on", "hang", "--scenario", scenario, "--seeds", "4")
                        before = sum(os.times()[2:4])
                        found = hunt(place / "h", 1, trials, steps, *options, "--warm-copies", copies)
                        wall_s.append(found["wall_s"])
                        cpu_s.append(sum(os.times()[2:4]) - before)
                spent.append((wall_s[1] - wall_s[0]) / (many - few))
                worked[copies].append((cpu_s[1] - cpu_s[0]) / (many - few))
        alone, shared = (statistics.fmean(spent) for spent in costs.values())
        note = (
            f"{60 / shared:.0f} against {60 / alone:.0f} trials a minute on {scenario}, {steps} steps each, one worker"
        )
        yield Figure(
            name=f"warmup_{scenario}", value=alone / shared, unit="x", better="higher", target=target, note=note
        )
        alone, shared = (statistics.fmean(spent) for spent in worked.values())
        note = f"the same in processor time: {1e3 * shared:.0f} against {1e3 * alone:.0f} ms a trial"
        yield Figure(
            name=f"warmup_{scenario}_cpu", value=alone / shared, unit="x", better="higher", target=None, note=note
        )
    found = in_child("child_fork")
    yield Figure(
        name="fork",
        value=found["ms"],
        unit="ms",
        better="lower",
        target=None,
        note="CPU time of a copy on loop, its end included",
    )
    yield Figure(
        name="fork_probe",
        value=found["probe_ms"],
        unit="ms",
        better="lower",
        target=None,
        note="the same, with 50 steps in the copy",
    )
    yield Figure(
        name="fork_alone",
        value=found["alone_ms"],
        unit="ms",
        better="lower",
        target=None,
        note="CPU time of os.fork and os._exit in that process",
    )
    yield Figure(
        name="fork_100_steps",
        value=found["hundred_ms"] - found["steps_ms"],
        unit="ms",
        better="lower",
        target=8.0,
        note=f"CPU time of a copy that runs 100 steps, less these steps ({found['steps_ms']:.1f} ms)",
    )


def bench_first_crash() -> Iterator[Figure]:
    """Steps to the first crash by disturbance, with probes and branches against without; counted, not timed."""
    probes = study("probes")
    found = probes.ratios(probes.measured(("merge",), repetitions=4, most=12000))
    for problem, (pairs, alone, copies, ratio) in found.items():
        note = f"{copies:.0f} against {alone:.0f} steps on {problem}, {pairs} pairs; scripts/studies/run probes"
        yield Figure(name="first_crash", value=ratio, unit="x", better="lower", target=1 / 3, note=note)


def child_fork() -> dict[str, float]:
    """What a copy of an episode costs."""
    from crashhunt.agents import KeepLaneWithSpeed
    from crashhunt.episode import Episode
    from crashhunt.scenario import argument_values, load_scenario
    from crashhunt.sumo import SumoSimulator
    from crashhunt.trial import TrialSpec

    def fork_alone() -> None:
        pid = os.fork()
        if pid == 0:
            os._exit(0)
        os.waitpid(pid, 0)

    scenario, copies = load_scenario("loop"), 50
    found = {}
    with folder() as stage:
        simulator = SumoSimulator(scenario, stage)
        spec = TrialSpec(number=0, seed=1, arguments={}, scenario_arguments=argument_values(scenario), max_steps=1000)
        made = KeepLaneWithSpeed(5.0)
        with Episode(spec, simulator=simulator, make_agent=lambda *_: made, forks=True) as episode:
            episode.start()

            def drive(copy: Episode, steps: int) -> dict[str, object]:
                for _ in range(steps):
                    copy.step()
                return {}

            before = sum(os.times()[:4])
            for _ in range(copies):
                fork_alone()
            found["alone_ms"] = 1e3 * (sum(os.times()[:4]) - before) / copies
            for name, steps in (("ms", 0), ("probe_ms", 50), ("hundred_ms", 100)):
                before = sum(os.times()[:4])
                for _ in range(copies):
                    if episode.fork(partial(drive, steps=steps), observed=False).answer(60.0) is None:
                        raise RuntimeError("a copy failed")
                found[name] = 1e3 * (sum(os.times()[:4]) - before) / copies
            before = sum(os.times()[:4])
            for _ in range(5):
                drive(episode, 100)
            found["steps_ms"] = 1e3 * (sum(os.times()[:4]) - before) / 5
    return found


def child_trial(number: str, steps: str) -> dict[str, float]:
    """One trial as the ancestor runs it: a process that imports, starts SUMO, runs and exits."""
    import libsumo

    from crashhunt.scenario import argument_values, load_scenario
    from crashhunt.sumo import SumoSimulator

    scenario = load_scenario("loop")
    with folder() as stage:
        simulator = SumoSimulator(scenario, stage)
        simulator.reset(seed=int(number), options={"arguments": argument_values(scenario)})
        for _ in range(int(steps)):
            libsumo.vehicle.setSpeed("ego", 5.0)
            libsumo.simulationStep()
        simulator.close()
    return {}


def bench_help() -> Iterator[Figure]:
    """How fast the command line answers."""
    times = []
    for _ in range(7):
        began = time.perf_counter()
        subprocess.run([str(CRASHHUNT), "--help"], stdout=subprocess.DEVNULL, check=True)
        times.append(time.perf_counter() - began)
    yield Figure(
        name="help_s", value=statistics.median(times), unit="s", better="lower", target=0.3, note="crashhunt --help"
    )


def child_projection(first: str, second: str) -> dict[str, float]:
    """Processor time of trials of two scenarios, in turns."""
    from crashhunt.episode import WorkerSettings
    from crashhunt.scenario import argument_values, load_scenario
    from crashhunt.trial import TrialSpec

    rounds, at_once = 9, 8
    spent: dict[str, list[float]] = {first: [], second: []}
    with folder() as scratch:
        slots: dict[str, Slot] = {}
        for name in spent:
            (place := scratch / str(len(slots))).mkdir()
            oracles = ("reported-collision", "overlap", "off-road")
            chosen = load_scenario(name)
            slots[name] = Slot(WorkerSettings(scenario=chosen, oracles=oracles, crash_on=(), scratch=place))
        for number in range(rounds):
            for name in spent if number % 2 else reversed(spent):
                began = slots[name].cpu_s()
                for again in range(at_once):
                    trial = number * at_once + again
                    slots[name].run(
                        TrialSpec(
                            number=trial,
                            seed=trial,
                            arguments={"ego": {"speed": 5.0}},
                            scenario_arguments=argument_values(chosen),
                            max_steps=84,
                        )
                    )
                if number:  # the first warms everything up
                    spent[name].append((slots[name].cpu_s() - began) / at_once)
    return {"ratio": statistics.median(map(float.__truediv__, spent[second], spent[first])),
            "first": statistics.median(spent[first])}  # fmt: skip


def bench_projection() -> Iterator[Figure]:
    """A network with a geographic projection, for which SUMO opens a database, against the same one without."""
    with folder() as place:
        loop = Path(__file__).resolve().parents[2] / "scenarios" / "loop"
        for name in ("flat", "projected"):
            shutil.copytree(loop, place / name)
        net = place / "projected" / "loop.net.xml"
        text = net.read_text()
        if 'projParameter="!"' not in text:
            raise RuntimeError(f"{net} has a projection already")
        projection = 'projParameter="+proj=utm +zone=32 +ellps=WGS84 +datum=WGS84 +units=m +no_defs"'
        net.write_text(text.replace('projParameter="!"', projection))
        found = in_child("child_projection", str(place / "projected"), str(place / "flat"))
    note = f"trials of 84 steps for the same CPU time; {60 / found['first']:.0f} a minute of it with a projection"
    yield Figure(name="projected_network", value=found["ratio"], unit="x", better="higher", target=0.97, note=note)


def bench_replay_cpu() -> Iterator[Figure]:
    """The processor time of a replay from the command line, its children included."""
    import resource

    with folder() as place:
        hunt(place / "h", 2, 300, 600, "--seed", "1")
        spent = []
        for _ in range(7):
            before = resource.getrusage(resource.RUSAGE_CHILDREN)
            subprocess.run([CRASHHUNT, "replay", place / "h"], check=True, stdout=subprocess.DEVNULL)
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            spent.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    yield Figure(
        name="replay_cpu",
        value=statistics.median(spent[1:]),
        unit="s",
        better="lower",
        target=0.6,
        note="crashhunt replay of a crash of loop",
    )


def child_memory(trials: str) -> dict[str, float]:
    """Resident memory of a supervisor and its zygote after a tenth and after all of their trials."""
    from crashhunt.episode import WorkerSettings
    from crashhunt.scenario import argument_values, load_scenario
    from crashhunt.trial import TrialSpec

    scenario = load_scenario("loop")
    with folder() as scratch:
        oracles = ("reported-collision", "overlap", "off-road")
        slot = Slot(WorkerSettings(scenario=scenario, oracles=oracles, crash_on=(), scratch=scratch))
        sizes = {}
        for number in range(1, int(trials) + 1):
            values = argument_values(scenario)
            slot.run(
                TrialSpec(
                    number=number,
                    seed=number,
                    arguments={"ego": {"speed": 8.0}},
                    scenario_arguments=values,
                    max_steps=50,
                )
            )
            if number in (int(trials) // 10, int(trials)):
                pages = sum(
                    int(Path(f"/proc/{pid}/statm").read_text().split()[1]) for pid in (os.getpid(), slot.zygote)
                )
                sizes[number] = pages * os.sysconf("SC_PAGE_SIZE") / 2**20
    first, last = sizes.values()
    return {"first": first, "last": last}


def bench_memory() -> Iterator[Figure]:
    """The memory of a slot over 2,000 trials."""
    found = in_child("child_memory", "2000")
    note = f"{found['first']:.0f} MiB after 200 trials, {found['last']:.0f} MiB after 2,000"
    yield Figure(
        name="worker_memory_growth",
        value=found["last"] / found["first"],
        unit="x",
        better="lower",
        target=1.05,
        note=note,
    )


def bench_bundle() -> Iterator[Figure]:
    """The size of a log."""
    with folder() as place:
        options = ("--agent", "keep-lane", "--arg", "speed=14:18", "--seed", "3", "--crash-on", "collision")
        found = hunt(place / "h", 2, 500, 1500, *options)
        crash = json.loads(next((place / "h" / "crashes").glob("*/crash.json")).read_text())
        size = sum(path.stat().st_size for path in (place / "h" / "crashes").glob("*/log.mcap"))
        note = f"log.mcap with view channels, {crash['step']} steps, trial {crash['trial']} of {found['trials_run']}"
        yield Figure(
            name="log_bytes_per_step",
            value=size / max(1, crash["step"]),
            unit="B",
            better="lower",
            target=None,
            note=note,
        )
        out = place / "crash.zip"
        subprocess.run([CRASHHUNT, "export", place / "h", out], check=True, stdout=subprocess.DEVNULL)
        note = "an exported crash with its snapshot, crashhunt itself in it"
        yield Figure(
            name="export_kib", value=out.stat().st_size / 1024, unit="KiB", better="lower", target=None, note=note
        )


_CRASHES_AMONG_HANGING = """
import re, time


class Agent:
    def __init__(self, number: int = 0):
        self.number = number

    def reset(self, seed): pass

    def act(self, observation):
        if self.number:
            re.match(r"(a+)+$", "a" * 60 + "b")  # in C, holding the interpreter, for ever
        time.sleep(0.02)  # until the others hang
        if observation[0, 1] > 10:
            print("raised at", time.time(), flush=True)
            raise RuntimeError("on purpose")
        return 5.0, 0
"""


def bench_stop() -> Iterator[Figure]:
    """From a crash to every worker stopped and the bundle on disk, while all other workers hang."""
    seconds = []
    for _ in range(3):
        with folder() as place:
            (place / "bench_agent.py").write_text(_CRASHES_AMONG_HANGING)
            words = ["run", "h", "3", "101", "2000", "--agent", "bench_agent:Agent", "--arg", "number=0:100"]
            options = ["--sampler", "grid", "--points", "101", "--set", "vehicles=10", "--json"]
            command = [str(CRASHHUNT), *words, *options]
            subprocess.run(
                command, cwd=place, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, check=True, timeout=120
            )
            crashes = place / "h" / "crashes"
            raised = float(next(crashes.glob("*/run.log")).read_text().split("raised at")[1].split()[0])
            seconds.append(crashes.stat().st_mtime - raised)  # the bundle's folder is renamed into place last
    note = "from the crash to all workers killed and the bundle saved, with two of three workers hung in C"
    yield Figure(
        name="crash_to_saved_s", value=statistics.median(seconds), unit="s", better="lower", target=1.0, note=note
    )


_RAISES_LATE = """
class Agent:
    def reset(self, seed):
        self.step = 0

    def act(self, observation):
        self.step += 1
        if self.step > 2000:
            raise RuntimeError("on purpose")
        return 5.0, 0
"""


def child_replay(directory: str) -> dict[str, float]:
    """Steps a second of a hunt and of the replays of its crash."""
    from crashhunt.crashes import find_bundle
    from crashhunt.ledger import Ledger
    from crashhunt.replays import replay

    bundle = find_bundle(Path(directory))
    began = time.perf_counter()
    results = [replay(bundle).replayed for _ in range(3)]
    whole = (time.perf_counter() - began) / len(results)
    stepping = statistics.median(result.wall_s - result.setup_s for result in results)
    (hunted,) = Ledger(Path(directory) / "ledger.sqlite").results()
    return {"hunt": hunted.wall_s - hunted.setup_s, "replay": stepping, "rest": whole - stepping}


def bench_replay() -> Iterator[Figure]:
    """How fast a replay is."""
    with folder() as place:
        (place / "bench_agent.py").write_text(_RAISES_LATE)
        words = ["run", "h", "1", "1", "2500", "--agent", "bench_agent:Agent", "--seed", "1"]
        subprocess.run([str(CRASHHUNT), *words], cwd=place, stdout=subprocess.DEVNULL, check=True)
        found = in_child("child_replay", str(place / "h"))
    note = f"2,000 steps in {found['replay']:.2f} s; process, warm-up and comparison take {found['rest']:.2f} s"
    yield Figure(
        name="replay_speed",
        value=found["hunt"] / found["replay"],
        unit="of the hunt's",
        better="higher",
        target=0.9,
        note=note,
    )


class Costless:
    """An executor of thousands of workers whose trials cost nothing, so that what is left is the hunt itself."""

    def __init__(self, settings: object, *, parallel: int) -> None:
        self.capacity = parallel
        self._waiting: deque[TrialSpec] = deque()

    def submit(self, spec: TrialSpec) -> None:
        """Queue a trial."""
        self._waiting.append(spec)

    def completed(self, timeout_s: float) -> Iterator[TrialResult]:
        """End as many as run at a time."""
        from crashhunt.trial import Outcome, TrialResult

        for _ in range(min(self.capacity, len(self._waiting))):
            yield TrialResult(self._waiting.popleft(), Outcome.SURVIVED, steps=100, sim_time_s=10.0, digest="0" * 32)

    def cancel(self, *, above: int = -1) -> None:
        """Nothing is left to run."""
        self._waiting.clear()

    def where(self) -> dict[int, object]:
        """Nobody is anywhere."""
        return {}

    def notes(self) -> list[str]:
        """There is nothing to say."""
        return []

    def close(self) -> None:
        """Nothing has been started."""


def bench_ceiling() -> Iterator[Figure]:
    """How many trials a second a hunt can hand out, take back and write down, whoever runs them."""
    spent: dict[int, tuple[float, float]] = {}
    for trials in (100_000, 1_000_000):
        with folder() as place:
            words = ["run", str(place / "h"), "1000", str(trials), "100", "--json", "--seed", "1"]
            words += ["--scenario", str(_toy(place)), "--executor", "bench:Costless"]
            child = subprocess.Popen(
                [str(CRASHHUNT), *words], cwd=Path(__file__).parent, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
            )
            with closing(child.stdout) as output:  # type: ignore[type-var]
                found = json.load(output)  # type: ignore[arg-type]
            _, status, used = os.wait4(child.pid, 0)
            assert (status, found["trials_run"]) == (0, trials)
            child.returncode = 0
            spent[trials] = found["wall_s"], used.ru_maxrss / 1024
    (small, small_memory), (large, memory) = spent[100_000], spent[1_000_000]
    note = f"a million trials; {100_000 / small:.0f} the first hundred thousand"
    yield Figure(name="ceiling", value=1_000_000 / large, unit="trials/s", better="higher", target=5000, note=note)
    note = f"{memory:.0f} MiB at a million trials, {small_memory:.0f} at a hundred thousand"
    yield Figure(
        name="ceiling_memory_growth", value=memory / small_memory, unit="x", better="lower", target=1.1, note=note
    )


def _large_ledger(directory: Path, trials: int) -> None:
    """Grow a hunt to so many trials, by copying those that it has."""
    from crashhunt.ledger import Ledger

    with closing(Ledger(directory / "ledger.sqlite", writable=True)) as ledger:
        rows = [row for _, row in ledger.intact_rows(range(trials)) if row is not None]
        ledger._database.execute("BEGIN")
        for number in range(len(rows), trials):
            ledger.copy((number, *rows[number % len(rows)][1:]))
        ledger._database.execute("COMMIT")
        ledger.note(planned=trials)


def bench_scale() -> Iterator[Figure]:
    """Status, compare and trials over a million trials, against a tenth of them."""
    spent: dict[str, list[tuple[float, float]]] = {}
    for trials in (100_000, 1_000_000):
        with folder() as place:
            options = ("--scenario", str(_toy(place)), "--seed", "1", "--keep-going")
            hunt(place / "a", 2, 500, 20, *options)
            _large_ledger(place / "a", trials)
            for name, words in (
                ("status", ["status", "a"]),
                ("compare", ["compare", "a", "a"]),
                ("trials", ["trials", "a", "--out", "a.csv"]),
            ):
                began = time.perf_counter()
                child = subprocess.Popen(
                    [str(CRASHHUNT), *words], cwd=place, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
                )
                _, status, used = os.wait4(child.pid, 0)
                assert status == 0, words
                child.returncode = 0
                spent.setdefault(name, []).append((time.perf_counter() - began, used.ru_maxrss / 1024))
    for name, limit in (("status", 5.0), ("compare", 10.0), ("trials", 60.0)):
        (small, small_memory), (large, memory) = spent[name]
        note = f"{small:.2f} s for 100,000; {memory:.0f} MiB against {small_memory:.0f}"
        yield Figure(name=f"{name}_million_s", value=large, unit="s", better="lower", target=limit, note=note)
        yield Figure(name=f"{name}_growth", value=large / small / 10, unit="of linear", better="lower", target=1.2)


def bench_panels() -> Iterator[Figure]:
    """The same two panels, drawn by us and by matplotlib."""
    import matplotlib as mpl
    import numpy as np

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    from crashhunt.panels import Curve, Heatmap

    rng = np.random.default_rng(0)
    maps, curves = rng.normal(size=(200, 8, 7)), np.cumsum(rng.normal(size=(200, 100)), axis=1)

    def ours(number: int) -> None:
        Heatmap(maps[number]).draw(label="observation")
        Curve({"speed": curves[number]}).draw(label="speed")

    def theirs(number: int) -> None:
        for kind in ("map", "curve"):
            figure, axes = plt.subplots(figsize=(2.4, 1.6), dpi=100)
            if kind == "map":
                figure.colorbar(axes.imshow(maps[number], aspect="auto"))
            else:
                axes.plot(curves[number], label="speed")
                axes.legend()
            axes.set_title("title")
            figure.canvas.draw()
            np.asarray(figure.canvas.buffer_rgba())  # type: ignore[attr-defined]
            plt.close(figure)

    def per_frame(draw: Callable[[int], None], count: int) -> float:
        draw(0)
        began = time.perf_counter()
        for number in range(count):
            draw(number)
        return (time.perf_counter() - began) / count

    rounds = [(per_frame(theirs, 10), per_frame(ours, 200)) for _ in range(3)]
    ratio = statistics.median(slow / fast for slow, fast in rounds)
    note = f"a heatmap and a curve in {1000 * rounds[0][1]:.2f} ms; matplotlib takes {1000 * rounds[0][0]:.0f} ms"
    yield Figure(name="panels_vs_matplotlib", value=ratio, unit="x", better="higher", target=20.0, note=note)


def child_accelerator(name: str, vehicles: str, rounds: str, how: str = "") -> dict[str, float]:
    """Steps a second of CPU time on highway-env without and with the accelerator, in turns; IDLE or random actions.

    ``how`` is ``episodes`` (of five steps, with their resets), ``road`` or ``neighbours`` (a class of roads of a user's
    own, which overrides nothing of interest, or the search for neighbours), or nothing.
    """
    import warnings

    import gymnasium
    import highway_env
    from highway_env.road.road import Road

    from crashhunt.highway.accelerator import switch_off, switch_on

    warnings.simplefilter("ignore")
    assert highway_env
    config = {"duration": float("inf")} | ({"vehicles_count": int(vehicles)} if int(vehicles) else {})

    class Own(Road):  # type: ignore[misc]
        pass

    class OwnNeighbours(Road):  # type: ignore[misc]
        def neighbour_vehicles(self, vehicle: Any, lane_index: Any = None) -> Any:
            return super().neighbour_vehicles(vehicle, lane_index)

    def episodes(env: Any, seed: int) -> float:
        spent, steps = 0.0, 0
        while spent < 0.6 or steps < 10:
            began = time.process_time()
            env.reset(seed=seed + steps, options={"config": config})
            for _ in range(5):
                env.step(1)
            spent, steps = spent + time.process_time() - began, steps + 5
        return steps / spent

    def rate(seed: int) -> float:
        env: Any = gymnasium.make(name, disable_env_checker=True).unwrapped
        if how == "episodes":
            return episodes(env, seed)
        env.reset(seed=seed, options={"config": config})
        if how:
            env.road.__class__ = {"road": Own, "neighbours": OwnNeighbours}[how]
        env.action_space.seed(seed)
        spent, steps = 0.0, 0
        while spent < 0.6 or steps < 2:
            action = 1 if hasattr(env.action_space, "n") else env.action_space.sample()
            began = time.process_time()
            _, _, terminated, _, _ = env.step(action)
            spent, steps = spent + time.process_time() - began, steps + 1
            if terminated:
                seed += 1
                env.reset(seed=seed)
        return steps / spent

    slow, fast = [], []
    for number in range(int(rounds)):
        switch_off()
        slow.append(rate(100 * number))
        reason = switch_on()
        assert not reason, reason
        fast.append(rate(100 * number))
    ratios = [two / one for one, two in zip(slow, fast, strict=True)]
    low, high = log_interval(ratios)
    speeds = {"slow": statistics.median(slow), "fast": statistics.median(fast)}
    return {"ratio": statistics.median(ratios), "low": low, "high": high, **speeds}


def log_interval(ratios: list[float]) -> tuple[float, float]:
    """The 95 % interval of the mean of the logarithms of three to seven ratios, by Student's t."""
    quantile = {3: 4.303, 4: 3.182, 5: 2.776, 6: 2.571, 7: 2.447}[len(ratios)]
    logarithms = [math.log(ratio) for ratio in ratios]
    centre, half = statistics.mean(logarithms), quantile * statistics.stdev(logarithms) / math.sqrt(len(ratios))
    return math.exp(centre - half), math.exp(centre + half)


ACCELERATED = (
    ("highway-v0", 120.0), ("highway-fast", 40.0), ("merge", 10.0), ("roundabout", 10.0), ("exit", 10.0),
    ("intersection", 10.0),
)  # fmt: skip


def bench_accelerator() -> Iterator[Figure]:
    """highway-env with the accelerator against highway-env as it is, in turns within one process."""
    import gymnasium
    import highway_env

    assert highway_env

    def figure(name: str, found: dict[str, float], target: float | None = None) -> Figure:
        note = (
            f"95 %: {found['low']:.2f} to {found['high']:.2f}; {found['slow']:.1f} steps/s become {found['fast']:.0f}"
        )
        return Figure(
            name=f"accelerated_{name}", value=found["ratio"], unit="x", better="higher", target=target, note=note
        )

    for how, *names in (
        ("episodes", "highway-v0", "highway-fast-v0", "merge-v0"), ("road", "highway-v0"), ("neighbours", "highway-v0"),
    ):  # fmt: skip
        for name in names:
            yield figure(f"{name}_{how}", in_child("child_accelerator", name, "0", "3", how))
    names = [name for name, spec in gymnasium.registry.items() if str(spec.entry_point).startswith("highway_env")]
    every: dict[str, dict[str, float]] = {}
    for name in sorted(names):
        every[name] = in_child("child_accelerator", name, "0", "5")
        yield figure(name, every[name], next((least for start, least in ACCELERATED if name.startswith(start)), None))
    worst = min(every, key=lambda name: every[name]["low"])
    note = f"the lower end of {worst}, {every[worst]['ratio']:.2f}"
    yield Figure(name="accelerated_least", value=every[worst]["low"], unit="x", better="higher", target=1.0, note=note)
    median = statistics.median(found["ratio"] for found in every.values())
    note = f"of {len(every)} environments"
    yield Figure(name="accelerated_median", value=median, unit="x", better="higher", target=8.0, note=note)
    counts = {count: in_child("child_accelerator", "highway-v0", str(count), "3") for count in (20, 200)}
    growth = {which: counts[20][which] / counts[200][which] for which in ("slow", "fast")}
    note = f"without it {growth['slow']:.0f}; at 200 vehicles it is {counts[200]['ratio']:.0f} times as fast"
    yield Figure(
        name="accelerated_time_of_10_times_the_vehicles",
        value=growth["fast"],
        unit="x",
        better="lower",
        target=None,
        note=note,
    )


def bench_report() -> Iterator[Figure]:
    """How long the page takes to draw a step, with 200 actors and 3,000 steps, in a real browser."""
    program, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if program is None or driver is None:
        print("scripts/bench: report needs chromium and chromedriver, and is left out", file=sys.stderr)
        return
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    with folder() as place:
        hunt(place / "h", 1, 1, 1, "--scenario", str(_toy(place)), "--crash-on", "hang")
        _large_bundle(place / "h", actors=200, steps=3000)
        subprocess.run([CRASHHUNT, "report", place / "h"], check=True, stdout=subprocess.DEVNULL)
        options = webdriver.ChromeOptions()
        options.binary_location = program
        for word in ("--headless=new", "--no-sandbox", "--disable-gpu", "--window-size=1280,1600"):
            options.add_argument(word)
        browser = webdriver.Chrome(options=options, service=Service(driver))
        try:
            browser.get((place / "h" / "report.html").as_uri())
            time.sleep(3)
            drawn = browser.execute_script(
                "const began = performance.now();"
                "for (let n = 0; n < 300; n++) { go(n * 7); "
                "document.getElementById('scene').getContext('2d').getImageData(0, 0, 1, 1); }"
                "return (performance.now() - began) / 300;"
            )
        finally:
            browser.quit()
        size = (place / "h" / "report.html").stat().st_size / 2**20
    note = f"200 actors, 3,000 steps, without a GPU; the page has {size:.0f} MiB"
    yield Figure(name="report_draw_ms", value=drawn, unit="ms", better="lower", target=16.7, note=note)


def _large_bundle(directory: Path, *, actors: int, steps: int) -> None:
    """A made-up crash with so many actors and steps."""
    import numpy as np

    from crashhunt.base.layout import BLACK_BOX
    from crashhunt.crashes import write_bundle
    from crashhunt.recording import AgentChannel, BlackBox, Prologue, Tag, digest_of, encode_actors
    from crashhunt.trial import Collision, Outcome, TrialResult, TrialSpec
    from crashhunt.world import Actor, Roster, Scene

    scratch = directory / "scratch"
    scratch.mkdir()
    box = BlackBox(scratch / BLACK_BOX)
    box.begin(pid=1, trial=0, started=0.0)
    box.prologue(
        Prologue(
            (
                AgentChannel(
                    id="ego",
                    observation_dtype="<f4",
                    observation_shape=(1,),
                    action_dtype="<f8",
                    action_shape=(1,),
                    action_names=("speed",),
                ),
            ),
            0.1,
        ).encode(),
        1,
    )
    roster = Roster(
        tuple(Actor(id=f"car {n}" if n else "ego", kind="passenger", length=4.5, width=1.8) for n in range(actors))
    )
    box.append(Tag.ACTORS, 0, encode_actors(roster.actors))
    box.append(Tag.ROSTER, 0, np.arange(actors, dtype="<u4").tobytes())
    rng = np.random.default_rng(0)
    place, speeds = rng.uniform(-100, 100, (actors, 2)), rng.uniform(5, 20, actors)
    for step in range(steps + 1):
        if step:
            box.observation(0, np.zeros(1, "<f4"))
            box.action(0, np.ones(1))
        points = [(float(x + speed * step / 10), float(y)) for (x, y), speed in zip(place, speeds, strict=True)]
        box.step(step, Scene(step / 10, roster, points, [0.0] * actors, speeds.tolist()), (0.0,))
    collision = Collision(agent="ego", role="collider", collider="ego", victim="car 1", seen_by=("overlap",))
    spec = TrialSpec(number=0, seed=1, arguments={"ego": {}}, scenario_arguments={}, max_steps=steps)
    digest = digest_of([box.committed()])
    result = TrialResult(spec, Outcome.COLLISION, steps=steps, digest=digest, collision=collision)
    snapshot = next((directory / "snapshots").iterdir()).name
    write_bundle(directory, result, scratch, hunt_seed=0, snapshot=snapshot, lanes=[])


def bench_search() -> Iterator[Figure]:
    """Trials to the first crash, guided against random; `scripts/studies/run search` has all samplers and problems."""
    search = study("search")
    from problems import PROBLEMS
    from search_plot import costs

    count = 10
    runs = search.all_runs(
        ("random", "guided"), range(search.FIRST_SEED, search.FIRST_SEED + count), tuple(PROBLEMS), 2
    )
    note = f"mean of {count} hunts; random draws by calculation: 1"
    rare = []
    for name, row in costs(list(runs)).items():
        problem = PROBLEMS[name]
        if problem.hint and problem.rate <= 1 / 200:
            rare.append(row["guided"])
        yield Figure(
            name=f"guided, {name}: one in {1 / problem.rate:.0f}",
            value=row["guided"],
            unit="x",
            better="lower",
            target=1.2,
            note=note,
        )
    mean = statistics.geometric_mean(rare)
    yield Figure(
        name="guided, one in 200 and rarer, with a hint",
        value=mean,
        unit="x",
        better="lower",
        target=1 / 3,
        note="geometric mean of the above",
    )


def _toy(place: Path) -> Path:
    scenario = place / "toy"
    scenario.mkdir(exist_ok=True)
    (scenario / "scenario.toml").write_text(
        'schema = 1\nsimulator = "toy"\n[agents.ego]\nagent = "crashhunt.agents:KeepLaneWithSpeed"\n'
        '[agents.ego.arguments.speed]\ndefault = 1.0\nrange = "1:2"\n'
    )
    return scenario


def bench_ray() -> Iterator[Figure]:
    """What hunts on Ray cost, against hunts on one machine."""
    import bench_ray as ray

    with ray.cluster(head=2) as address:
        pairs = 16
        found = ray.in_child("child_rate", address, str(pairs))
        for figure, what in (
            ("wall", "trials a second"),
            ("cpu", "trials for a second of CPU, Ray's processes included"),
        ):
            one = found[figure]
            note = (
                f"{what}: {1 / one['ray']:.2f} against {1 / one['pool']:.2f}; median of {pairs} pairs in turns, "
                f"{one['interval'][0]:.3f} to {one['interval'][1]:.3f} (95 %); load {found['load']:.1f}"
            )
            yield Figure(
                name="ray_rate" if figure == "wall" else "ray_cpu",
                value=one["ratio"],
                unit="of the pool's",
                better="higher",
                target=0.95,
                note=note,
            )
    with ray.cluster(2) as address:
        found = ray.in_child("child_wire", address)
        note = f"a trial that costs nothing; besides, {found['idle']:.0f} B a second and node"
        yield Figure(name="ray_bytes_a_trial", value=found["trial"], unit="B", better="lower", target=None, note=note)
        note = "CPU of the bridge, with Ray in it, for each trial, where they come one by one"
        yield Figure(name="ray_bridge_ms_a_trial", value=found["ms"], unit="ms", better="lower", target=None, note=note)
        for name, executor in (("pool", "pool"), ("running", f"ray:{address}"), ("own", "ray:local")):
            found = ray.first_trial("--executor", executor)
            note = f"from the command to its first trial; {found['cpu']:.1f} s of CPU and {found['mb']:.0f} MB in all"
            yield Figure(
                name=f"ray_first_trial_{name}", value=found["first"], unit="s", better="lower", target=None, note=note
            )
    with ray.cluster(2, 2, 2, 2) as address:
        found = ray.stopped(address, "8")
        note = (
            f"from a crash to the last step of {found['running']:.0f} trials on 4 nodes; load {os.getloadavg()[0]:.1f}"
        )
        yield Figure(name="ray_crash_to_stop_s", value=found["last"], unit="s", better="lower", target=1.0, note=note)


def bench_dashboard() -> Iterator[Figure]:
    """What the dashboard costs: a million trials, 200 hunts, a hunt that runs, a crash that plays."""
    if shutil.which("chromium") is None or shutil.which("chromedriver") is None:
        print("scripts/bench: dashboard needs chromium and chromedriver, and is left out", file=sys.stderr)
        return
    import bench_dashboard as board

    load = f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores"
    pages, memory, idle = {}, {}, {}
    with folder() as place:
        for trials in (10_000, 1_000_000):
            made = board.make_hunt(place, str(trials), trials)
            with board.browser(place) as opened:  # the first page of a browser pays for its start
                with board.dashboard(made) as (url, _):
                    board.page_complete_s(opened, f"{url}/hunts/{board.get(f'{url}/api/hunts')[1]['ids'][0]}")
                with board.dashboard(made) as (url, pid):
                    identifier = board.identifier_of(made)
                    pages[trials] = board.page_complete_s(opened, f"{url}/hunts/{identifier}")
                    idle[trials] = board.idle_refresh(pid, f"{url}/api/hunts/{identifier}")
                    memory[trials] = board.memory_mib(pid)
        note = f"{pages[10_000]:.2f} s with 10,000; from the request until all is drawn; {load}"
        yield Figure(
            name="dashboard_million_s", value=pages[1_000_000], unit="s", better="lower", target=1.5, note=note
        )
        note = f"{memory[1_000_000]:.0f} MiB against {memory[10_000]:.0f} with 10,000"
        growth = memory[1_000_000] / memory[10_000]
        yield Figure(name="dashboard_memory", value=growth, unit="times", better="lower", target=1.2, note=note)
        note = f"CPU of the server; {idle[10_000]:.2f} ms with 10,000 trials"
        yield Figure(name="dashboard_idle_ms", value=idle[1_000_000], unit="ms", better="lower", target=5.0, note=note)
    with folder() as place:
        made = board.make_hunt(place, "hunt", 100)
        for number in range(200):
            shutil.copytree(made, place / "all" / f"hunt-{number}")
        with board.dashboard(place / "all") as (url, _):
            began = time.perf_counter()
            assert len(board.get(f"{url}/api/hunts")[1]["hunts"]) == 200
            listed = time.perf_counter() - began
    yield Figure(name="dashboard_200_hunts_s", value=listed, unit="s", better="lower", target=1.0, note=load)
    with folder() as place:
        ratios = board.with_and_without_page(place, 6)
    note = f"trials/s with the page of a hunt open by those without; median of {len(ratios)} pairs in turns; {load}"
    value = statistics.median(ratios)
    yield Figure(name="dashboard_hunt_speed", value=value, unit="times", better="higher", target=0.97, note=note)
    with folder() as place:
        hunt(place / "h", 1, 1, 1, "--scenario", str(_toy(place)), "--crash-on", "hang")
        _large_bundle(place / "h", actors=200, steps=3000)
        with board.dashboard(place / "h") as (url, _), board.browser(place) as opened:
            crash = next((place / "h" / "crashes").iterdir()).name
            rate = board.frames_per_second(opened, f"{url}/hunts/{board.identifier_of(place / 'h')}/crashes/{crash}")
            drawn = board.draw_ms(opened)
    note = f"drawn while it plays, 3,000 steps and 200 actors without a GPU; a step takes {drawn:.1f} ms; {load}"
    yield Figure(name="dashboard_frames", value=round(rate, 1), unit="/s", better="higher", target=60.0, note=note)


def bench_training() -> Iterator[Figure]:
    """Environment steps a second in training: accelerated highway-env, episodes before crashes, and SUMO."""
    import bench_training as training

    def child(function: str, *words: str) -> dict[str, float]:
        done = subprocess.run(
            [sys.executable, training.__file__, function, *words], check=True, stdout=subprocess.PIPE,
            env={**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
        )  # fmt: skip
        found: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
        return found

    load = f"load {os.getloadavg()[0]:.1f}"
    for name, steps in (("highway-v0", "64"), ("highway-fast-v0", "256")) if training.has("stable_baselines3") else ():
        found = child("child_ppo", name, steps, "3")
        note = (
            f"PPO, steps/s with gradient steps: {found['slow']:.1f} become {found['fast']:.0f}; 3 pairs in turns, "
            f"{found['low']:.1f} to {found['high']:.1f}; {load}"
        )
        yield Figure(
            name=f"training_ppo_{name}", value=found["ratio"], unit="x", better="higher", target=None, note=note
        )
    found = child("child_crashes", "5")
    note = (
        f"steps/s of Crashes-v0 with resets: {found['slow']:.0f} in plain episodes, {found['fast']:.0f} in those "
        f"before crashes; 5 pairs in turns, {found['low']:.2f} to {found['high']:.2f}; {load}"
    )
    yield Figure(name="training_crashes", value=found["ratio"], unit="x", better="higher", target=None, note=note)
    if training.has("sumo_rl", "sumo"):
        pairs = [(child("child_sumo_rl", "1500")["rate"], child("child_sumo", "1500")["rate"]) for _ in range(3)]
        ratios = [ours / theirs for theirs, ours in pairs]
        note = (
            f"steps/s of SUMO-v0 {statistics.median(ours for _, ours in pairs):.0f}, of sumo-rl through libsumo "
            f"{statistics.median(theirs for theirs, _ in pairs):.0f}, without resets; same net, traffic and step of "
            f"1 s; sumo-rl drives the lights; {min(ratios):.2f} to {max(ratios):.2f}; {load}"
        )
        yield Figure(
            name="training_sumo", value=statistics.median(ratios), unit="x", better="higher", target=None, note=note
        )


BENCHES: dict[str, Callable[[], Iterator[Figure]]] = {
    "observation": bench_observation,
    "step": bench_step,
    "requirement": bench_requirement,
    "actions": bench_actions,
    "core": bench_core,
    "isolation": bench_isolation,
    "projection": bench_projection,
    "replay-cpu": bench_replay_cpu,
    "parallel": bench_parallel,
    "orchestration": bench_orchestration,
    "ceiling": bench_ceiling,
    "waves": bench_waves,
    "pool": bench_pool,
    "agents": bench_agents,
    "warmup": bench_warmup,
    "first_crash": bench_first_crash,
    "help": bench_help,
    "memory": bench_memory,
    "bundle": bench_bundle,
    "stop": bench_stop,
    "replay": bench_replay,
    "panels": bench_panels,
    "scale": bench_scale,
    "report": bench_report,
    "dashboard": bench_dashboard,
    "ray": bench_ray,
    "accelerator": bench_accelerator,
    "training": bench_training,
    "search": bench_search,
}


def main() -> int:
    """Measure and print."""
    if sys.argv[1:2] == ["--child"]:
        print(json.dumps(globals()[sys.argv[2]](*sys.argv[3:])))
        return 0
    parser = argparse.ArgumentParser("scripts/bench", description="Measure what crashhunt promises.")
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"some of {', '.join(BENCHES)}; default: all")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    for name in options.names:
        if name not in BENCHES:
            print(f"scripts/bench: there is no {name!r}; give some of {', '.join(BENCHES)}", file=sys.stderr)
            return 2
    if shutil.which(str(CRASHHUNT)) is None:
        print(f"scripts/bench: {CRASHHUNT} is not there; run scripts/bench, not bench.py", file=sys.stderr)
        return 2
    figures = []
    console = Console(stderr=True)
    for name in options.names or BENCHES:
        with console.status(f"measuring {name}"):
            figures += list(BENCHES[name]())
    if options.json:
        print(json.dumps({"results": [asdict(figure) for figure in figures]}))
        return 0
    table = Table("figure", "value", "target", "", "how")
    for figure in figures:
        sign = "≤" if figure.better == "lower" else "≥"
        target, met = "", ""
        if figure.target is not None:
            target = f"{sign} {figure.target:g}"
            good = figure.value <= figure.target if figure.better == "lower" else figure.value >= figure.target
            met = "met" if good else "MISSED"
        table.add_row(figure.name, f"{figure.value:.3g} {figure.unit}", target, met, figure.note)
    Console().print(table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
