"""JSON Schema of types, and the schema files that the guide has."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any, Literal, NotRequired, TypedDict

import json_schemas
import jsonschema
import pytest

from crashhunt.base.codec import OMIT_DEFAULT, Serializable, null_is
from crashhunt.base.schemas import describe_type, json_schema
from crashhunt.guide._schemas import SCHEMAS, describe_schemas


class Colour(StrEnum):
    RED = "red"


class Shape(TypedDict):
    name: str
    sides: NotRequired[int]


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
    assert schema["properties"]["hint"] == {"type": ["string", "null"]}
    jsonschema.validate(part.to_json(), schema)
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate({**part.to_json(), "where": 3}, schema)


def test_name_that_is_nowhere_is_an_error():
    class Broken(TypedDict):
        key: Missing  # noqa: F821

    with pytest.raises(NameError, match="Missing"):
        describe_type(Broken)


def test_schema_files_are_those_of_the_code():
    """``CRASHHUNT_GOLDEN=write`` writes them again."""
    made = describe_schemas()
    if os.environ.get("CRASHHUNT_GOLDEN") == "write":
        for name, text in made.items():
            (json_schemas.FOLDER / f"{name}.json").write_text(text)
    assert {file.stem: file.read_text() for file in json_schemas.FOLDER.glob("*.json")} == made
    for text in made.values():
        jsonschema.Draft202012Validator.check_schema(json.loads(text))


def test_reference_links_every_schema():
    page = (json_schemas.FOLDER.parent / "json.md").read_text()
    assert all(f"schemas/{name}.json" in page for name in SCHEMAS)


def test_output_that_its_schema_refuses_fails():
    with pytest.raises(AssertionError, match="'hunts' is a required property"):
        json_schemas.check_output(("status", "x", "--json"), "{}")
    json_schemas.check_output(("status", "x"), "{}")
    with pytest.raises(AssertionError, match="'fix' is a required property"):
        json_schemas.check_output(("run", "--json"), '{"error": {"message": "a"}}')
