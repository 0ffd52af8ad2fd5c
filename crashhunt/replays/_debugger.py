"""Debugging of a replay up to a step: pdb inside the agent, the simulator's window (``--gui``), and agent panels."""

from __future__ import annotations

import builtins
import fcntl
import json
import os
import pdb
import random
import signal
import stat
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn, TextIO, TypedDict, cast, final

import numpy as np

from crashhunt.agents import DrawsPanels
from crashhunt.base import layout
from crashhunt.base.errors import CrashhuntError, UsageError
from crashhunt.base.foreign_code import supports
from crashhunt.base.forks import threads
from crashhunt.base.processes import die_with
from crashhunt.base.reaper import Kept
from crashhunt.base.signals import is_sent_from_outside
from crashhunt.base.temporary import temporary_folder
from crashhunt.episode import Observer, Parts, WorkerSettings, run_episode, seal
from crashhunt.executors import snapshot_environment
from crashhunt.oracles import RequirementOracle
from crashhunt.panels import Curve, labelled, scope
from crashhunt.recording import BlackBox, Recording, read_black_box
from crashhunt.render import explanation, save_meanings, save_panels
from crashhunt.simulators import HasWindow, NamesMetaActions
from crashhunt.trial import Outcome, TrialResult, TrialSpec

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from crashhunt.agents import Agent
    from crashhunt.base.codec import JsonObject
    from crashhunt.base.json_types import ErrorData
    from crashhunt.episode import ObservedEpisode
    from crashhunt.replays._prepare import Look, Rerun
    from crashhunt.simulators import Simulator
    from crashhunt.world import Scene


# Backwards in the debugger: before each of the last steps, a copy of the process waits for the user to go back.
#
# The debugger continues in a fork while the process waits for its end. If the fork ends in order to go back, the
# process gets the terminal again. So the user finds the exact earlier state, without effects of later steps.

_MAX_STEPS_BACK = 50  # steps; what has changed since is kept for each
_BACK_EXIT_CODE = 78  # exit code
_TARGET = "back"


class Backwards(Observer):
    """Observer that forks the process before each of the last steps, so that the debugger can go back to these steps.

    This observer must be registered before the debugger.

    Args:
        stop: the observer that stops the replay.
        step: the step in which the replay stops; 0 for none.
        folder: folder through which the forks exchange the step to go back to.
    """

    def __init__(self, stop: _Stop, step: int, folder: Path) -> None:
        self._stop = stop
        self._last = step
        self._file = folder / _TARGET
        self._first = 0  # the earliest step to which the user may go back; 0 for none

    def scene(self, step: int, scene: Scene, rewards: tuple[float, ...]) -> None:
        if max(1, self._last - _MAX_STEPS_BACK) <= step + 1 < self._last:
            self._leave_behind(step + 1)

    def go(self, step: int) -> str:
        """Go back to a step; if that is impossible, return the reason."""
        if not self._first or step < self._first:
            how = f"to step {self._first} at most" if self._first else "nowhere from here"
            return f"it goes back {how}"
        self._file.write_text(str(step), encoding="ascii")
        sys.stdout.flush()
        os._exit(_BACK_EXIT_CODE)

    def _leave_behind(self, step: int) -> None:
        """Continue in a fork; return in this process only if the user goes back to the given step."""
        torch = sys.modules.get("torch")
        if len(threads()) > 1 or (torch is not None and torch.cuda.is_initialized()):
            self._first = 0  # they have no copy, and what was left behind before is not missed by anybody
            return
        places, drawn, here = _file_positions(), random.getstate(), os.getpid()
        sys.stdout.flush()
        pid = os.fork()
        if pid == 0:
            random.setstate(drawn)  # Python re-seeds the generator in a fork
            die_with(here)
            self._first = self._first or step
            return
        before = signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C must reach only the process with the terminal
        code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        signal.signal(signal.SIGINT, before)
        if code != _BACK_EXIT_CODE:
            _exit_with(code)
        target = int(self._file.read_text(encoding="ascii"))
        if target != step:
            os._exit(_BACK_EXIT_CODE)
        for descriptor, place in places.items():  # which the copy has read further
            with suppress(OSError):
                os.lseek(descriptor, place, os.SEEK_SET)
        self._stop.stop_at(step)
        self._last = step


class OneLine:
    """Replacement for standard input that reads one line at a time, so that the next process can read the rest."""

    encoding = "utf-8"

    def readline(self) -> str:
        """Return the next line; empty at the end of the input."""
        line = b""
        while not line.endswith(b"\n") and (byte := os.read(0, 1)):
            line += byte
        return line.decode("utf-8", "replace")


def _file_positions() -> dict[int, int]:
    """Return the read positions of this process in its open files."""
    found = {}
    for name in os.listdir("/proc/self/fd"):  # noqa: PTH208 - names are enough
        with suppress(OSError):
            read = fcntl.fcntl(int(name), fcntl.F_GETFL) & os.O_ACCMODE == os.O_RDONLY
            if int(name) > 2 and read and stat.S_ISREG(os.fstat(int(name)).st_mode):
                found[int(name)] = os.lseek(int(name), 0, os.SEEK_CUR)
    return found


def _exit_with(code: int) -> NoReturn:
    """End this process as the fork ended: with the same exit code or signal."""
    if code < 0:
        with suppress(OSError, ValueError):
            signal.signal(-code, signal.SIG_DFL)
        os.kill(os.getpid(), -code)
    os._exit(code)


_LEFT_EXIT_CODE = 77  # exit code
_MAX_ATTEMPTS = 3  # of a replay that is killed from outside


class _ReplayKilledError(CrashhuntError):
    """Another process or the kernel killed the process of a replay."""


def debug(rerun: Rerun, look: Look) -> tuple[TrialResult, Recording]:
    """Run the first steps of a crash in a new process that uses this process's terminal.

    Breakpoints in the agent's code work in the new process, and its output appears immediately.

    Raises:
        UsageError: there is no display for a window.
        CrashhuntError: the crash could not be run.
        KeyboardInterrupt: the user left the debugger or closed the window.
    """
    if look.window is not None and not os.environ.get("DISPLAY"):
        raise UsageError("a window needs a display, but DISPLAY is not set", fix="log in with ssh -X, or give --video")
    # A user who sits at the debugger or at a window may have killed it, and begins again on purpose only.
    attempts = 1 if look.stop_at or look.window is not None else _MAX_ATTEMPTS
    for _ in range(attempts - 1):
        try:
            return _run_once(rerun, look)
        except _ReplayKilledError as error:
            print(f"{error.message}; crashhunt runs it again", file=sys.stderr, flush=True)
    return _run_once(rerun, look)


def _run_once(rerun: Rerun, look: Look) -> tuple[TrialResult, Recording]:
    """Run the first steps of a crash in a new process, without another attempt.

    Raises:
        _ReplayKilledError: the process was killed from outside.
        CrashhuntError: the crash could not be run.
        KeyboardInterrupt: the user left the debugger or closed the window.
    """
    collision = rerun.bundle.result.collision
    involved = {collision.collider, collision.victim} if collision is not None else set()
    with temporary_folder("debug") as scratch:
        settings = replace(rerun.worker, scratch=scratch)
        job: _Job = {
            "settings": settings.to_json(),
            "spec": replace(rerun.spec, max_steps=look.until).to_json(),
            "stop_at": look.stop_at,
            "agent": rerun.bundle.driver,
            "other": next(iter(involved - {rerun.bundle.driver}), ""),
            "panels": (look.panels[0], str(look.panels[1].resolve())) if look.panels is not None else None,
            "window": look.window,
            "pause_before": min(look.until, max(1, rerun.bundle.result.steps)),
        }
        (scratch / layout.JOB).write_text(json.dumps(job), encoding="utf-8")
        with (scratch / "log").open("wb") as log:
            kept = Kept(
                __name__,
                [str(scratch)],
                environment=snapshot_environment(settings),
                apart=False,
                # A debugger whose prompt is not shown would wait for input without end.
                stdin=subprocess.DEVNULL if look.quiet else None,
                stdout=log if look.quiet else 2 if look.to_stderr else None,
                stderr=log if look.quiet else None,
            )
        try:
            code = kept.process.wait()
        finally:
            kept.end()
        if code == _LEFT_EXIT_CODE:
            raise KeyboardInterrupt
        if look.window is not None and code < 0:
            # sumo-gui does not always survive being closed in the middle of a step.
            print(f"the window was closed, with signal {-code}", file=sys.stderr)
            raise KeyboardInterrupt
        try:
            answer: ErrorData | _Done = json.loads((scratch / layout.ANSWER).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            ended = f"signal {-code}" if code < 0 else f"exit code {code}"
            last = (scratch / "log").read_text(encoding="utf-8", errors="replace").strip().rpartition("\n")[2]
            kind = _ReplayKilledError if is_sent_from_outside(code) else CrashhuntError
            raise kind(
                f"the process of the replay ended before the last step, with {ended}{last and f': {last}'}",
                where=rerun.bundle.id,
            ) from None
        if "error" in answer:
            raise CrashhuntError.from_json(answer)
        return TrialResult.from_json(answer["result"]), Recording(read_black_box(scratch / layout.BLACK_BOX))


class _Stop(Observer):
    """Observer that replaces an agent, for one step, by an agent in which the debugger stops.

    Args:
        name: name of the vehicle.
        step: the step in which the debugger stops; 0 for none.
    """

    def __init__(self, name: str, step: int) -> None:
        self._name = name
        self._step = step
        self.backwards: Backwards | None = None

    def begin(self, episode: ObservedEpisode) -> None:
        self._episode = episode

    def stop_at(self, step: int) -> None:
        """Choose another step in which the debugger stops."""
        self._step = step

    def scene(self, step: int, scene: Scene, rewards: tuple[float, ...]) -> None:
        agents = self._episode.agents
        if step + 1 == self._step and self._name in agents:
            agents[self._name] = _Stopped(agents[self._name], self._name, self._step, scene, self.backwards)
        elif step == self._step and isinstance(stopped := agents.get(self._name), _Stopped):
            agents[self._name] = stopped.agent

    def end(self, result: TrialResult) -> TrialResult:
        if isinstance(stopped := self._episode.agents.get(self._name), _Stopped):
            self._episode.agents[self._name] = stopped.agent  # which is closed now
        return result


class _Stopped:
    """An agent whose next call of ``act`` stops in the debugger."""

    def __init__(self, agent: Agent, name: str, step: int, scene: Scene, backwards: Backwards | None) -> None:
        self._backwards = backwards
        self.agent = agent
        self._name = name
        self._step = step
        self._scene = scene

    def reset(self, seed: int) -> None:
        self.agent.reset(seed)

    def act(self, observation: object) -> object:
        # At hand in the debugger, whatever the agent calls its own.
        for name, value in (
            ("agent", self.agent), ("observation", observation), ("scene", self._scene), ("step", self._step),
        ):  # fmt: skip
            setattr(builtins, name, value)
        print(f"step {self._step}, {self._name}: at hand are agent, observation, scene and step", flush=True)
        debugger = _Debugger()
        debugger.step, debugger.backwards = self._step, self._backwards
        return debugger.runcall(self.agent.act, observation)


_SHOWN_S = 10.0  # of the curves of a requirement, as of those that every film has
_MOST_COMPARISONS = 6  # of requirements that a film shows


class _Panels(Observer):
    """Draws the panels of the agents after every action, and the signals of requirements at the end."""

    def __init__(self, first: int, folder: Path, requirements: Sequence[RequirementOracle] = ()) -> None:
        self._first = first
        self._folder = folder
        self._requirements = requirements
        self._began_s = 0.0

    def begin(self, episode: ObservedEpisode) -> None:
        self._episode = episode
        self._began_s = episode.simulator.scene().time_s
        for name in episode.names:
            space = episode.simulator.actions[name].space
            save_meanings(self._folder, name, space.meanings if supports(space, NamesMetaActions) else ())

    def action(self, number: int, action: NDArray[np.generic]) -> None:
        name, step = self._episode.names[number], self._episode.steps + 1
        agent = self._episode.agents[name]
        agent = agent.agent if isinstance(agent, _Stopped) else agent
        if step < self._first or not supports(agent, DrawsPanels):
            return
        with scope(name):
            try:
                panels = labelled(agent.panels())
            except Exception as error:  # a picture that fails is no crash of the agent
                panels = labelled({"panels": explanation(error)})
        save_panels(self._folder, step, panels)

    def end(self, result: TrialResult) -> TrialResult:
        step_s = self._episode.simulator.step_length_s
        shown = {text: one for oracle in self._requirements for text, one in oracle.comparisons().items()}
        for text, (begin, sides) in [*shown.items()][:_MOST_COMPARISONS]:
            count = len(next(iter(sides.values())))
            seconds = self._began_s + step_s * np.arange(begin, begin + count)
            for last in range(max(self._first - begin, 0), count):
                part = slice(max(0, last - round(_SHOWN_S / step_s)), last + 1)
                curves = Curve({side: values[part] for side, values in sides.items()}, seconds[part])
                save_panels(self._folder, begin + last, [(text, curves)])
        return result


@final
class _Done(TypedDict):
    result: JsonObject


class _Job(TypedDict):
    """The description of a debugged replay that its process reads from a file."""

    settings: JsonObject  # settings of the worker
    spec: JsonObject  # the trial, shortened to the steps that run
    stop_at: int  # the step in which the debugger stops; 0 for none
    agent: str  # the agent that the window follows
    other: str  # the collision partner; empty if there was none
    panels: tuple[int, str] | None  # the first step whose panels are drawn, and the folder for the pictures
    window: float | None  # wall time of a step in the window, in s; None if no window is shown
    pause_before: int  # the step before which the window waits


class _Window(Observer):
    """Slows down a simulator with its own window, and lets the window follow the crashing vehicle."""

    def __init__(self, simulator: HasWindow, job: _Job) -> None:
        self._simulator = simulator
        self._job = job
        simulator.open_window()

    def begin(self, episode: ObservedEpisode) -> None:
        self._follow()

    def scene(self, step: int, scene: Scene, rewards: tuple[float, ...]) -> None:
        if step:
            self._follow()
            time.sleep(self._job["window"] or 0.0)
        if step + 1 == self._job["pause_before"]:
            self._pause(f"step {step + 1} is next. Press Enter to see what happens: ")

    def end(self, result: TrialResult) -> TrialResult:
        if result.outcome is Outcome.SIMULATOR_ERROR and not self._simulator.window_open:
            self._closed()
        return result

    def leave(self) -> None:
        """Wait until the user closes the window."""
        self._pause("Press Enter to close the window: ")

    def _follow(self) -> None:
        try:
            self._simulator.follow(self._job["agent"], self._job["other"])
        except Exception:
            if not self._simulator.window_open:
                self._closed()
            raise

    def _closed(self) -> None:
        print("the window was closed", file=sys.stderr, flush=True)
        os._exit(_LEFT_EXIT_CODE)

    def _pause(self, prompt: str) -> None:
        print(prompt, end="", flush=True)
        if not sys.stdin.readline():
            print(flush=True)


class _Debugger(pdb.Pdb):
    step = 0
    backwards: Backwards | None = None

    def do_back(self, arg: str) -> None:
        """Go back by a number of steps of the simulation, such as ``back 5``; by one step without a number."""
        steps = int(arg) if arg.strip().isdecimal() else 1
        why_not = (
            self.backwards.go(self.step - max(1, steps))
            if self.backwards is not None
            else "there is no earlier copy of the process"
        )
        print(f"*** {why_not}", flush=True)

    def set_quit(self) -> None:
        """End the process without a verdict."""
        print(flush=True)
        os._exit(_LEFT_EXIT_CODE)


def main() -> None:
    """Run the trial that is described by a file in a folder, attached to the terminal."""
    folder = Path(sys.argv[1])
    job: _Job = json.loads((folder / layout.JOB).read_text(encoding="utf-8"))
    if not job["stop_at"]:  # only the debugger handles Ctrl-C; without it, a traceback of the replay helps no user
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    try:
        settings, spec = WorkerSettings.from_json(job["settings"]), TrialSpec.from_json(job["spec"])
        seal(settings)
        parts = Parts(settings)
        simulator = parts.simulator()
        stop = _Stop(job["agent"], job["stop_at"])
        stop.backwards = Backwards(stop, job["stop_at"], folder)
        observers: list[Observer] = [stop.backwards, stop] if job["stop_at"] and job["window"] is None else [stop]
        if job["stop_at"] and not sys.stdin.isatty():
            sys.stdin = cast("TextIO", OneLine())
        oracles = parts.oracles()
        if job["panels"] is not None:
            requirements = [one for one in oracles if isinstance(one, RequirementOracle)]
            observers.append(_Panels(job["panels"][0], Path(job["panels"][1]), requirements))
        window = _open_window(simulator, job) if job["window"] is not None else None
        if window is not None:
            observers.append(window)
        box = BlackBox(folder / layout.BLACK_BOX)
        box.begin(pid=os.getpid(), trial=spec.number, started=time.monotonic())
        result = run_episode(
            spec,
            simulator=simulator,
            make_agent=parts.agent,
            box=box,
            oracles=oracles,
            crash_on=settings.crash_on,
            observers=observers,
        )
        if window is not None:
            window.leave()
        answer: ErrorData | _Done = {"result": result.to_json()}
    except CrashhuntError as error:
        answer = error.to_json()
    (folder / layout.ANSWER).write_text(json.dumps(answer), encoding="utf-8")


def _open_window(simulator: Simulator, job: _Job) -> _Window:
    if not supports(simulator, HasWindow):
        raise UsageError(f"the simulator {type(simulator).__name__} has no window", fix="make a film with --video")
    return _Window(simulator, job)
