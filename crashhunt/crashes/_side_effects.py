"""What a stranger's crash may make this process do when its recorded actions are driven: simulate, and nothing else."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from crashhunt.base.errors import UsageError
from crashhunt.base.plugins import registered
from crashhunt.oracles import oracle_name
from crashhunt.scenario import backend_of

if TYPE_CHECKING:
    from collections.abc import Mapping

    from crashhunt.base.plugins import Group
    from crashhunt.plans import HuntSettings
    from crashhunt.scenario import Scenario

__all__ = ["refuse_side_effects"]


def refuse_side_effects(scenario: Scenario, settings: HuntSettings, values: Mapping[str, Any]) -> None:
    """Refuse a scenario that does anything but simulate, as far as is known; what nobody knows is refused.

    Args:
        scenario: of the crash.
        settings: of its hunt.
        values: of the scenario's arguments in the trial.

    Raises:
        UsageError: with what it would do.
    """
    names: list[tuple[Group, str]] = [("simulators", scenario.simulator)]
    names += [("oracles", oracle_name(text)) for text in settings.oracles]
    for group, name in names:
        if name not in registered(group):
            raise _refusal(f"it would import {name!r}")
    for module in scenario.modules():
        raise _refusal(f"it would import {module!r}")
    backend = backend_of(scenario.simulator)
    if backend is None or backend.side_effect is None:
        raise _refusal(f"nobody knows what the simulator {scenario.simulator!r} does besides simulating")
    asked = [spec.spec for spec in settings.scenario_arguments.values() if spec.kind == "str"]
    effect = backend.side_effect(scenario, values, asked)
    if effect:
        raise _refusal(effect)


def _refusal(reason: str) -> UsageError:
    return UsageError(f"the crash is a stranger's, and {reason}", fix="give --trust if you trust who made it")
