"""What a trial is put together from: simulator, agents and oracles, as the settings name them."""

from __future__ import annotations

import importlib
import os
import sys
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from crashhunt.agents import REFERENCE_MODELS, FmuFactory, LibraryFactory, NeedsLibraries, ProgramFactory
from crashhunt.base.agent_locators import is_program
from crashhunt.base.errors import CrashhuntError
from crashhunt.base.foreign_code import Boundary, Party, is_ours, supports
from crashhunt.base.plugins import add_current_folder, import_module, locate
from crashhunt.base.sandbox import confine
from crashhunt.base.shared_memory import record_shared_memory
from crashhunt.episode._action_override import Braking, Keeping
from crashhunt.episode._blame import internal_error
from crashhunt.episode._episode import seed_everything
from crashhunt.episode._failures import record_originals
from crashhunt.episode._reference_driver_correction import ReferenceCorrection
from crashhunt.episode._reference_driver_takeover import CompetentDriver
from crashhunt.oracles import parse_oracle
from crashhunt.scenario import check_action
from crashhunt.simulators import FlattensObservations, MasksActions, ObservesParts, ProvidesRoadMaps, ReportsNotices
from crashhunt.trial import CallSignature, fold_signals, signature_of

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from crashhunt.agents import Agent
    from crashhunt.episode._worker_settings import WorkerSettings
    from crashhunt.oracles import Oracle
    from crashhunt.simulators import Simulator
    from crashhunt.trial import Overruled, Value


_CONSTRUCTOR_BOUNDARY: Final = Boundary(Party.AGENT, "constructor")


# A bound on how deep Python may recurse in a process that runs agents.

MAX_RECURSION_LIMIT: Final = 200_000
"""As deep as this, calls of Python functions take 50 MB and 0.3 s."""

_set_limit = sys.setrecursionlimit


def bound_recursion() -> None:
    """Make `sys.setrecursionlimit` accept at most `MAX_RECURSION_LIMIT`.

    Python allocates the frames of Python functions on the heap, so endless recursion without a limit fills the memory
    of the machine in minutes. With this bound, endless recursion ends in a `RecursionError`.
    """
    sys.setrecursionlimit = setrecursionlimit


def setrecursionlimit(limit: int, /) -> None:
    """Set Python's recursion limit, to at most `MAX_RECURSION_LIMIT`."""
    _set_limit(min(limit, MAX_RECURSION_LIMIT))


_FOREIGN = ProgramFactory | LibraryFactory | FmuFactory  # they create agents that are not in Python


class Parts:
    """Creates the parts of trials (oracles, simulator, agents) in this process, from the code of the settings."""

    def __init__(self, settings: WorkerSettings) -> None:
        self._settings = settings
        self._factories: dict[str, tuple[Any, CallSignature]] = {}
        sys.path[:0] = settings.code
        # What the snapshot does not have may come from where the hunt was started, as it did then.
        add_current_folder(always_last=bool(settings.code))
        self._oracles = [parse_oracle(text) for text in settings.oracles]
        self.reporting_agents: list[ReportsNotices] = []
        """The agents that were created in this process and that may report notices to the user."""

    def oracles(self) -> list[Oracle]:
        """Return new oracles for a trial, because oracles may keep state."""
        return [choice.make() for choice in self._oracles]

    def load(self, report: Callable[[str], None] = lambda _: None) -> None:
        """Import all modules that trials need, always in the same order.

        Modules may, for example, set constants of a simulator's classes when they are imported. All imports happen
        before the first episode, so the constants of the classes are the same in every episode.

        Args:
            report: Function called before each import with the error to show if the import does not return, such as
                "the module 'm' cannot be imported". An import that hangs or ends the process cannot report this error
                itself.

        Raises:
            CrashhuntError: a module cannot be imported.
        """
        record_shared_memory(self._settings.scratch)
        bound_recursion()  # before a module is imported that recurses
        # Whatever modules draw when they are imported is the same in every process.
        seed_everything(0)
        scenario = self._settings.scenario
        report(f"the simulator {scenario.simulator!r} cannot be imported")
        locate("simulators", scenario.simulator)
        for module in scenario.modules():
            report(f"the module {module!r} cannot be imported")
            import_module(module)
        for agent, setup in scenario.agents.items():
            module = repr(setup.agent) if is_program(setup.agent) else f"the module {setup.agent.partition(':')[0]!r}"
            report(f"{module} of agent {agent} cannot be imported")
            factory, _ = self._factory(agent)
            # PyTorch takes longer than a short trial may.
            for library in factory.libraries if supports(factory, NeedsLibraries) else ():
                with suppress(ImportError):  # which the agent itself will tell
                    importlib.import_module(library)
        # Of which every simulator's spaces are: here, so that workers that are forks of this process have it.
        report("Gymnasium cannot be imported")
        importlib.import_module("gymnasium")
        record_originals()

    def simulator(self) -> Simulator:
        """Create a simulator, with a private folder for its files."""
        stage = stage_of(self._settings.scratch, os.getpid())
        stage.mkdir(parents=True, exist_ok=True)
        scenario = self._settings.scenario
        made: Simulator = locate("simulators", scenario.simulator)(scenario, stage)
        if supports(made, ProvidesRoadMaps) and any(self._reads_map(agent) for agent in scenario.agents):
            made.prepare_road_maps()
        return made

    def _reads_map(self, agent: str) -> bool:
        """Return whether an agent receives the road map; a program asks for it only when it runs."""
        factory, signature = self._factory(agent)
        return factory.reads_map if isinstance(factory, LibraryFactory) else "map" in signature.given

    def agent(self, agent: str, simulator: Simulator, arguments: Mapping[str, Value]) -> Agent:
        """Create the agent of a vehicle; files that its arguments name come from the snapshot.

        Raises:
            CrashhuntError: the module was not imported from the snapshot, although the snapshot contains it.
            ForeignError: the agent's constructor failed.
            InternalError: crashhunt itself failed.
        """
        try:
            factory, given = self._prepared(agent, simulator, arguments)
            if isinstance(factory, _FOREIGN):
                settings = self._settings
                return factory.agent(
                    agent, simulator, given, folder=stage_of(settings.scratch, os.getpid()),
                    files=settings.argument_files, limit_s=settings.step_timeout_s or None,
                    is_forked=bool(settings.probe_s or settings.branch or settings.force),
                )  # fmt: skip
        except CrashhuntError:
            raise
        except Exception as error:
            raise internal_error(error) from error
        with _CONSTRUCTOR_BOUNDARY:
            made: Agent = factory(**given)
        if is_ours(made) and supports(made, ReportsNotices):
            self.reporting_agents.append(made)
        return made

    def _prepared(
        self, agent: str, simulator: Simulator, arguments: Mapping[str, Value]
    ) -> tuple[Callable[..., Any], dict[str, object]]:
        """Return the constructor of an agent, and its keyword arguments."""
        factory, signature = self._factory(agent)
        wanted = signature.given
        if self._settings.scenario.backend.actions:  # a counterfactual run may have another agent than the hunt
            setup = self._settings.scenario.agents[agent]
            check_action(setup.action, signature.actions, setup.agent)
        given: dict[str, object] = {}
        if "observation_space" in wanted:
            shown = simulator.shown_spaces if supports(simulator, FlattensObservations) else {}
            given["observation_space"] = shown.get(agent) or simulator.observation_spaces[agent]
        if "action_space" in wanted:
            given["action_space"] = simulator.actions[agent].space
        if "agent_id" in wanted:
            given["agent_id"] = agent
        if "step_length_s" in wanted:
            given["step_length_s"] = simulator.step_length_s
        if "columns" in wanted:
            layouts = simulator.observation_layouts if supports(simulator, ObservesParts) else {}
            layout = layouts.get(agent)  # copied, because an agent may change it
            given["columns"] = {} if layout is None else {part: {**of} for part, of in layout.columns.items()}
        if "map" in wanted:
            given["map"] = simulator.road_map(agent) if supports(simulator, ProvidesRoadMaps) else None
        if "vehicle" in wanted:
            given["vehicle"] = simulator.vehicle_data(agent) if supports(simulator, ProvidesRoadMaps) else None
        if "action_masks" in wanted:
            given["action_masks"] = partial(simulator.action_mask, agent) if supports(simulator, MasksActions) else None
        files = self._settings.argument_files
        values = {
            name: files.get(value, value) if isinstance(value, str) else value for name, value in arguments.items()
        }
        return factory, {**given, **fold_signals(values)}

    def _factory(self, agent: str) -> tuple[Any, CallSignature]:
        found = self._factories.get(agent)
        if found is None:
            factory = locate("agents", self._settings.scenario.agents[agent].agent)
            if isinstance(factory, LibraryFactory | FmuFactory):
                factory.load(self._settings.argument_files, self._settings.scratch)
            if isinstance(factory, _FOREIGN):  # it would have to run to report its arguments
                return self._factories.setdefault(agent, (factory, CallSignature({}, open=True, given=())))
            if not factory.__module__.startswith("crashhunt."):  # which a pool's worker has loaded before
                require_origin(factory.__module__, self._settings.code)
            found = self._factories[agent] = factory, signature_of(factory)
        return found


def stage_of(scratch: Path, pid: int) -> Path:
    """Return the folder for the files of a simulator that the given process has created."""
    return scratch / f"stage-{pid}"


def seal(settings: WorkerSettings) -> None:
    """If this process runs untrusted code, restrict it to its scratch folder, and change to this folder."""
    if settings.sealed is None:
        return
    home = settings.scratch / "home"
    home.mkdir(exist_ok=True)
    os.chdir(home)  # SUMO writes files with relative paths to the working directory
    os.environ |= {"HOME": str(home), "TMPDIR": str(home)}
    confine(settings.scratch, [settings.scenario.folder, *settings.sealed])


def require_origin(module: str, code: tuple[str, ...]) -> None:
    """Check that a module of the snapshot was imported from the snapshot, not from the user's folder."""
    top = module.partition(".")[0]
    file = getattr(sys.modules[module], "__file__", None)
    for folder in code:
        if (Path(folder) / top).is_dir() or (Path(folder) / f"{top}.py").is_file():
            # A submodule may be a project of its own and a folder of another project, and has a copy in each.
            if file is not None and not any(Path(file).resolve().is_relative_to(place) for place in code):
                raise CrashhuntError(
                    f"the module {module!r} was imported from {file}, not from the snapshot",
                    fix="remove it from PYTHONPATH and from start-up files such as sitecustomize",
                    where=folder,
                )
            return


def overruled_agent(driver: Agent, simulator: Simulator, overruled: Overruled) -> Agent:
    """Return an agent that drives like the given agent up to a step, and is overruled after it.

    Raises:
        InvalidEpisodeError: the simulator does not support this override.
    """
    if overruled.reference in REFERENCE_MODELS:
        return CompetentDriver(driver, simulator, overruled)
    if overruled.reference:
        return ReferenceCorrection(driver, simulator, overruled)
    if overruled.keeps:
        return Keeping(driver, simulator, overruled.agent, overruled.after, overruled.keeps)
    return Braking(driver, simulator, overruled.agent, overruled.after, overruled.manoeuvre)
