"""Vehicles and persons that do not take part in an episode, though the scenario has them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import libsumo

from crashhunt.trial import EVERYBODY
from crashhunt.world import PERSON

if TYPE_CHECKING:
    from collections.abc import Iterable

__all__ = ["TakingPart"]


class TakingPart:
    """Takes vehicles off the road at the end of the step in which they enter, before anybody has seen them.

    Only then are they known by name: those of a flow are made one after another as time goes on. A person leaves with
    the next step, and is not to be seen until then.

    Args:
        takes_part: the names of those that stay, as in scenes.
        leaving: the ids of persons who are not to be seen any more are put in here.

    Attributes:
        entered: the names of all that have entered, in their order.
    """

    def __init__(self, takes_part: Iterable[str], leaving: set[str]) -> None:
        self._takes_part = frozenset(takes_part)
        self._everybody = EVERYBODY in self._takes_part
        self._leaving = leaving
        self.entered: list[str] = []

    def remove(self) -> None:
        """Remove those that have entered in the last step."""
        for vehicle in libsumo.simulation.getDepartedIDList():
            self.entered.append(vehicle)
            if not self._everybody and vehicle not in self._takes_part:
                libsumo.vehicle.remove(vehicle)
        for person in libsumo.simulation.getDepartedPersonIDList():
            name = PERSON + person
            self.entered.append(name)
            if not self._everybody and name not in self._takes_part:
                libsumo.person.removeStages(person)
                self._leaving.add(person)

    def warm_up(self, until_s: float) -> None:
        """Simulate up to a time, in s, step by step."""
        while libsumo.simulation.getTime() < until_s:
            libsumo.simulationStep()
            self.remove()
