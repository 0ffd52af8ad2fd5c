"""What looks on while an episode runs: it is told of everything, and changes nothing."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from crashhunt.episode._episode import Episode
    from crashhunt.trial import Disturbance, TrialResult
    from crashhunt.world import Scene

__all__ = ["Observer"]


class Observer:
    """Is told what happens in an episode; override what you want to be told. What is not overridden costs nothing.

    Observers are told in their order, and of the end in the opposite one. Whatever one raises ends the episode, as
    everything does that is neither the agent's nor the simulator's.
    """

    def begin(self, episode: Episode) -> None:
        """The simulator has been reset, and `Episode.names` says who takes part; no agent has been made yet."""

    def observation(self, number: int, observation: NDArray[np.generic]) -> None:
        """An agent is about to be shown something.

        Args:
            number: of the agent, in `Episode.names`.
            observation: as it is recorded: flattened, where the agent is shown something structured.
        """

    def action(self, number: int, action: NDArray[np.generic]) -> None:
        """An agent has answered.

        Args:
            number: of the agent, in `Episode.names`.
            action: encoded.
        """

    def disturbance(self, disturbance: Disturbance) -> None:
        """A disturbance takes place; told before the step in which it begins, or that follows.

        Args:
            disturbance: as it takes place, with who is meant; a vehicle that is not there is empty.
        """

    def scene(self, step: int, scene: Scene, rewards: tuple[float, ...]) -> None:
        """A step is complete.

        Args:
            step: its number; 0 for the scene before the first step.
            scene: as it is now.
            rewards: of every agent, in the order of `Episode.names`; 0 of those that did not act.
        """

    def copied(self) -> None:
        """This process has become a copy of the one in which the episode runs, which is not to notice it."""

    def end(self, result: TrialResult) -> TrialResult:
        """The episode is over; return its result, with what this observer has found out about it.

        It is told again, with another result, where an observer has failed at the end.
        """
        return result
