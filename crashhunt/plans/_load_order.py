"""The order in which a simulator processes a scenario at load: whether it is fixed, and as it was for a recorded crash.

``environment.json`` of a snapshot holds it (``load_order``). Snapshots of earlier versions lack it: it was not fixed.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from crashhunt.scenario import Scenario

__all__ = ["FIXED", "load_order_change", "load_order_of", "with_recorded_load_order"]

FIXED = "fixed"


def load_order_of(scenario: Scenario) -> str | None:
    """Return ``fixed`` or ``not fixed: REASON``; None where the simulator's results do not depend on an order."""
    order = scenario.backend.load_order
    if order is None:
        return None
    why_not = order.why_not(scenario)
    return f"not fixed: {why_not}" if why_not else FIXED


def with_recorded_load_order(scenario: Scenario, recorded: str | None) -> Scenario:
    """Return the scenario with the load order of a recorded crash: fixed, or the simulator's own.

    Args:
        scenario: what is run again.
        recorded: ``load_order`` of the snapshot; None where it has none.
    """
    order = scenario.backend.load_order
    return scenario if order is None or recorded == FIXED else order.keep(scenario)


def load_order_change(scenario: Scenario, recorded: str | None) -> str:
    """Return how the load order here differs from the recorded one, as a clause; empty where it does not.

    An order that was not fixed is kept by `with_recorded_load_order`, so only a fixed one can be missing here.

    Args:
        scenario: what is run again.
        recorded: ``load_order`` of the snapshot; None where it has none.
    """
    order, now = scenario.backend.load_order, load_order_of(scenario)
    if order is None or recorded != FIXED or now == FIXED:
        return ""
    return f"the order of {order.what} was fixed and is {now}"
