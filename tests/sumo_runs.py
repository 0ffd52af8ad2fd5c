"""Scenarios of SUMO in folders of their own, and simulators that are closed when their test ends."""

from __future__ import annotations

import shutil
from contextlib import ExitStack, closing
from dataclasses import replace
from typing import TYPE_CHECKING, Any
from unittest.mock import patch

from episodes import record_run

from crashhunt.scenario import Scenario, argument_values, load_scenario
from crashhunt.sumo import SumoSetup, SumoSimulator
from crashhunt.sumo._observing import ObservedParts

if TYPE_CHECKING:
    from pathlib import Path

    from crashhunt.recording import Recording
    from crashhunt.trial import TrialResult, TrialSpec


class SumoRuns(ExitStack):
    """Writes scenarios and runs them.

    Args:
        place: the folder for all files.
    """

    def __init__(self, place: Path) -> None:
        super().__init__()
        self.place, self._count = place, 0

    def folder(self) -> Path:
        """Return a new folder."""
        self._count += 1
        made = self.place / f"run-{self._count}"
        made.mkdir(parents=True)
        return made

    def write(self, net: Path, routes: str, files: dict[str, str] | None = None) -> Path:
        """Return a new folder with a network, routes in `r.rou.xml`, and other files by their names."""
        folder = self.folder()
        shutil.copy(net, folder)
        for name, text in {"r.rou.xml": routes, **(files or {})}.items():
            (folder / name).write_text(text)
        return folder

    def written(
        self, net: Path, routes: str, *, additional: str = "", table: dict[str, Any] | None = None, **scenario: Any
    ) -> SumoSimulator:
        """Return a simulator of a scenario that consists of a network, routes and additional elements."""
        folder = self.write(net, routes, {"a.add.xml": additional} if additional else None)
        files = {"routes": ("r.rou.xml",), "additional": ("a.add.xml",) * bool(additional)}
        return self.open(Scenario(tables={"sumo": SumoSetup(net=net.name, **files, **(table or {}))}, folder=folder,
                                  **scenario))  # fmt: skip

    def open(self, scenario: Scenario | Path | str, **changes: Any) -> SumoSimulator:
        """Return a simulator of a scenario, or of one with other settings of its agent `ego`."""
        chosen = scenario if isinstance(scenario, Scenario) else load_scenario(scenario)
        if changes:
            chosen = replace(chosen, agents={**chosen.agents, "ego": replace(chosen.agents["ego"], **changes)})
        # A worker prepares the whole network once; an episode of a test computes the few lanes that it needs.
        with patch.object(ObservedParts, "prepare"):
            return self.enter_context(closing(SumoSimulator(chosen, self.folder())))

    def begin(
        self, scenario: Scenario | Path | str, seed: int, arguments: dict[str, Any] | None = None, **changes: Any
    ) -> tuple[SumoSimulator, dict[str, Any]]:
        """Return a simulator that has begun an episode, and what its agents observe."""
        simulator = self.open(scenario, **changes)
        values = {**argument_values(simulator._scenario), **(arguments or {})}
        return simulator, simulator.reset(seed=seed, options={"arguments": values})[0]

    def record(
        self, simulator: SumoSimulator, spec: TrialSpec, agent: Any, **options: Any
    ) -> tuple[TrialResult, Recording]:
        """Run an episode with one agent; return its result and its recording."""
        return record_run(self.folder() / "box", spec, simulator, agent, **options)
