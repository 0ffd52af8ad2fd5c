"""What connects an episode with those who take part, and with those who look on."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from crashhunt.base.errors import InvalidEpisodeError
from crashhunt.base.faculties import offers
from crashhunt.episode._observer import Observer
from crashhunt.simulators import LeavesOut, PlaysPaths

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from gymnasium import Space
    from numpy.typing import NDArray

    from crashhunt.simulators import Options, Simulator
    from crashhunt.trial import TrialSpec

__all__ = ["agent_seed", "options_of", "told", "unflattener", "wants"]


def options_of(spec: TrialSpec, simulator: Simulator) -> Options:
    """Return what a simulator is asked for with its reset.

    Raises:
        InvalidEpisodeError: it cannot do it.
    """
    options: Options = {"arguments": spec.scenario_arguments}
    if spec.only is not None:
        if not offers(simulator, LeavesOut):
            raise InvalidEpisodeError("the simulator cannot leave anybody out")
        options["only"] = spec.only
    if spec.script is not None:
        if not offers(simulator, PlaysPaths):
            raise InvalidEpisodeError("the simulator cannot move anybody along recorded paths")
        options["script"] = spec.script
    return options


def agent_seed(seed: int, number: int) -> int:
    """Return a seed of each agent's own, which differs from the simulator's."""
    return int(np.random.SeedSequence(seed, spawn_key=(number,)).generate_state(1)[0]) >> 1


def unflattener(space: Space[object]) -> Callable[[NDArray[np.generic]], object]:
    """Return what makes a Dict or Tuple observation again of the flattened array, which is recorded."""
    from gymnasium.spaces import unflatten

    return partial(unflatten, space)


def told(observers: Sequence[Observer], name: str) -> Any:
    """Return what is called to tell observers of something; those that do not want to be told are left out."""
    return [getattr(one, name) for one in observers if wants(one, name)]


def wants(observer: Observer, name: str) -> bool:
    """Whether an observer wants to be told of something."""
    return getattr(type(observer), name) is not getattr(Observer, name)
