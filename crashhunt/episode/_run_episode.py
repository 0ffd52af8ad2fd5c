"""Runs a trial from its specification: an episode that is recorded and measured, with seeded random generators."""

from __future__ import annotations

import random
import sys
import time
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from crashhunt.episode._episode import FastEpisode
from crashhunt.episode._observers import Nearness, Recorder
from crashhunt.trial import CRASHES

if TYPE_CHECKING:
    from collections.abc import Sequence

    from crashhunt.episode._branches import Brancher
    from crashhunt.episode._episode import MakeAgent, Reset
    from crashhunt.episode._forced_onsets import OnsetForcer
    from crashhunt.episode._forks import FirstCopy
    from crashhunt.episode._observers import Observer
    from crashhunt.episode._probes import Prober
    from crashhunt.oracles import Oracle
    from crashhunt.recording import BlackBox
    from crashhunt.simulators import Simulator
    from crashhunt.trial import Outcome, TrialResult, TrialSpec


def run_episode(
    spec: TrialSpec,
    *,
    simulator: Simulator,
    make_agent: MakeAgent,
    box: BlackBox,
    oracles: Sequence[Oracle],
    crash_on: Sequence[Outcome] = CRASHES,
    observers: Sequence[Observer] = (),
    reset: Reset | None = None,
    prober: Prober | None = None,
    brancher: Brancher | None = None,
    first_copy: FirstCopy | None = None,
    forcer: OnsetForcer | None = None,
) -> TrialResult:
    """Seed the process's random generators, run one trial from its specification, and record and measure the trial.

    Args:
        spec: specification of the trial.
        simulator: the simulator in which the trial runs.
        make_agent: function called with agent id, simulator and arguments; it returns the agent that drives.
        box: the black box that records the trial; `BlackBox.begin` has been called.
        oracles: the oracles, which decide whether a step is a crash.
        crash_on: The outcomes that end the episode. Other traffic crashes and events are only recorded.
        observers: Further observers, called after the recorder.
        reset: function that resets the simulator; None for the simulator's own `reset`.
        prober: object that runs robustness probes; None for no probes.
        first_copy: object that checks in the first step whether the episode can be forked.
        brancher: Object that runs branches: forks with other disturbances, when other actors are near.
        forcer: Object that makes forks with a forced first disturbance; None if the trial is not a root trial.

    Returns:
        The result of the trial, including exceptions of agent and simulator.

    Raises:
        RecorderError: the disk is full.
    """
    began = time.monotonic()
    seed_everything(spec.seed)
    asking = [one for one in (first_copy, prober, brancher, forcer) if one is not None]
    watching = [] if brancher is None else [brancher]
    try:
        with FastEpisode(
            spec,
            simulator=simulator,
            make_agent=make_agent,
            oracles=oracles,
            crash_on=crash_on,
            observers=(Recorder(box, simulator), Nearness(box.take_frames), *observers, *watching),
            forks=bool(asking),
            reset=reset,
        ) as episode:
            result = episode.start()
            try:
                if result is None and forcer is not None and forcer.is_due(episode):
                    forcer.ask(episode)  # the first onset may begin in step 2, which an agent notices before step 1
                while result is None:
                    seed = spec.reseeding.seed_after(episode.steps) if spec.reseeding is not None else None
                    if seed is not None and (result := episode.reseed(seed)) is not None:
                        break
                    result = episode.step()
                    for one in asking:
                        if result is None and one.is_due(episode):
                            one.ask(episode)
            except BaseException as error:
                result = episode.end_by_agent(error)
                if result is None:
                    raise
    finally:
        for one in watching:
            one.close()
    for one in asking:
        result = one.result(result)
    wall_s = time.monotonic() - began
    return replace(result, setup_s=episode.setup_s, setup_steps=episode.setup_steps, wall_s=wall_s)


def seed_everything(seed: int) -> None:
    """Seed the random generators of the process: `random`, `numpy.random`, and torch if it has been imported."""
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002 - agents may use the global generator
    torch = sys.modules.get("torch")
    if torch is not None:
        torch.manual_seed(seed)
