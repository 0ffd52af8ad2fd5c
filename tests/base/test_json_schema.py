"""JSON Schema of types, and the schema files that the guide has."""

from __future__ import annotations

import argparse
import json
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any, Literal, NamedTuple, NotRequired, TypedDict

import json_schemas
import jsonschema
import pytest

from crashhunt.base.codec import OMIT_DEFAULT, Serializable, null_is
from crashhunt.base.json_schema import describe_type, json_schema
from crashhunt.cli import make_parser
from crashhunt.guide import find_page
from crashhunt.guide._schemas import SCHEMAS, describe_schemas
from crashhunt.trial import Outcome


class Colour(StrEnum):
    RED = "red"


class Shape(TypedDict):
    name: str
    sides: NotRequired[int]


class Bounds(NamedTuple):
    low: float


class Partial(TypedDict, total=False):
    name: str


@dataclass(frozen=True)
class Part(Serializable):
    where: Path
    size: float = field(default=1.0, metadata=null_is(float("inf")))
    note: str = field(default="", metadata=OMIT_DEFAULT)
    hint: str | None = None

    @property
    def is_big(self) -> bool:
        return self.size > 1

    json_keys = ("where", "size", "note", "hint?", "is_big")


@dataclass(frozen=True)
class Whole(Serializable):
    part: Part
    bounds: tuple[int, str]
    spare: Part | None = None

    json_keys = ("size=part.size", "first=bounds.0", "spare=spare.where", "hint?=part.hint")


@dataclass(frozen=True)
class Own(Serializable):
    number: int

    def to_json(self) -> dict[str, Any]:
        return {"other": self.number}


@pytest.mark.parametrize(
    ("hint", "schema"),
    [
        (int, {"type": "integer"}),
        (int | None, {"type": ["integer", "null"]}),
        (Literal["a", 1], {"enum": ["a", 1]}),
        (Colour, {"enum": ["red"]}),
        (tuple[str, ...], {"type": "array", "items": {"type": "string"}}),
        (tuple[int, str], {"type": "array", "prefixItems": [{"type": "integer"}, {"type": "string"}],
                           "minItems": 2, "maxItems": 2}),
        (Mapping[str, list[int]], {"type": "object",
                                   "additionalProperties": {"type": "array", "items": {"type": "integer"}}}),
        (Any, {}),
        (Any | None, {}),
        (dict[str, int] | None, {"anyOf": [{"type": "object", "additionalProperties": {"type": "integer"}},
                                           {"type": "null"}]}),
        (Own, {"type": "object"}),
        (Bounds, {"type": "object", "properties": {"low": {"type": ["number", "null"]}}, "required": ["low"]}),
        ({"a": int, "b?": [str]}, {"type": "object", "required": ["a"], "properties": {
            "a": {"type": "integer"}, "b": {"type": "array", "items": {"type": "string"}}}}),
        ({"**": Shape, "sides": str}, {"type": "object", "required": ["name", "sides"], "properties": {
            "name": {"type": "string"}, "sides": {"type": "string"}}}),
        ((int, None), {"type": ["integer", "null"]}),
        (Outcome, {"type": "string"}),  # oracles add further ones
        (Partial, {"type": "object", "properties": {"name": {"type": "string"}}}),
    ],
)  # fmt: skip
def test_schema_of_a_type(hint, schema):
    assert describe_type(hint) == schema
    jsonschema.Draft202012Validator.check_schema(schema)


def test_optional_keys_of_a_typed_dictionary_are_not_required():
    schema = json_schema(Shape, "A shape")
    assert schema["required"] == ["name"]
    jsonschema.validate({"name": "x", "sides": 3, "later": None}, schema)
    with pytest.raises(jsonschema.ValidationError, match="'name' is a required property"):
        jsonschema.validate({"sides": 3}, schema)
    with pytest.raises(jsonschema.ValidationError, match="'3' is not of type 'integer'"):
        jsonschema.validate({"name": "x", "sides": "3"}, schema)


@pytest.mark.parametrize("part", [Part(Path("a")), Part(Path("a"), float("inf"), "n")])
def test_schema_of_a_dataclass_accepts_what_the_codec_writes(part):
    schema = describe_type(Part)
    assert schema["required"] == ["is_big", "size", "where"]
    assert schema["properties"]["hint"] == {"type": "string"}  # not written where it is None
    jsonschema.validate(part.to_json(), schema)
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate({**part.to_json(), "where": 3}, schema)


def test_keys_of_objects_inside_have_the_types_of_their_attributes():
    whole = Whole(Part(Path("a"), float("inf")), (3, "x"))
    assert whole.to_json() == {"size": None, "first": 3, "spare": None}
    assert Whole(Part(Path("a"), 2.0, hint="h"), (3, "x"), Part(Path("b"))).to_json() == {
        "size": 2.0, "first": 3, "spare": "b", "hint": "h"
    }  # fmt: skip
    assert describe_type(Whole) == {
        "type": "object",
        "properties": {
            "size": {"type": ["number", "null"]},
            "first": {"type": "integer"},
            "spare": {"type": ["string", "null"]},
            "hint": {"type": "string"},
        },
        "required": ["first", "size", "spare"],
    }


def test_name_that_is_nowhere_is_an_error():
    class Broken(TypedDict):
        key: Missing  # noqa: F821

    with pytest.raises(NameError, match="Missing"):
        describe_type(Broken)


def test_schema_files_are_those_of_the_code():
    """``CRASHHUNT_GOLDEN=write`` writes them again."""
    made = describe_schemas()
    if os.environ.get("CRASHHUNT_GOLDEN") == "write":
        check_all(made)
        for name, text in made.items():
            (json_schemas.FOLDER / f"{name}.json").write_text(text)
    files = {
        file.relative_to(json_schemas.FOLDER).with_suffix("").as_posix(): file
        for file in json_schemas.FOLDER.rglob("*.json")
    }
    assert {name: file.read_text() for name, file in files.items()} == made


@pytest.mark.nightly  # by day, those that are written; the files are those of the code
def test_schemas_of_the_code_are_schemas():
    check_all(describe_schemas())


def check_all(schemas):
    for text in schemas.values():
        jsonschema.Draft202012Validator.check_schema(json.loads(text))


def commands_with_json(parser, words=()):
    """Yield the words of each command that has the option."""
    for action in parser._actions:
        if "--json" in action.option_strings:
            yield "-".join(words)
        if isinstance(action, argparse._SubParsersAction):
            for name, command in action.choices.items():
                yield from commands_with_json(command, (*words, name))


def test_every_command_with_json_has_a_schema_that_the_reference_links():
    page = find_page("json").text(make_parser())
    assert {*commands_with_json(make_parser()), "error"} == {*SCHEMAS}
    assert re.findall(r"\(schemas/(\S+)\.json\)", page) == sorted(SCHEMAS)


def test_output_that_its_schema_refuses_fails():
    with pytest.raises(AssertionError, match="'hunts' is a required property"):
        json_schemas.check_output(("status", "x", "--json"), "{}")
    json_schemas.check_output(("status", "x"), "{}")
    with pytest.raises(AssertionError, match="'fix' is a required property"):
        json_schemas.check_output(("run", "--json"), '{"error": {"message": "a"}}')
