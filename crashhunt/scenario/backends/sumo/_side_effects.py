"""What SUMO would do for a stranger's scenario besides simulating; what nobody knows is taken for the worst."""

from __future__ import annotations

from typing import TYPE_CHECKING
from xml.parsers import expat

from crashhunt.base.errors import ScenarioError
from crashhunt.scenario.backends.sumo._allowed import ATTRIBUTES, ELEMENTS, LABELS
from crashhunt.scenario.backends.sumo._files import filled_in
from crashhunt.scenario.backends.sumo._options import HARMLESS, canonical, is_output, is_shown
from crashhunt.scenario.backends.sumo._table import SumoSetup
from crashhunt.scenario.backends.sumo._xml import READ, WRITTEN, read_xml

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from crashhunt.scenario._scenario import Scenario
    from crashhunt.trial import Value

__all__ = ["side_effect"]


class _SideEffectError(Exception):
    """With what it is, in words."""


def side_effect(scenario: Scenario, values: Mapping[str, Value], _specifications: Iterable[str]) -> str:
    """Return what else SUMO would do with the options and files of a scenario; empty where that is nothing."""
    sumo = scenario.table(SumoSetup)
    options = [*sumo.options, *(setup.option for setup in scenario.arguments.values() if setup.option)]
    for option in options:
        name = canonical(option)
        if name not in HARMLESS or is_output(name) or is_shown(name):
            return f"it sets SUMO's option {option!r}"
    texts = set(scenario.texts())
    for file in scenario.files():
        try:
            content = read_xml(scenario.folder / file)
            if file in texts and not sumo.literal:
                content = filled_in(content, values)
            _check_text(file, content, reads=file in texts)
        except (ScenarioError, UnicodeDecodeError, KeyError, ValueError) as error:
            return f"{file} cannot be checked: {error}"
        except _SideEffectError as effect:
            return str(effect)
    return ""


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
            raise _SideEffectError(f"{file} has <{tag}>, of which nobody knows what SUMO does with it")
        for name, value in attributes.items():
            if (tag, name) in READ:
                if not reads or value.startswith("/") or "${" in value:
                    raise _SideEffectError(f"{file} has <{tag} {name}={value!r}>, and SUMO would read that file")
            elif name not in ATTRIBUTES and name not in WRITTEN:  # these are turned away from where they point
                raise _SideEffectError(f"{file} has <{tag} {name}=…>, of which nobody knows what SUMO does with it")
        key, value = attributes.get("key", ""), attributes.get("value", "")
        if tag == "param" and key not in LABELS and {"/", "\\", ":"}.intersection(value):
            raise _SideEffectError(f"{file} has the parameter {key} = {value!r}, which might name a file")

    def doctype(*_: object) -> None:
        raise _SideEffectError(f"{file} has a document type, with which it may say anything")

    parser.StartElementHandler = start
    parser.StartDoctypeDeclHandler = doctype
    try:
        parser.Parse(content, True)
    except (expat.ExpatError, LookupError) as error:
        raise _SideEffectError(f"{file} cannot be checked: {error}") from None
