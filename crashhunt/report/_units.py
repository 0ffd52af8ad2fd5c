"""The units of a hunt's arguments, for the axes of plots."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING

from crashhunt.base.errors import CrashhuntError
from crashhunt.base.plugins import locate
from crashhunt.snapshots import latest_snapshot
from crashhunt.trial import signature_of

if TYPE_CHECKING:
    from pathlib import Path

    from crashhunt.plans import HuntSettings

__all__ = ["argument_units"]


def argument_units(directory: Path, settings: HuntSettings) -> dict[tuple[str, str], str]:
    """Return the units that are known: (agent, or empty for the scenario; name of the argument) to unit.

    The scenario of the snapshot says them, and the signatures of our own agents; no code of a bundle is run.
    """
    try:
        found = latest_snapshot(directory)
        scenario = found.scenario() if found is not None else None
    except CrashhuntError:  # a page without units is better than none
        scenario = None
    units = {} if scenario is None else {("", name): setup.unit for name, setup in scenario.arguments.items()}
    for agent, chosen in settings.agents.items():
        if chosen.agent.startswith("crashhunt.agents:"):
            # Another version of crashhunt may have an agent that this one does not have.
            with suppress(CrashhuntError):
                arguments = signature_of(locate("agents", chosen.agent)).arguments
                units |= {(agent, name): argument.unit for name, argument in arguments.items()}
        setup = scenario.agents.get(agent) if scenario is not None else None
        if setup is not None and setup.agent == chosen.agent:
            units |= {(agent, name): known.unit for name, known in setup.arguments.items() if known.unit}
    # "vehicles (vehicles)" says nothing.
    return {(agent, name): unit for (agent, name), unit in units.items() if unit and unit != name}
