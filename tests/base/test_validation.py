"""Tables that fit to the letter are built without pydantic, and are what it would have built."""

from __future__ import annotations

import copy
import functools
import json
import subprocess
import sys
import tomllib
from dataclasses import asdict, dataclass, field

import pytest
from pydantic import TypeAdapter, ValidationError

from crashhunt.base.errors import ScenarioError, UsageError
from crashhunt.base.validation import validate
from crashhunt.highway._descriptor import HighwaySetup
from crashhunt.plans import HuntSettings, Request, plan
from crashhunt.scenario import Scenario, backend_of, shipped_folder
from crashhunt.suites import SuiteEntry
from crashhunt.sumo import SumoSetup


def as_read(settings) -> dict:
    """As it is read from a file: plain lists, words and numbers."""
    return json.loads(json.dumps(asdict(settings)))


def tables_of(file) -> list:
    """What every simulator has in a scenario, and its own table."""
    data = tomllib.loads(file.read_text())
    name = data.get("simulator", "sumo")
    table = data.pop(name)
    return [(Scenario, data), (backend_of(name).table, table)]


TABLES = [
    *(pair for file in sorted(shipped_folder().glob("*/scenario.toml")) for pair in tables_of(file)),
    (HuntSettings, as_read(plan(Request(trials=1, max_steps=2, scenario="loop", seed=1))[1])),
]
JUNK = (
    None, True, 0, 1, -1, 2.0, 2**60, float("nan"), "", "1", "ä", "\ud800", "sumo", "hang", [], [1], ["a"], {},
    {"a": 1}, {"\ud800": "a"}, (), ("hang",), b"1",
)  # fmt: skip
GONE, NAMES = object(), ("seed", "title", "new", 3)


def places(data: object, path: tuple = ()):
    """Where something is, in tables and lists."""
    for key, value in data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else ():
        yield (*path, key)
        yield from places(value, (*path, key))


@functools.cache
def adapter(kind) -> TypeAdapter:
    with pytest.raises(ScenarioError):  # of unknown keys, pydantic has been told by then
        validate(kind, {"made-up": 1}, where="here", error=ScenarioError)
    return TypeAdapter(kind)


def same_as_pydantic(kind, data) -> bool:
    """Whether a table is accepted, which pydantic has to see in the same way."""
    try:
        expected = adapter(kind).validate_python(data)
    except ValidationError:
        with pytest.raises(ScenarioError):
            validate(kind, data, where="here", error=ScenarioError)
        return False
    assert repr(validate(kind, data, where="here", error=ScenarioError)) == repr(expected)
    return True


def test_every_table_of_ours_is_what_pydantic_would_have_built():
    assert all(same_as_pydantic(kind, data) for kind, data in TABLES)


@pytest.mark.parametrize(("kind", "least"), [(Scenario, 200), (HuntSettings, 200), (SumoSetup, 20), (HighwaySetup, 20)])
def test_whatever_is_in_a_table_is_seen_as_pydantic_sees_it(kind, least):
    accepted = refused = 0
    for data in [data for known, data in TABLES if known is kind][:2]:
        for *path, last in list(places(data)):
            for change in (*JUNK, GONE, *NAMES):
                changed = copy.deepcopy(data)
                table = changed
                for key in path:
                    table = table[key]
                if change is GONE:
                    del table[last]
                elif change not in NAMES:
                    table[last] = copy.deepcopy(change)
                elif isinstance(table, dict):
                    table[change] = table.pop(last)
                if same_as_pydantic(kind, changed):
                    accepted += 1
                else:
                    refused += 1
    assert min(accepted, refused) > least


def test_a_scenario_that_is_right_needs_no_pydantic():
    program = """
import sys
from crashhunt.scenario import load_scenario
load_scenario("loop"), load_scenario("highway")
assert "pydantic" not in sys.modules
"""
    subprocess.run([sys.executable, "-c", program], check=True)


@pytest.mark.parametrize(
    ("data", "says"),
    [
        ({"routes": "a.rou.xml"}, "routes = 'a.rou.xml': not a list; write routes = […]"),
        ({"routes": {"a": 1}}, "a table where a list of tables is needed; write [[routes]] above each table"),
        ({"options": 3}, "options = 3: not a table; write [options], with the keys below it"),
    ],
)
def test_errors_have_the_terms_of_toml(data, says):
    with pytest.raises(ScenarioError) as caught:
        validate(SumoSetup, {"net": "n.net.xml", **data}, where="here", error=ScenarioError)
    assert says in str(caught.value)


@pytest.mark.parametrize(
    ("data", "says"),
    [
        ({"scenario": 3}, "scenario = 3: input should be a valid string; change the value"),
        ({"snapshot_roots": ["a", 3]}, "snapshot_roots.1 = 3: input should be a valid string;"),
        (
            {"arguments": {"speed": [5, 6]}},
            "arguments.speed = [5, 6]: input should be a valid string, a valid integer, a valid number or a valid bool",
        ),
        ({"agents": {"str": 3}}, "agents.str = 3: input should be a valid string;"),
    ],
)
def test_errors_name_the_key_and_all_types_that_a_value_may_have(data, says):
    with pytest.raises(UsageError) as caught:
        validate(SuiteEntry, data, where="here", error=UsageError)
    assert str(caught.value).startswith(f"here: {says}")


@dataclass
class Wheel:
    size_m: float
    name: str = ""


@dataclass
class Car:
    front: Wheel
    spare: Wheel | None = None
    named: dict[str, Wheel] = field(default_factory=dict)
    others: tuple[Wheel, ...] = ()
    doors: int | bool = 4


RIGHT = {"size_m": 0.3}
THERE = "the keys here are size_m, name"


@pytest.mark.parametrize(
    ("data", "says"),
    [
        ({"front": {"size": 0.3}}, "unknown key 'front.size'; did you mean 'size_m'?"),  # not: it is missing
        ({"front": {"name": "x"}}, "the key 'front.size_m' is missing; add it"),
        ({"front": {"colour": 2}}, "the key 'front.size_m' is missing; add it"),
        ({"front": RIGHT | {"colour": 2}}, f"unknown key 'front.colour'; {THERE}"),
        ({"front": RIGHT, "spare": RIGHT | {"colour": 2}}, f"unknown key 'spare.colour'; {THERE}"),
        ({"front": RIGHT, "named": {"a": RIGHT, "b": RIGHT | {"colour": 2}}}, f"unknown key 'named.b.colour'; {THERE}"),
        ({"front": RIGHT, "others": [RIGHT, RIGHT | {"colour": 2}]}, f"unknown key 'others.1.colour'; {THERE}"),
        ({"front": RIGHT, "colour": 2}, "unknown key 'colour'; the keys here are front, spare, named, others, doors"),
        ({"front": {"size_m": "wide"}}, "front.size_m = 'wide': input should be a valid number"),
        ({"front": RIGHT, "doors": "9" * 5000}, f"doors = '{'9' * 5000}': unable to parse input string as an "),
    ],
)  # fmt: skip
def test_wrong_keys_are_named_with_those_of_their_table(data, says):
    def refusal(**given):
        with pytest.raises(ScenarioError) as caught:
            validate(Car, data, where="here", error=ScenarioError, **given)
        return str(caught.value)

    assert refusal().startswith(f"here: {says}")
    within = says.replace("key '", "key 'car.") if "key '" in says else f"car.{says}"
    assert refusal(under="car", keys=lambda: ["one", "two"]).startswith(
        f"here: {within.replace('front, spare, named, others, doors', 'one, two')}"
    )
    assert (
        validate(Car, {"front": RIGHT, "named": {"a": RIGHT}}, where="", error=ScenarioError).named["a"].size_m == 0.3
    )
