"""What a trial is put together from: simulator, agents and oracles, as the settings name them."""

from __future__ import annotations

import importlib
import os
import sys
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from crashhunt.agents import NeedsLibraries
from crashhunt.base.errors import CrashhuntError
from crashhunt.base.faculties import offers
from crashhunt.base.plugins import import_module, locate
from crashhunt.base.sandbox import confine
from crashhunt.base.shared_memory import record_shared_memory
from crashhunt.episode._attribution import record_originals
from crashhunt.episode._recursion import bound_recursion
from crashhunt.episode._run import seed_everything
from crashhunt.oracles import parse_oracle
from crashhunt.simulators import FlattensObservations
from crashhunt.trial import signature_of

if TYPE_CHECKING:
    from collections.abc import Mapping

    from crashhunt.agents import Agent
    from crashhunt.episode._settings import WorkerSettings
    from crashhunt.oracles import Oracle
    from crashhunt.simulators import Simulator
    from crashhunt.trial import Value

__all__ = ["Parts", "require_origin", "seal", "stage_of"]


class Parts:
    """Makes the parts of trials in this process, from the code that the settings name.

    Args:
        settings: of the hunt.
    """

    def __init__(self, settings: WorkerSettings) -> None:
        self._settings = settings
        self._factories: dict[str, tuple[Any, tuple[str, ...]]] = {}
        if settings.code:
            # What the snapshot does not have may come from where the hunt was started, as it did then.
            sys.path[:0] = [*settings.code, str(Path.cwd())]
        self._oracles = [parse_oracle(text) for text in settings.oracles]

    def oracles(self) -> list[Oracle]:
        """Make the oracles of a trial; what one remembers of a trial is nobody's business in the next."""
        return [choice.make() for choice in self._oracles]

    def load(self) -> None:
        """Import everything that trials need, always in the same order.

        What modules do when they are imported, such as setting constants of a simulator's classes, is done before the
        first episode: so it holds in every one of them, whichever comes first.

        Raises:
            CrashhuntError: something cannot be imported.
        """
        record_shared_memory(self._settings.scratch)
        bound_recursion()  # before a module is imported that recurses
        # Whatever modules draw when they are imported is the same in every process.
        seed_everything(0)
        scenario = self._settings.scenario
        locate("simulators", scenario.simulator)
        for module in scenario.modules():
            import_module(module)
        for agent in scenario.agents:
            factory, _ = self._factory(agent)
            # PyTorch takes longer than a short trial may.
            for library in factory.libraries if offers(factory, NeedsLibraries) else ():
                with suppress(ImportError):  # which the agent itself will tell
                    importlib.import_module(library)
        # Of which every simulator's spaces are: here, so that workers that are forks of this process have it.
        importlib.import_module("gymnasium")
        record_originals()

    def simulator(self) -> Simulator:
        """Make a simulator, with a folder for files of its own."""
        stage = stage_of(self._settings.scratch, os.getpid())
        stage.mkdir(parents=True, exist_ok=True)
        scenario = self._settings.scenario
        made: Simulator = locate("simulators", scenario.simulator)(scenario, stage)
        return made

    def agent(self, agent: str, simulator: Simulator, arguments: Mapping[str, Value]) -> Agent:
        """Make the agent of a vehicle; files that its arguments name come from the snapshot.

        Raises:
            CrashhuntError: its module comes from elsewhere than the snapshot that has it.
        """
        factory, wanted = self._factory(agent)
        given: dict[str, object] = {}
        if "observation_space" in wanted:
            shown = simulator.shown_spaces if offers(simulator, FlattensObservations) else {}
            given["observation_space"] = shown.get(agent) or simulator.observation_spaces[agent]
        if "action_space" in wanted:
            given["action_space"] = simulator.actions[agent].space
        if "step_length_s" in wanted:
            given["step_length_s"] = simulator.step_length_s
        files = self._settings.argument_files
        values = {
            name: files.get(value, value) if isinstance(value, str) else value for name, value in arguments.items()
        }
        made: Agent = factory(**{**given, **values})
        return made

    def _factory(self, agent: str) -> tuple[Any, tuple[str, ...]]:
        found = self._factories.get(agent)
        if found is None:
            factory = locate("agents", self._settings.scenario.agents[agent].agent)
            if not factory.__module__.startswith("crashhunt."):  # which a pool's worker has loaded before
                require_origin(factory.__module__, self._settings.code)
            found = self._factories[agent] = factory, signature_of(factory).given
        return found


def stage_of(scratch: Path, pid: int) -> Path:
    """Return the folder for files of the simulator that a process has made."""
    return scratch / f"stage-{pid}"


def seal(settings: WorkerSettings) -> None:
    """Confine this process to its scratch folder, if what it runs is a stranger's; it works there from then on."""
    if settings.sealed is None:
        return
    home = settings.scratch / "home"
    home.mkdir(exist_ok=True)
    os.chdir(home)  # where SUMO writes what nobody has said where to write
    os.environ |= {"HOME": str(home), "TMPDIR": str(home)}
    confine(settings.scratch, [settings.scenario.folder, *settings.sealed])


def require_origin(module: str, code: tuple[str, ...]) -> None:
    """See that a module comes from the snapshot, if it is there at all, and not from where it is developed."""
    top = module.partition(".")[0]
    file = getattr(sys.modules[module], "__file__", None)
    for folder in code:
        if (Path(folder) / top).is_dir() or (Path(folder) / f"{top}.py").is_file():
            if file is not None and not Path(file).resolve().is_relative_to(folder):
                raise CrashhuntError(
                    f"the module {module!r} was imported from {file}, not from the snapshot",
                    fix="remove it from PYTHONPATH and from start-up files such as sitecustomize",
                    where=folder,
                )
            return
