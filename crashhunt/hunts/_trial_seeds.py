"""The seed, arguments and disturbances of each trial, from the seed of the hunt and the number of the trial."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from crashhunt.disturbances import FIRST_STEP
from crashhunt.trial import TrialSpec

if TYPE_CHECKING:
    from crashhunt.disturbances import DisturbanceSampler
    from crashhunt.plans import HuntSettings
    from crashhunt.samplers import NamedSampler
    from crashhunt.trial import Disturbance, Forcing, Value

_TRAFFIC_STREAM = 0x74726166  # apart from what else is drawn of the hunt's seed


def spec_of(
    number: int,
    settings: HuntSettings,
    sampler: NamedSampler,
    disturber: DisturbanceSampler | None = None,
    forcing: Forcing | None = None,
) -> TrialSpec:
    """Return the trial that a sampler proposes, with the disturbances that follow from the trial's seed.

    With `--seeds`, trials use the given number of traffic seeds in turn. A traffic seed also determines the scenario's
    arguments if the sampler is independent. Samplers that are not independent propose the scenario's arguments
    themselves.

    With a forcing, the trial is a root. In a root, no disturbance is drawn from the first step on in which a
    disturbance may be forced.

    Raises:
        CrashhuntError: the sampler failed.
    """
    spec = propose_trial(number, settings, sampler, disturber, forcing)
    assert spec is not None  # only a sampler that learns may propose no trial, and not its first
    return spec


def propose_trial(
    number: int,
    settings: HuntSettings,
    sampler: NamedSampler,
    disturber: DisturbanceSampler | None = None,
    forcing: Forcing | None = None,
) -> TrialSpec | None:
    """Return the trial as `spec_of`; None if the sampler proposes none before it receives further results."""
    rng = np.random.default_rng(np.random.SeedSequence(settings.seed, spawn_key=(number,)))
    seed = int(rng.integers(2**31))
    proposal = sampler.ask(number, rng)
    if proposal is None:
        return None
    values = dict(proposal.arguments)
    if settings.seeds:
        turn = number % settings.seeds
        rng = np.random.default_rng(np.random.SeedSequence(settings.seed, spawn_key=(turn, _TRAFFIC_STREAM)))
        seed = int(rng.integers(2**31))
        if sampler.independent:
            traffic = sampler.ask(turn, rng)
            assert traffic is not None  # only a sampler that learns may propose no trial
            values |= {key: value for key, value in traffic.arguments.items() if not key[0]}
    arguments: dict[str, dict[str, Value]] = {agent: {} for agent in settings.agents}
    scenario_arguments: dict[str, Value] = {}
    for (agent, name), value in sorted(values.items()):
        (arguments[agent] if agent else scenario_arguments)[name] = value
    if proposal.seed is not None:
        seed = proposal.seed
    return TrialSpec(
        number=number,
        seed=seed,
        arguments=arguments,
        scenario_arguments=scenario_arguments,
        max_steps=settings.max_steps,
        parent=proposal.parent,
        origin=proposal.origin,
        disturbances=_drawn(disturber, seed, settings.max_steps, forcing) if disturber is not None else (),
        forcing=forcing,
    )


def _drawn(disturber: DisturbanceSampler, seed: int, steps: int, forcing: Forcing | None) -> tuple[Disturbance, ...]:
    """Return the disturbances of a trial; for a root, only those before the first step with a forced disturbance."""
    return disturber.draw(seed, steps if forcing is None else min(steps, FIRST_STEP - 1))
