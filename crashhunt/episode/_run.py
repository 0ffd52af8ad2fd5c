"""A trial from its specification: an episode, recorded and measured, with the generators of the process seeded."""

from __future__ import annotations

import random
import sys
import time
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from crashhunt.episode._episode import Episode
from crashhunt.episode._nearness import Nearness
from crashhunt.episode._recorder import Recorder
from crashhunt.trial import CRASHES

if TYPE_CHECKING:
    from collections.abc import Sequence

    from crashhunt.episode._branches import Brancher
    from crashhunt.episode._episode import MakeAgent, Reset
    from crashhunt.episode._first_copy import FirstCopy
    from crashhunt.episode._observer import Observer
    from crashhunt.episode._probes import Prober
    from crashhunt.oracles import Oracle
    from crashhunt.recording import BlackBox
    from crashhunt.simulators import Simulator
    from crashhunt.trial import Outcome, TrialResult, TrialSpec

__all__ = ["generators", "run_episode", "seed_everything", "set_generators"]


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
) -> TrialResult:
    """Run one trial from its specification, recorded and measured, with the generators of the process seeded.

    Args:
        spec: which trial.
        simulator: where.
        make_agent: called with agent id, simulator and arguments; returns the agent at the wheel.
        box: what records it; `BlackBox.begin` has been called.
        oracles: what decides whether a step is a crash.
        crash_on: what ends the episode; a traffic crash or event of another kind is recorded, and the episode goes on.
        observers: who else is told; after the recorder.
        reset: what resets the simulator, where it is not the simulator itself.
        prober: asks copies of it how little it would take for a crash.
        first_copy: sees at once whether there can be copies.
        brancher: has copies of it go on with other disturbances where somebody is near.

    Returns:
        The result. Whatever agent or simulator raise is in it.

    Raises:
        RecorderError: the disk is full.
    """
    began = time.monotonic()
    seed_everything(spec.seed)
    asking = [one for one in (first_copy, prober, brancher) if one is not None]
    watching = [] if brancher is None else [brancher]
    try:
        with Episode(
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
                while result is None:
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
    """Seed the generators of the process: `random`, `numpy.random`, and torch where it has been imported."""
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002 - agents may use the global generator
    torch = sys.modules.get("torch")
    if torch is not None:
        torch.manual_seed(seed)


def generators() -> tuple[Any, ...]:
    """Return where the generators of the process are."""
    torch = sys.modules.get("torch")
    ours = np.random.get_state()  # noqa: NPY002 - agents may use the global generator
    return random.getstate(), ours, torch.get_rng_state() if torch is not None else None


def set_generators(state: tuple[Any, ...]) -> None:
    """Have the generators of the process go on where they were."""
    random.setstate(state[0])
    np.random.set_state(state[1])  # noqa: NPY002
    if state[2] is not None:
        sys.modules["torch"].set_rng_state(state[2])
