"""What can be looked at between two steps of an episode, whoever has taken them."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from crashhunt.agents import Agent
    from crashhunt.episode._ahead import Ahead
    from crashhunt.simulators import Observations, Simulator
    from crashhunt.world import Scene

__all__ = ["Whereabouts"]


class Whereabouts:
    """The part of an `Episode` that says where it is. Where the core has gone ahead, it is asked when somebody asks."""

    simulator: Simulator

    def __init__(self) -> None:
        super().__init__()
        self._observations: Observations = {}
        self._rewards: Mapping[str, float] = {}
        self._terminations: Mapping[str, bool] = {}
        self._scene: Scene | None = None
        self._ahead: Ahead | None = None
        self._take: Callable[[Mapping[str, Agent]], int] | None = None
        self._is_behind = False  # the core has taken steps of which nothing is known here but their number

    @property
    def observations(self) -> Observations:
        """What the agents will be shown in the next step, by name."""
        self._catch_up()
        return self._observations

    @property
    def rewards(self) -> Mapping[str, float]:
        """Those of the last step, by name, of those that acted in it."""
        self._catch_up()
        return self._rewards

    @property
    def terminations(self) -> Mapping[str, bool]:
        """Whether those that acted in the last step have arrived or crashed."""
        self._catch_up()
        return self._terminations

    @property
    def scene(self) -> Scene | None:
        """After the last step; None before the start."""
        self._catch_up()
        return self._scene

    def _catch_up(self) -> None:
        """Be where the core has come to."""
        if self._is_behind and self._ahead is not None:
            self._is_behind = False
            self._observations, self._rewards, self._terminations, *_ = self._ahead.at_once.catch_up()
            self._scene = self.simulator.scene()
