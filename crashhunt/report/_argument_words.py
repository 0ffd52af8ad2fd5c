"""The arguments of a trial in words: their values, the curves of those that are signals, and their units."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING

from crashhunt.base.errors import CrashhuntError
from crashhunt.base.plugins import locate
from crashhunt.base.text import count_of, format_number
from crashhunt.snapshots import latest_snapshot
from crashhunt.trial import InputSignal, fold_signals, signature_of, without_folder

if TYPE_CHECKING:
    from pathlib import Path

    from crashhunt.plans import HuntSettings
    from crashhunt.trial import TrialResult, Value


_CURVE_COLUMNS, _LEVELS = 30, "▁▂▃▄▅▆▇█"  # of the curve of an argument over time


def format_arguments(result: TrialResult) -> str:
    """Return the arguments of a trial as one line."""
    spec = result.spec
    alone = len(spec.arguments) == 1
    pairs = [
        (name if alone else f"{agent}.{name}", value)
        for agent, values in spec.arguments.items()
        for name, value in values.items()
    ]
    pairs += list(spec.scenario_arguments.items())
    return " ".join(f"{name}={_short(value)}" for name, value in pairs)


def input_signals(result: TrialResult) -> dict[str, InputSignal]:
    """Return the arguments of a trial that are signals, by name as `format_arguments` writes it."""
    spec = result.spec
    owners = ((f"{agent}." * (len(spec.arguments) > 1), given) for agent, given in spec.arguments.items())
    return {
        f"{whose}{name}": value
        for whose, given in (*owners, ("", spec.scenario_arguments))
        for name, value in fold_signals(given).items()
        if isinstance(value, InputSignal)
    }


def draw_signals(result: TrialResult) -> list[str]:
    """Return a line for each argument that is a signal: its curve over time, and its range."""
    lines = []
    for name, signal in input_signals(result).items():
        values = [signal((place + 0.5) / _CURVE_COLUMNS * signal.duration_s) for place in range(_CURVE_COLUMNS)]
        low, high = min(signal.points), max(signal.points)
        levels = [round((value - low) / (high - low) * (len(_LEVELS) - 1)) if high > low else 0 for value in values]
        curve = "".join(_LEVELS[max(0, min(len(_LEVELS) - 1, level))] for level in levels)
        count = count_of(len(signal.points), "point")
        lines.append(
            f"{name} over {signal.duration_s:g} s: {curve} from {low:.4g} to {high:.4g} ({signal.kind}, {count})"
        )
    return lines


def format_inputs(result: TrialResult) -> str:
    """Return the seed and the arguments of a trial as one line."""
    return ", ".join(filter(None, (f"seed {result.spec.seed}", format_arguments(result))))


def _short(value: Value) -> str:
    if isinstance(value, float):
        return format_number(value).replace(",", "")  # so that it can be copied
    return without_folder(value)


def argument_units(directory: Path, settings: HuntSettings) -> dict[tuple[str, str], str]:
    """Return the known units of arguments. The keys are (agent, or empty for the scenario; name of the argument).

    The units come from the snapshot's scenario and from the signatures of crashhunt's agents. No code of a bundle runs.
    """
    try:
        found = latest_snapshot(directory)
        scenario = found.scenario if found is not None else None
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
