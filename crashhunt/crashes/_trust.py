"""What a stranger's crash may make this process do when its recorded actions are driven: simulate, and nothing else."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any
from xml.parsers import expat

from crashhunt.base.errors import ScenarioError, UsageError
from crashhunt.base.plugins import registered
from crashhunt.oracles import oracle_name
from crashhunt.scenario.backends.sumo import (
    ATTRIBUTES,
    ELEMENTS,
    HARMLESS,
    LABELS,
    READ,
    WRITTEN,
    canonical,
    filled_in,
    is_output,
    is_shown,
    read_xml,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from crashhunt.base.plugins import Group
    from crashhunt.plans import HuntSettings
    from crashhunt.scenario import Scenario, SumoSetup

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
    if scenario.gym is not None and (scenario.gym.kwargs or scenario.arguments or values):
        raise _refusal("it gives its environment arguments")
    asked = [spec.spec for spec in settings.scenario_arguments.values() if spec.kind == "str"]
    for text in _texts([scenario.highway.config, asked, list(values.values())] if scenario.highway else []):
        if "." in text and not text.startswith("highway_env."):  # the class of a vehicle
            raise _refusal(f"its configuration names {text!r}")
    if scenario.sumo is not None:
        _check_sumo(scenario, scenario.sumo, values)


def _check_sumo(scenario: Scenario, sumo: SumoSetup, values: Mapping[str, Any]) -> None:
    options = [*sumo.options, *(setup.option for setup in scenario.arguments.values() if setup.option)]
    for option in options:
        name = canonical(option)
        if name not in HARMLESS or is_output(name) or is_shown(name):
            raise _refusal(f"it sets SUMO's option {option!r}")
    texts = set(scenario.texts())
    for file in scenario.files():
        try:
            content = read_xml(scenario.folder / file)
            if file in texts and not sumo.literal:
                content = filled_in(content, values)
        except (ScenarioError, UnicodeDecodeError, KeyError, ValueError) as error:
            raise _refusal(f"{file} cannot be checked: {error}") from None
        _check_text(file, content, reads=file in texts)


def _check_text(file: str, content: bytes, *, reads: bool) -> None:
    """Refuse an XML file that has anything but what is known to simulate.

    Args:
        file: its name.
        content: as SUMO gets it.
        reads: whether the files that it names have been looked at.
    """
    parser = expat.ParserCreate()

    def start(tag: str, attributes: dict[str, str]) -> None:
        if tag not in ELEMENTS:
            raise _refusal(f"{file} has <{tag}>, of which nobody knows what SUMO does with it")
        for name, value in attributes.items():
            if (tag, name) in READ:
                if not reads or value.startswith("/") or "${" in value:
                    raise _refusal(f"{file} has <{tag} {name}={value!r}>, and SUMO would read that file")
            elif name not in ATTRIBUTES and name not in WRITTEN:  # these are turned away from where they point
                raise _refusal(f"{file} has <{tag} {name}=…>, of which nobody knows what SUMO does with it")
        key, value = attributes.get("key", ""), attributes.get("value", "")
        if tag == "param" and key not in LABELS and {"/", "\\", ":"}.intersection(value):
            raise _refusal(f"{file} has the parameter {key} = {value!r}, which might name a file")

    def doctype(*_: object) -> None:
        raise _refusal(f"{file} has a document type, with which it may say anything")

    parser.StartElementHandler = start
    parser.StartDoctypeDeclHandler = doctype
    try:
        parser.Parse(content, True)
    except (expat.ExpatError, ValueError, LookupError) as error:
        raise _refusal(f"{file} cannot be checked: {error}") from None


def _texts(value: Any) -> Iterator[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict | list | tuple):
        for inner in value.values() if isinstance(value, dict) else value:
            yield from _texts(inner)


def _refusal(reason: str) -> UsageError:
    return UsageError(f"the crash is a stranger's, and {reason}", fix="give --trust if you trust who made it")
