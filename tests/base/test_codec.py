"""The codec: dataclasses as JSON objects, as their annotations and the metadata of their fields say."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path

import pytest

from crashhunt.base.codec import (
    ESSENTIAL,
    OMIT_DEFAULT,
    Serializable,
    essentials,
    not_understood,
    null_is,
    plain,
    plain_types,
    prepare,
    written_if,
)


class Colour(StrEnum):
    RED = "red"


@dataclass(frozen=True, slots=True)
class Part(Serializable):
    name: str
    gap_m: float = field(default=0.0, metadata=null_is(math.inf))


@dataclass(frozen=True, slots=True)
class Whole(Serializable):
    part: Part
    parts: tuple[Part, ...] = ()
    maybe: Part | None = None
    by_name: Mapping[str, Part] = field(default_factory=dict)
    tags: frozenset[str] = frozenset()
    colour: Colour = Colour.RED
    file: Path | None = None
    note: str = field(default="", metadata=OMIT_DEFAULT)
    count: int = field(default=0, metadata=written_if(lambda whole: whole.note))

    json_keys = ("colour", "part", "parts", "maybe", "by_name", "tags", "file", "size?", "note", "count")

    @property
    def size(self) -> int | None:
        return len(self.parts) or None


FULL = Whole(
    Part("a", math.inf), (Part("b"), Part("c", 1.5)), Part("d"), {"e": Part("f")}, frozenset("zy"), file=Path("x/y"),
    note="n", count=3,
)  # fmt: skip


def test_object_comes_back_equal_from_strict_json():
    text = json.dumps(FULL.to_json(), allow_nan=False)
    assert Whole.from_json(json.loads(text)) == FULL


def test_keys_are_written_in_the_declared_order_and_shape():
    assert json.dumps(FULL.to_json()) == (
        '{"colour": "red", "part": {"name": "a", "gap_m": null}, '
        '"parts": [{"name": "b", "gap_m": 0.0}, {"name": "c", "gap_m": 1.5}], "maybe": {"name": "d", "gap_m": 0.0}, '
        '"by_name": {"e": {"name": "f", "gap_m": 0.0}}, "tags": ["y", "z"], "file": "x/y", "size": 2, "note": "n", '
        '"count": 3}'
    )


def test_defaults_conditions_and_missing_properties_omit_their_keys():
    assert list(Whole(Part("a"), count=3).to_json()) == ["colour", "part", "parts", "maybe", "by_name", "tags", "file"]


@pytest.mark.parametrize("number", [math.inf, -math.inf, math.nan])
def test_number_that_is_not_finite_is_null_and_comes_back_as_declared(number):
    assert Part("a", number).to_json() == {"name": "a", "gap_m": None}
    assert Part.from_json({"name": "a", "gap_m": None}) == Part("a", math.inf)


def test_unknown_keys_are_ignored_and_missing_keys_are_the_defaults():
    assert Whole.from_json({"part": {"name": "a", "later": 1}, "later": {}}) == Whole(Part("a"))
    assert Whole.from_json({"part": {"name": "a"}, "maybe": None, "parts": None}) == Whole(Part("a"))


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({}, "'part' is missing"),
        ({"part": {}}, "part: 'name' is missing"),
        ({"part": "near"}, "part: 'near' is not a JSON object"),
        ({"part": {"name": "a"}, "parts": [{"gap_m": 1}]}, "parts: 'name' is missing"),
        ({"part": {"name": "a"}, "colour": "blue"}, "colour: 'blue' is not a valid Colour"),
        ({"part": {"name": "a"}, "by_name": [1]}, "by_name: 'list' object has no attribute 'items'"),
    ],
)
def test_data_that_cannot_be_read_is_refused_with_the_key(data, message):
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        Whole.from_json(data)


def test_prepared_class_and_those_inside_it_convert_without_further_preparation():
    from crashhunt.base import codec

    def misses():
        return [cached.cache_info().misses for cached in (codec._write_function, codec._readers, codec._essentials_of)]

    prepare(Whole)
    before = misses()
    assert Whole.from_json(FULL.to_json()) == FULL
    assert not_understood(["later"], Whole) == ["later"]
    assert misses() == before


def test_types_of_plain_data_are_those_of_the_annotations():
    needed, known = plain_types(Whole)
    assert needed == {"part": dict}
    assert known == {
        "part": dict, "parts": list[dict], "maybe": dict | None, "by_name": dict, "tags": list[str], "colour": str,
        "file": str | None, "note": str, "count": int,
    }  # fmt: skip
    assert plain_types(Part) == ({"name": str}, {"name": str, "gap_m": float | None})


@dataclass(frozen=True)
class _Inner:
    deep: int = field(default=0, metadata=ESSENTIAL)
    light: int = 0


@dataclass(frozen=True)
class _Outer:
    parts: tuple[_Inner, ...] = ()
    by_name: Mapping[str, _Inner] | None = None
    kind: str = field(default="", metadata=ESSENTIAL)
    words: str = ""


def test_a_reader_that_lacks_an_essential_field_knows_that_it_does_not_understand():
    assert essentials(_Outer) == {"deep", "kind"}
    assert essentials(_Inner, str) == {"deep"}
    assert not_understood(["kind", "deep"], _Outer) == []
    assert not_understood(["kind", "deep", "later"], _Inner) == ["kind", "later"]
    assert not_understood([], _Inner) == []


def test_numbers_that_json_does_not_have_are_null_at_every_depth():
    found = plain({1: math.nan, "a": [math.inf, 2.5, (-math.inf, "x")], "b": {"c": True}})
    assert found == {"1": None, "a": [None, 2.5, [None, "x"]], "b": {"c": True}}
