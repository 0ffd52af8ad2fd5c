"""Before the first trial of ``--ego any``: simulate the plain traffic, to draw among vehicles that enter."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import tempfile
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.errors import CrashhuntError, SimulatorError
from crashhunt.base.keeper import Kept
from crashhunt.base.signals import stop_requests
from crashhunt.executors import worker_environment
from crashhunt.scenario import as_plain_data
from crashhunt.snapshots import latest_snapshot

if TYPE_CHECKING:
    from crashhunt.base.plain import Json
    from crashhunt.plans import HuntSettings, Request
    from crashhunt.scenario import RunToSurvey, Scenario, SurveyJob

__all__ = ["TrafficSurveyor"]

SURVEY_SEEDS = (1, 2)
"""Fixed, so that every hunt in a scenario draws from the same vehicles. With one run, a vehicle of a random flow that
enters by chance would be a candidate."""
MAX_WALL_TIME_S = 60.0
"""Of all runs. The bound on simulated steps ends a run sooner on all but very large networks."""
LOADING_WALL_TIME_S = 60.0
"""In addition, as loading a network cannot be interrupted."""
POLL_S = 0.02
OUTPUT = "output.log"


class TrafficSurveyor:
    """Replaces the candidates that route files promise with the vehicles that do enter.

    Args:
        directory: of the hunt. A hunt that is there keeps its candidates.
        overwrite: whether that hunt is to be removed.
    """

    def __init__(self, directory: Path, *, overwrite: bool) -> None:
        self._directory = directory
        self._overwrite = overwrite

    def __call__(self, scenario: Scenario, request: Request, settings: HuntSettings) -> Scenario:
        """Return the scenario with its candidates, or the same scenario where there is nothing to find out.

        Args:
            scenario: as it was loaded.
            request: what was asked.
            settings: what follows from it without a survey.

        Raises:
            ScenarioError: no trial can be valid.
        """
        survey = scenario.backend.survey
        if survey is None or request.ego not in ("", "any") or Path(scenario.file).suffix == ".toml":
            return scenario
        drawn = {setup.replaces for setup in scenario.agents.values() if setup.replaces}
        if drawn & {name.removeprefix("scenario.") for name in request.scenario_arguments}:
            return scenario  # the user has chosen
        if not self._overwrite and (self._directory / layout.HUNT).exists():
            kept = self._kept()
            restored = survey.restore(scenario, kept) if kept is not None else None
            if restored is not None:
                return restored
        try:
            answer = _survey(scenario, _runs(settings, drawn))
        except (SimulatorError, OSError) as error:
            # The hunt goes on: where SUMO refuses its input, the first trial reports which file and line.
            why = f"the survey cannot run: {error}" if isinstance(error, OSError) else str(error)
            note = f"warning: candidates are the vehicles that the route files list, entering or not: {why}"
            return replace(scenario, notes=(scenario.notes[0], note, *scenario.notes[1:]))
        return survey.refine(scenario, answer)

    def _kept(self) -> Scenario | None:
        with suppress(CrashhuntError, OSError):
            snapshot = latest_snapshot(self._directory)
            return snapshot.scenario() if snapshot is not None else None
        return None


def _runs(settings: HuntSettings, drawn: set[str]) -> list[RunToSurvey]:
    """Return a run with the scenario's arguments at the low ends of their ranges, and one with the high ends."""
    shares = [index / (len(SURVEY_SEEDS) - 1) for index in range(len(SURVEY_SEEDS))]
    return [
        {
            "seed": seed,
            "values": {
                name: spec.distribution.quantile(share)
                for name, spec in settings.scenario_arguments.items()
                if name not in drawn
            },
        }
        for seed, share in zip(SURVEY_SEEDS, shares, strict=True)
    ]


def _survey(scenario: Scenario, runs: list[RunToSurvey]) -> Json:
    """Return the completed runs.

    Raises:
        SimulatorError: the process failed or took too long.
    """
    survey = scenario.backend.survey
    assert survey is not None
    number = 0
    with tempfile.TemporaryDirectory(prefix="crashhunt-survey-") as name, stop_requests() as stops:
        folder = Path(name)
        answer = folder / layout.ANSWER
        job: SurveyJob = {
            "scenario": as_plain_data(scenario),
            "folder": str(scenario.folder.resolve()),
            "stage": str(folder / "stage"),
            "answer": str(answer),
            "time_limit_s": MAX_WALL_TIME_S,
            "runs": runs,
        }
        (folder / layout.JOB).write_text(json.dumps(job), encoding="utf-8")
        with (folder / OUTPUT).open("wb") as log:
            kept = Kept(
                survey.module,
                [str(folder / layout.JOB)],
                environment={**os.environ, **worker_environment()},
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
            )
        deadline = time.monotonic() + MAX_WALL_TIME_S + LOADING_WALL_TIME_S
        try:
            while kept.process.poll() is None and not stops and time.monotonic() < deadline:
                time.sleep(POLL_S)
        finally:
            kept.end()
        if stops:
            number = stops[0]
        elif answer.exists():
            found: Json = json.loads(answer.read_text(encoding="utf-8"))
            return found
        elif time.monotonic() >= deadline:
            limit_s = MAX_WALL_TIME_S + LOADING_WALL_TIME_S
            raise SimulatorError(f"simulating the plain traffic took over {limit_s:g} s of wall time")
        else:
            said = (folder / OUTPUT).read_text(encoding="utf-8", errors="replace").strip().splitlines()
            errors = [line for line in said if line.startswith("Error")] or said or [_ending(kept.process.returncode)]
            raise SimulatorError(f"simulating the plain traffic failed: {errors[-1].strip()}")
    # The process and its folder are gone: the signal goes to the handler that was there before.
    signal.raise_signal(number)
    raise KeyboardInterrupt


def _ending(code: int) -> str:
    return f"signal {-code}" if code < 0 else f"exit code {code}"
