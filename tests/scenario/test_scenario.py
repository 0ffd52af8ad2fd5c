from __future__ import annotations

import shutil
import tomllib
from pathlib import Path

import pytest
import tomli_w
from hypothesis import given, strategies as st

from crashhunt.errors import ScenarioError
from crashhunt.scenario import (
    load_scenario,
    scenario_from_dict,
    shipped_folder,
    shipped_scenarios,
)

LOOP = shipped_folder() / "loop"


@pytest.fixture
def loop(tmp_path):
    shutil.copytree(LOOP, tmp_path / "own")
    return tmp_path / "own"


def change(folder: Path, *keys: str, value: object) -> None:
    data = tomllib.loads((folder / "scenario.toml").read_text())
    place = data
    for key in keys[:-1]:
        place = place[key]
    if value is None:
        del place[keys[-1]]
    else:
        place[keys[-1]] = value
    (folder / "scenario.toml").write_text(tomli_w.dumps(data))


@pytest.mark.parametrize("name", shipped_scenarios())
def test_every_shipped_scenario_is_valid_and_complete(name):
    scenario = load_scenario(name)
    assert scenario.name == name
    assert scenario.title
    assert all((scenario.folder / file).is_file() for file in scenario.files())
    for arguments in (scenario.scenario_arguments(), *(scenario.agent_arguments(agent) for agent in scenario.agents)):
        for argument in arguments.values():
            assert argument.default is not None
            assert argument.help
            if argument.kind == "str":  # the name of a model, or a file in the folder
                assert argument.name == "model" or Path(argument.default).is_file()
                continue
            if argument.distribution is None:  # the models of a competent driver do not vary
                assert name.startswith("r157-")
                continue
            assert argument.distribution.contains(argument.default), argument


@pytest.mark.parametrize("file", ["scenario.toml", "own.sumocfg", "hunt.toml", ""])
def test_shipped_scenario_is_noted_next_to_a_folder_of_its_name_with_a_scenario(tmp_path, monkeypatch, file):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "merge").mkdir()
    if file:
        (tmp_path / "merge" / file).touch()
    scenario = load_scenario("merge")
    assert scenario.folder == shipped_folder() / "merge"
    said = [note for note in scenario.notes if note.endswith("--scenario ./merge is the folder here")]
    assert len(said) == (file in ("scenario.toml", "own.sumocfg"))
    monkeypatch.chdir(shipped_folder())
    assert load_scenario("merge").notes == ()


@pytest.mark.parametrize(
    ("keys", "value", "says"),
    [
        (("step_length_s",), "fast", ["step_length_s", "'fast'"]),
        (("step_length_s",), 0.0, ["step_length_s", "0.0"]),
        (("step_length",), 0.1, ["step_length", "did you mean 'step_length_s'"]),
        (("sumo", "nett"), "x", ["sumo.nett", "did you mean 'net'"]),
        (("sumo", "net"), "gone.net.xml", ["gone.net.xml", "does not exist"]),
        (("sumo", "net"), "../own/../loop.net.xml", ["loop.net.xml"]),
        (("sumo", "net"), None, ["sumo.net", "missing"]),
        (("sumo",), None, ["sumo", "missing"]),
        (("agents", "ego", "rout"), "x", ["agents.ego.rout", "did you mean 'route'"]),
        (("agents", "ego", "route"), None, ["agents.ego", "existing, route, edges"]),
        (("agents", "ego", "edges"), ["south"], ["agents.ego", "exactly one"]),
        (("agents", "ego", "action"), "telepathic", ["agents.ego.action", "'telepathic'"]),
        (("agents", "ego", "arguments", "speed", "range"), "30:5", ["speed", "5:30"]),
        (("agents",), {}, ["agents", "[agents.ego]"]),
        (("observation",), {"vehicles": 0}, ["observation.vehicles", "0"]),
        (("observation",), {"features": ["smell"]}, ["observation.features", "'smell'"]),
        (("arguments", "vehicles"), None, ["'vehicles'", "traffic.rou.xml"]),
        (("schema",), 2, ["schema", "2"]),
        (("simulator",), "smuo", ["simulator = 'smuo'", "did you mean 'sumo'?"]),
        (("schema",), None, ["'schema' is missing", "add schema = 1"]),
        (("arguments", "vehicles", "default"), 40, ["arguments.vehicles.default = 40", "'10:35'"]),
        (
            ("agents", "ego", "arguments", "speed", "default"),
            4.0,
            ["speed.default = 4.0", "'5:25'"],
        ),
        (("sumo", "options"), {"seed": 3}, ["seed", "sets itself"]),
    ],
)
def test_a_mistake_is_named_with_file_key_value_and_fix(loop, keys, value, says):
    change(loop, *keys, value=value)
    with pytest.raises(ScenarioError) as caught:
        load_scenario(loop)
    text = str(caught.value)
    for part in says:
        assert part in text, text
    assert str(loop) in text
    assert caught.value.fix
    assert "\n" not in text


@pytest.mark.parametrize("file", ["bad.toml", "scenario.toml"])
@pytest.mark.parametrize(
    ("keys", "value"),
    [
        (("simulater",), "sumo"),
        (("agents", "ego", "arguments", "speed", "range"), "5:x"),
        (("agents", "ego", "arguments", "speed", "default"), 4.0),
        (("sumo", "net"), "gone.net.xml"),
    ],
)
def test_an_error_names_the_file_that_was_read(loop, keys, value, file):
    change(loop, *keys, value=value)
    (loop / "scenario.toml").rename(loop / file)
    with pytest.raises(ScenarioError) as caught:
        load_scenario(loop / file)
    assert caught.value.where.startswith(str(loop / file))


def test_what_ran_before_is_not_refused_in_a_snapshot(loop):
    change(loop, "arguments", "vehicles", "default", value=40)
    change(loop, "schema", value=None)
    assert load_scenario(loop / "scenario.toml", kept=True).arguments["vehicles"].default == 40


def test_a_default_may_be_a_text_that_no_file_could_be_called(loop):
    text = "a prompt, say: " + "word " * 100
    change(loop, "agents", "ego", "arguments", "speed", value={"default": text})
    assert load_scenario(loop / "scenario.toml").agents["ego"].arguments["speed"].default == text


def test_a_path_that_is_not_there_has_a_neighbour(loop, monkeypatch):
    monkeypatch.chdir(loop.parent)
    for name, says in (
        ("owm", "did you mean 'own'?"),
        ("own/scenari.toml", "did you mean 'own/scenario.toml'?"),
        ("Loop", "did you mean 'loop'?"),
        (".", "give the folder that has one"),
    ):
        with pytest.raises(ScenarioError) as caught:
            load_scenario(name)
        assert says in caught.value.fix
    (loop / "scenario.toml").rename(loop / "mine.toml")
    with pytest.raises(ScenarioError, match=r"own: the folder has no scenario\.toml; give own/mine\.toml"):
        load_scenario("own")


def test_paths_of_scenarios_are_listed_where_the_given_one_is_none(tmp_path, monkeypatch):
    paths = r"the path of a folder or of one of these files: scenario\.toml, \*\.sumocfg, \*\.osm or \*\.xodr$"
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ScenarioError, match=f"there is no scenario 'nowhere'; give one of highway, .*, or {paths}"):
        load_scenario("nowhere")
    Path("nowhere").touch()
    with pytest.raises(ScenarioError, match=f"^nowhere: the file is not a scenario; give {paths}"):
        load_scenario("nowhere")


plain = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=5,
)
TABLES = [(), ("sumo",), ("agents",), ("agents", "ego"), ("arguments",), ("observation",)]


@given(st.data())
def test_no_content_raises_anything_else(data):
    content = tomllib.loads((LOOP / "scenario.toml").read_text())
    content.setdefault("observation", {})
    place = content
    for key in data.draw(st.sampled_from(TABLES)):
        place = place[key]
    keys = st.sampled_from(sorted(place)) if place else st.text(max_size=5)
    place[data.draw(keys | st.text(max_size=5))] = data.draw(plain)
    try:
        scenario_from_dict(content, where="here", folder=LOOP)
    except ScenarioError as error:
        assert error.where == "here"


@pytest.mark.parametrize("outside", ["../loop.net.xml", "../own beside/loop.net.xml", "absolute"])
def test_a_file_that_exists_outside_of_the_folder_is_refused(loop, tmp_path, outside):
    (tmp_path / "own beside").mkdir()
    for folder in (tmp_path, tmp_path / "own beside"):
        shutil.copy(loop / "loop.net.xml", folder)
    change(loop, "sumo", "net", value=str(tmp_path / "loop.net.xml") if outside == "absolute" else outside)
    with pytest.raises(ScenarioError, match="lies outside the scenario's folder"):
        load_scenario(loop)


def test_a_way_out_and_in_again_is_inside(loop):
    change(loop, "sumo", "net", value="../own/loop.net.xml")
    assert load_scenario(loop).tables["sumo"].net == "../own/loop.net.xml"


def test_arguments_have_their_names_and_a_mistake_in_them_is_found_by_file_and_table(loop):
    scenario = load_scenario(loop)
    assert {name: argument.name for name, argument in scenario.scenario_arguments().items()} == {
        name: name for name in scenario.arguments
    }
    name = next(name for name, setup in scenario.arguments.items() if setup.range)
    change(loop, "arguments", name, "range", value="odd:")
    with pytest.raises(ScenarioError) as caught:
        load_scenario(loop)
    assert str(loop) in str(caught.value)
    assert name in str(caught.value)
