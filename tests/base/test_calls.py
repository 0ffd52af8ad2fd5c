"""Calls with wrong arguments, and functions whose keywords are the fields of a dataclass."""

from __future__ import annotations

import inspect
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING

import pytest

import crashhunt
from crashhunt.base.calls import called_with, clear_calls, clear_constructor
from crashhunt.base.errors import CallError
from crashhunt.base.progress import watched

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence


@clear_constructor
@dataclass
class Asked:
    """What is requested.

    Args:
        count: the number of answers.
        names: the names.
    """

    count: int
    names: list[str] = field(default_factory=list)


@called_with(Asked, documents=[SimpleNamespace(line="more: further answers.")])
def ask(asked: Asked) -> str:
    """Ask.

    Raises:
        CallError: a keyword is unknown.
    """
    return f"{asked.count} {asked.names}"


@clear_calls()
def draw(place, *points, width=1):
    return place, points, width


def test_function_takes_the_fields_of_a_dataclass_and_documents_them():
    assert ask(2, names=["a"]) == "2 ['a']"
    assert str(inspect.signature(ask)) == "(count: 'int', names: 'list[str]' = []) -> 'str'"
    assert ask.__doc__ == (
        "Ask.\n\nArgs:\n    count: the number of answers.\n    names: the names.\n    more: further answers."
        "\n\nRaises:\n    CallError: a keyword is unknown."
    )


@pytest.mark.parametrize(
    ("call", "message", "fix"),
    [
        (lambda: ask(3, nams=[]), "ask() has no argument 'nams'", "did you mean 'names'? it takes count, names"),
        (lambda: ask(), "ask(): missing a required", "call ask(count, …)"),
        (lambda: ask(1, [], 2), "ask(): too many positional arguments", "call ask(count, …)"),
        (lambda: Asked(cont=1), "Asked() has no argument 'cont'", "did you mean 'count'?"),
        (lambda: Asked(), "Asked(): missing a required", "call Asked(count, …)"),
        (lambda: draw(), "draw(): missing a required", "call draw(place, *points, …)"),
        (lambda: draw(1, colour=2), "draw() has no argument 'colour'", "it takes place, width"),
        (lambda: clear_calls()(lambda one: one)(), "<lambda>(): missing a required", "call <lambda>(one)"),
        (lambda: clear_calls()(lambda: 1)(one=1), "<lambda>() has no argument 'one'", "no keywords"),
    ],
)
def test_wrong_arguments_are_refused_with_the_right_ones(call, message, fix):
    with pytest.raises(CallError) as refused:
        call()
    assert refused.value.message.startswith(message)
    assert fix in refused.value.fix


def test_right_arguments_reach_the_function():
    assert draw(1, 2, 3, width=4) == (1, (2, 3), 4)
    assert Asked(count=1) == Asked(1, [])
    assert draw.__name__ == "draw"


def test_progress_is_reported_after_each_item():
    told = []
    for item in watched("ab", 5, lambda *now: told.append(now)):
        told.extend(item)
    assert told == ["a", (1, 5), "b", (2, 5)]
    assert [*watched("ab", 5, None)] == ["a", "b"]


@clear_calls()
def open_hunt(place: Path | str, *, table: Mapping[str, int] | None = None, words: Sequence[str] = ()):
    return place, table, words


@pytest.mark.parametrize(
    ("call", "message", "fix"),
    [
        (lambda: open_hunt(5), "open_hunt(): place is 5", "give a path"),
        (lambda: open_hunt(None), "open_hunt(): place is None", "give a path"),
        (lambda: open_hunt("h", table=[1]), "open_hunt(): table is [1]", "give a dictionary"),
        (lambda: open_hunt("h", words=5), "open_hunt(): words is 5", "give a list"),
        (lambda: open_hunt("h", words="stop"), "open_hunt(): words is 'stop'", "give a list"),
        (lambda: open_hunt("h", words=["stop", 5]), "open_hunt(): words is ['stop', 5]", "give a list"),
        (lambda: crashhunt.load(5), "load(): directory is 5", "give a path"),
        (lambda: crashhunt.replay(5), "replay(): crash is 5", "give the path of a hunt or a crash, or a crash of"),
        (lambda: crashhunt.compare("h", 5), "compare(): directories is 5", "give a path"),
        (
            lambda: crashhunt.prepare("h", 1, 1, 1, snapshot=5),
            "prepare(): snapshot is 5",
            "give crashhunt.snapshots.SnapshotOptions(…)",
        ),
        (lambda: crashhunt.prepare("h", 1, 1, 1, command=5), "prepare(): command is 5", "give a list"),
    ],
)
def test_value_that_is_no_path_table_or_list_is_refused(call, message, fix):
    with pytest.raises(CallError) as refused:
        call()
    assert refused.value.message == message
    assert refused.value.fix.startswith(fix)


def test_values_of_the_annotated_types_are_accepted():
    assert open_hunt(Path("h"), table={"a": 1}, words={"stop"}) == (Path("h"), {"a": 1}, {"stop"})
    assert open_hunt("h", table=None) == ("h", None, ())
