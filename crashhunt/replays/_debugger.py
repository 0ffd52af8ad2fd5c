"""A replay to look into: up to a step, with the terminal free for a debugger inside the agent."""

from __future__ import annotations

import builtins
import json
import os
import pdb
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from crashhunt.base import layout
from crashhunt.base.errors import CrashhuntError, UsageError
from crashhunt.base.keeper import Kept
from crashhunt.episode import Parts, WorkerSettings, run_episode, seal
from crashhunt.executors import fresh_environment
from crashhunt.panels import labelled, scope
from crashhunt.recording import BlackBox, Recording, read_black_box
from crashhunt.render import explanation, save_meanings, save_panels
from crashhunt.trial import TrialResult, TrialSpec

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from crashhunt.agents import Agent
    from crashhunt.replays._replay import Rerun
    from crashhunt.simulators import Simulator

__all__ = ["Look", "debug", "main"]

_LEFT = 77  # exit code


@dataclass(frozen=True, slots=True, kw_only=True)
class Look:
    """What to look at in a replay.

    Args:
        until: how many steps to run.
        stop_at: the step in which to drop into the ``act`` of the agent that crashed; 0 for none.
        to_stderr: whether what is printed goes there.
        panels: the step from which on to draw the agents' panels, and the folder for them.
        window: open the simulator's own, with so many s of wall time between two steps; it pauses before the crash.
    """

    until: int
    stop_at: int = 0
    to_stderr: bool = False
    panels: tuple[int, Path] | None = None
    window: float | None = None


def debug(rerun: Rerun, look: Look) -> tuple[TrialResult, Recording]:
    """Run the first steps of a crash in a fresh process that has this one's terminal.

    Breakpoints in the agent's code work there, and what it prints is seen at once.

    Args:
        rerun: the crash.
        look: at what.

    Raises:
        UsageError: there is no display for a window.
        CrashhuntError: it could not be run.
        KeyboardInterrupt: the debugger was left, or the window closed.
    """
    if look.window is not None and sys.platform == "linux" and not os.environ.get("DISPLAY"):
        raise UsageError("a window needs a display, and DISPLAY is not set", fix="log in with ssh -X, or give --video")
    collision = rerun.bundle.result.collision
    involved = {collision.collider, collision.victim} if collision is not None else set()
    with tempfile.TemporaryDirectory(prefix="crashhunt-debug-") as folder:
        scratch = Path(folder)
        settings = replace(rerun.worker, scratch=scratch)
        job = {
            "settings": settings.to_json(),
            "spec": replace(rerun.spec, max_steps=look.until).to_json(),
            "stop_at": look.stop_at,
            "agent": rerun.bundle.driver,
            "other": next(iter(involved - {rerun.bundle.driver}), ""),
            "panels": [look.panels[0], str(look.panels[1].resolve())] if look.panels is not None else None,
            "window": look.window,
            "pause_before": min(look.until, max(1, rerun.bundle.result.steps)),
        }
        (scratch / "job.json").write_text(json.dumps(job), encoding="utf-8")
        kept = Kept(
            _module_in(settings.code),
            [folder],
            environment=fresh_environment(settings),
            apart=False,
            stdout=2 if look.to_stderr else None,
        )
        try:
            code = kept.process.wait()
        finally:
            kept.end()
        if code == _LEFT:
            raise KeyboardInterrupt
        if look.window is not None and code < 0:
            # sumo-gui does not always survive being closed in the middle of a step.
            print(f"the window was closed, with signal {-code}", file=sys.stderr)
            raise KeyboardInterrupt
        try:
            answer = json.loads((scratch / "answer.json").read_text(encoding="utf-8"))
        except (OSError, ValueError):
            ended = f"signal {-code}" if code < 0 else f"exit code {code}"
            raise CrashhuntError(
                f"the replay ended before its last step, with {ended}", where=rerun.bundle.id
            ) from None
        if "error" in answer:
            raise CrashhuntError(**answer["error"])
        return TrialResult.from_json(answer["result"]), Recording(read_black_box(scratch / layout.BLACK_BOX))


class _Accompanied:
    """An agent, and which step it is in.

    Args:
        agent: who drives.
        name: of the vehicle.
    """

    def __init__(self, agent: Agent, name: str) -> None:
        self._agent = agent
        self._name = name
        self._step = 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._agent, name)  # whatever else it has, such as close()

    def reset(self, seed: int) -> None:
        self._step = 0
        self._agent.reset(seed)

    def act(self, observation: Any) -> Any:
        self._step += 1
        return self._agent.act(observation)


class _Watched(_Accompanied):
    """An agent that is looked into at one step.

    Args:
        agent: who drives.
        name: of the vehicle.
        step: the step in which to stop.
        simulator: for the scene.
    """

    def __init__(self, agent: Agent, name: str, step: int, simulator: Simulator) -> None:
        super().__init__(agent, name)
        self._stop_at = step
        self._simulator = simulator

    def act(self, observation: Any) -> Any:
        if self._step + 1 != self._stop_at:
            return super().act(observation)
        self._step += 1
        # At hand in the debugger, whatever the agent calls its own.
        for name, value in (
            ("agent", self._agent), ("observation", observation), ("scene", self._simulator.scene()),
            ("step", self._step),
        ):  # fmt: skip
            setattr(builtins, name, value)
        print(f"step {self._step}, {self._name}: at hand are agent, observation, scene and step", flush=True)
        return _Debugger().runcall(self._agent.act, observation)


class _Drawn(_Accompanied):
    """An agent whose panels are drawn after every step.

    Args:
        agent: who drives; it has panels.
        name: of the vehicle.
        first: the first step to draw.
        folder: for the pictures.
    """

    def __init__(self, agent: Agent, name: str, first: int, folder: Path) -> None:
        super().__init__(agent, name)
        self._first = first
        self._folder = folder

    def act(self, observation: Any) -> Any:
        action = super().act(observation)
        if self._step >= self._first:
            with scope(self._name):
                try:
                    panels = labelled(self.panels())
                except Exception as error:  # a picture that fails is no crash of the agent
                    panels = labelled({"panels": explanation(error)})
            save_panels(self._folder, self._step, panels)
        return action


class _Windowed:
    """A simulator in a window of its own, slowed down.

    Args:
        simulator: what is simulated.
        job: who is followed, how long a step takes, and before which step to pause.
    """

    def __init__(self, simulator: Simulator, job: Mapping[str, Any]) -> None:
        self._simulator: Any = simulator
        open_window = getattr(simulator, "open_window", None)
        if open_window is None:
            raise UsageError(f"a {type(simulator).__name__} has no window", fix="watch it with --video")
        open_window()
        self._job = job
        self._step = 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._simulator, name)

    def reset(self, **options: Any) -> Any:
        began = self._simulator.reset(**options)
        self._simulator.follow(self._job["agent"], self._job["other"])
        return began

    def step(self, actions: Any) -> Any:
        self._step += 1
        if self._step == self._job["pause_before"]:
            self._pause(f"step {self._step} is next. Press Enter to see what happens: ")
        try:
            done = self._simulator.step(actions)
            self._simulator.follow(self._job["agent"], self._job["other"])
        except Exception:
            if not self._simulator.window_open:
                print("the window was closed", file=sys.stderr, flush=True)
                os._exit(_LEFT)
            raise
        time.sleep(self._job["window"])
        return done

    def leave(self) -> None:
        """Wait until everything has been looked at."""
        self._pause("Press Enter to close the window: ")

    def _pause(self, prompt: str) -> None:
        print(prompt, end="", flush=True)
        if not sys.stdin.readline():
            print(flush=True)


class _Debugger(pdb.Pdb):
    def set_quit(self) -> None:
        """Leave the process: whoever quits does not want a verdict."""
        print(flush=True)
        os._exit(_LEFT)


def _module_in(code: Sequence[str]) -> str:
    """The name of this module in the crashhunt of a snapshot, which may be an older one."""
    of_it = next((path for folder in code if (path := Path(folder) / "crashhunt").is_dir()), None)
    return "crashhunt.debugger" if of_it is not None and (of_it / "debugger.py").is_file() else __name__


def main() -> None:
    """Run the trial that a file in a folder describes, with the terminal at hand."""
    folder = Path(sys.argv[1])
    job = json.loads((folder / "job.json").read_text(encoding="utf-8"))
    try:
        settings, spec = WorkerSettings.from_json(job["settings"]), TrialSpec.from_json(job["spec"])
        seal(settings)
        parts = Parts(settings)

        def make_agent(name: str, simulator: Simulator, arguments: Mapping[str, Any]) -> Agent:
            made = parts.agent(name, simulator, arguments)
            if name == job["agent"]:
                made = _Watched(made, name, job["stop_at"], simulator)
            if job["panels"] is not None:
                meanings = getattr(simulator.actions[name].space, "meanings", ())
                save_meanings(Path(job["panels"][1]), name, meanings)
            if job["panels"] is not None and callable(getattr(made, "panels", None)):
                made = _Drawn(made, name, job["panels"][0], Path(job["panels"][1]))
            return made

        simulator: Any = parts.simulator()
        if job["window"] is not None:
            simulator = _Windowed(simulator, job)
        box = BlackBox(folder / layout.BLACK_BOX)
        box.begin(pid=os.getpid(), trial=spec.number, started=time.monotonic())
        result = run_episode(
            spec,
            simulator=simulator,
            make_agent=make_agent,
            box=box,
            oracles=parts.oracles(),
            crash_on=settings.crash_on,
        )
        if job["window"] is not None:
            simulator.leave()
        answer = {"result": result.to_json()}
    except CrashhuntError as error:
        answer = error.to_json()
    (folder / "answer.json").write_text(json.dumps(answer), encoding="utf-8")
