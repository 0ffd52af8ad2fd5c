"""Checks, digests and files of scenarios, one function at a time: what each accepts, and what it refuses."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from crashhunt.base import integrity
from crashhunt.base.errors import HuntDirectoryError, ScenarioError, UsageError
from crashhunt.gym._descriptor import BACKEND as GYM, CrashRule, GymSetup
from crashhunt.highway._descriptor import BACKEND as HIGHWAY, HighwaySetup
from crashhunt.scenario import (
    AgentSetup,
    ArgumentSetup,
    Backend,
    ObservationSetup,
    Scenario,
    _load,
    argument_values,
    as_plain_data,
    backend_of,
    load_scenario,
    scenario_digest,
    shipped_folder,
)
from crashhunt.scenario._load import check, copy_shipped_scenario, scenario_from_dict
from crashhunt.scenario._scenario import STEP_LENGTH_S, digest_of_described, with_action
from crashhunt.sumo import BACKEND as SUMO, SumoSetup, _ego_choice
from crashhunt.sumo._files import StagedFiles, filled_in, movable, read_xml, references, written_by
from crashhunt.sumo._options import HARMLESS

ROUTES = (
    '<routes><route id="way" edges="south east north west"/>'
    '<flow id="f" route="way" begin="0" end="9" period="3"/></routes>'
)


@pytest.fixture
def town(tmp_path):
    """A scenario on the loop, with a controlled vehicle that has a route."""
    folder = tmp_path / "town"
    folder.mkdir()
    shutil.copy(shipped_folder() / "loop" / "loop.net.xml", folder / "net.xml")
    (folder / "r.rou.xml").write_text(ROUTES)
    ego = AgentSetup(agent="keep-lane", route="way", target_speeds=(5.0, 10.0))
    return Scenario(
        simulator="sumo", folder=folder, agents={"ego": ego},
        tables={"sumo": SumoSetup(net="net.xml", routes=("r.rou.xml",))},
    )  # fmt: skip


def refusal(function, *given, **more):
    """Return message and fix of the refusal, without the place."""
    with pytest.raises(ScenarioError) as caught:
        function(*given, **more)
    return caught.value.message, caught.value.fix, caught.value.where


@pytest.mark.parametrize(
    ("changes", "message", "fix"),
    [
        ({"agents": {}}, "agents = {} names no controlled vehicle", "add a table [agents.ego]"),
        ({"step_length_s": 0.0}, "step_length_s = 0.0 is not a time above 0", "give seconds, such as 0.1"),
        ({"insertion_timeout_s": float("inf")}, "insertion_timeout_s = inf is not a time above 0", "give seconds"),
        ({"warmup_s": -1.0}, "warmup_s = -1.0 is not a time", "give seconds, such as 20.0"),
        ({"warmup_s": float("inf")}, "warmup_s = inf is not a time", "give seconds, such as 20.0"),
        (
            {"observation": ObservationSetup(vehicles=0)}, "observation.vehicles = 0 is below 1", "give at least 1",
        ),
        ({"events": {"odd": 1.0}}, "events = 'odd' has no limit", "give some of "),
        ({"events": {"hard_braking": 0.0}}, "events.hard_braking = 0.0 is not a limit", "above 0"),
        ({"tables": {}}, "sumo = None is missing", "add a table [sumo] with net and routes"),
    ],
)  # fmt: skip
def test_invalid_key_of_a_scenario_is_named_with_its_value_and_the_fix(town, changes, message, fix):
    said, advice, where = refusal(check, replace(town, **changes), "s.toml", kept=False)
    assert said == message
    assert fix in advice
    assert where == "s.toml"


def test_valid_bounds_of_a_scenario_are_accepted(town):
    check(replace(town, warmup_s=0.0, observation=ObservationSetup(vehicles=1)), "s.toml", kept=False)
    other = {**town.tables, "highway": HighwaySetup(id="x")}
    assert refusal(check, replace(town, tables=other), "s.toml", kept=False)[:2] == (
        "simulator = 'sumo' has no use for the table [highway]", "remove it",
    )  # fmt: skip
    check(replace(town, tables=other), "s.toml", kept=True)


def test_keys_of_another_simulator_are_refused(tmp_path):
    plain = Scenario(simulator="highway", folder=tmp_path, tables={"highway": HighwaySetup(id="merge-v0")})
    check(plain, "s.toml", kept=False)
    for changes, key in (
        ({"warmup_s": 5.0}, "warmup_s = 5.0"), ({"insertion_timeout_s": 5.0}, "insertion_timeout_s = 5.0"),
        ({"agents": {"ego": AgentSetup(route="way")}}, "agents.ego.route = 'way'"),
        ({"agents": {"ego": AgentSetup(speed_mode=7)}}, "agents.ego.speed_mode = 7"),
    ):  # fmt: skip
        said, advice, _ = refusal(check, replace(plain, **changes), "s.toml", kept=False)
        assert said == f"{key} is for SUMO"
        assert advice == "remove it"


def test_files_of_a_scenario_are_there_and_inside_its_folder(town):
    def named(name):
        sumo = replace(town.table(SumoSetup), additional=(name,))
        return refusal(check, town.with_table(sumo), "s.toml", kept=False)

    assert named("no.xml")[:2] == (
        "sumo = 'no.xml' does not exist", f"give a path relative to {town.folder}",
    )  # fmt: skip
    (town.folder.parent / "out.xml").write_text("<additional/>")
    assert named("../out.xml")[:2] == (
        "sumo = '../out.xml' lies outside the scenario's folder", "move it inside, so that it can be archived",
    )  # fmt: skip
    (town.folder / "a,b.xml").write_text("<additional/>")
    assert named("a,b.xml")[:2] == ("sumo = 'a,b.xml' has a comma, at which SUMO begins another file", "rename it")
    (town.folder / "c.xml").write_text("<additional><a v='${count}'/></additional>")
    assert named("c.xml")[:2] == ("arguments = [] has no 'count', which c.xml asks for", "declare it")
    literal = replace(town.table(SumoSetup), additional=("c.xml",), literal=True)
    check(town.with_table(literal), "s.toml", kept=False)


@pytest.mark.parametrize(
    ("changes", "message", "fix"),
    [
        ({"route": ""}, "agents.ego = [] must have one of", "give exactly one of them"),
        ({"existing": "f.0"}, "agents.ego = ['existing', 'route'] must have one of", "give exactly one of them"),
        ({"route": "", "replaces": "who"}, "agents.ego.replaces = 'who' is no scenario argument", "declare it"),
        ({"target_speeds": (5.0, 5.0)}, "agents.ego.target_speeds = (5.0, 5.0) does not rise", "from low to high"),
        ({"target_speeds": ()}, "agents.ego.target_speeds = () does not rise", "from low to high"),
    ],
)
def test_controlled_vehicle_of_sumo_is_said_once(town, changes, message, fix):
    ego = replace(town.agents["ego"], **changes)
    said, advice, where = refusal(check, replace(town, agents={"ego": ego}), "s.toml", kept=False)
    assert said.startswith(message)
    assert fix in advice
    assert where == "s.toml"


def test_scenario_that_comes_with_crashhunt_is_copied_with_its_files(tmp_path):
    copy_shipped_scenario("loop", tmp_path / "new/loop")
    source = shipped_folder() / "loop"
    assert {path.name for path in (tmp_path / "new/loop").iterdir()} == {
        path.name for path in source.iterdir() if path.is_file()
    }
    assert load_scenario(tmp_path / "new/loop").agents == load_scenario("loop").agents
    with pytest.raises(HuntDirectoryError, match="the folder is not empty; give a new folder"):
        copy_shipped_scenario("loop", tmp_path / "new/loop")
    (tmp_path / "file").touch()
    with pytest.raises(HuntDirectoryError, match="the folder is not empty"):
        copy_shipped_scenario("loop", tmp_path / "file")
    with pytest.raises(HuntDirectoryError):
        copy_shipped_scenario("loop", tmp_path / "file/below")
    (tmp_path / "empty").mkdir()
    copy_shipped_scenario("loop", tmp_path / "empty")
    said, advice, _ = refusal(copy_shipped_scenario, "lop", tmp_path / "x")
    assert said == "no scenario 'lop' comes with crashhunt"
    assert "'loop'" in advice


def test_file_that_scenarios_share_is_copied_too(tmp_path, monkeypatch):
    one, two = tmp_path / "all/one", tmp_path / "all/two"
    for folder in (one, two):
        (folder / "folder").mkdir(parents=True)
        (folder / "scenario.toml").write_text('weights = "../two/w.npz"\nmap = "m.xml"\n')
        (folder / "m.xml").write_text(folder.name)
    (two / "w.npz").write_text("weights")
    monkeypatch.setattr(_load, "shipped_folder", lambda: tmp_path / "all")
    copy_shipped_scenario("one", tmp_path / "new")
    assert {path.name: path.read_text() for path in (tmp_path / "new").iterdir()} == {
        "scenario.toml": 'weights = "w.npz"\nmap = "m.xml"\n', "m.xml": "one", "w.npz": "weights",
    }  # fmt: skip


def test_scenario_file_that_cannot_be_read_is_one_line(tmp_path):
    file = tmp_path / "scenario.toml"
    for text in ("schema = 1\n[agents.ego]\n[toy", "\x00", "schema = 1\nschema = 1"):
        file.write_text(text)
        assert refusal(load_scenario, file)[0].startswith("not valid TOML: ")
    for key in ("folder", "file", "notes", "added"):
        file.write_text(f'schema = 1\nsimulator = "toy"\n{key} = 1\n')
        assert refusal(load_scenario, file)[:2] == (f"unknown key {key!r}", "remove it")
    file.write_text('simulator = "toy"\n[agents.ego]\n')
    assert refusal(load_scenario, file)[:2] == ("the key 'schema' is missing", "add schema = 1")
    load_scenario(file, kept=True)
    assert refusal(load_scenario, file, ego="f.0")[0].startswith("--ego 'f.0' ")


def test_scenario_file_that_the_system_refuses_is_one_line(tmp_path, monkeypatch):
    def refused(path, flags):
        raise PermissionError(13, "Permission denied")

    file = tmp_path / "scenario.toml"
    file.touch()
    monkeypatch.setattr(integrity, "open_at_once", refused)
    said, _, where = refusal(load_scenario, file)
    assert (said, where) == ("cannot be read: Permission denied", str(file))


def test_unknown_keys_are_kept_only_from_a_later_version(tmp_path):
    data = {"schema": 1, "simulator": "toy", "later": {"a": 1}, "agents": {"ego": {}}}
    assert scenario_from_dict(data, where="s", folder=tmp_path, tolerant=True).added == {"later": {"a": 1}}
    with pytest.raises(ScenarioError, match="unknown key 'later'"):
        scenario_from_dict(data, where="s", folder=tmp_path)
    del data["later"]
    plain = scenario_from_dict(data, where="s", folder=tmp_path)
    assert plain.added == {}
    assert plain == replace(plain, added={"later": 1})  # which changes no result
    assert plain.observation == ObservationSetup()
    assert plain.observation.normalize is False
    assert plain.step_length_s == STEP_LENGTH_S == 0.1
    assert plain.name == tmp_path.name
    assert scenario_from_dict(data | {"name": "mine"}, where="s", folder=tmp_path).name == "mine"


@pytest.mark.parametrize(
    ("agent", "joined"),
    [
        ({"exec": ["./planner", "--rate=2.5", "a b"]}, {"agent": "exec:/town/planner --rate=2.5 'a b'"}),
        ({"exec": ["./planner"], "reuse": True}, {"agent": "exec:/town/planner", "reuse": True}),
        ({"lib": "./planner.so"}, {"agent": "lib:/town/planner.so"}),
    ],
)
def test_command_of_an_agent_becomes_a_locator_in_the_folder_of_the_scenario(agent, joined):
    data = {"agents": {"ego": {"agent": agent}}}
    _load._join_commands(data, "s.toml", Path("/town"))
    assert data["agents"]["ego"] == joined


def test_digest_of_a_scenario_is_that_of_files_and_settings_but_not_of_agents(town):
    was = scenario_digest(town)
    assert scenario_digest(replace(town, agents={"other": AgentSetup(agent="x", route="way")})) == was
    assert scenario_digest(replace(town, folder=town.folder / ".." / "town")) == was
    assert scenario_digest(replace(town, warmup_s=3.0)) != was
    (town.folder / "r.rou.xml").write_text(ROUTES + "<!-- -->")
    assert scenario_digest(town) != was
    files = {"b": {"blake2b": "2"}, "a": {"blake2b": "1"}}
    same = dict(reversed(files.items()))
    assert digest_of_described(files) == digest_of_described(same)
    assert digest_of_described(files, plain_data={"x": 1, "y": 2}) == digest_of_described(
        same, plain_data={"y": 2, "x": 1}
    )
    assert len({digest_of_described(files, plain_data=data) for data in (None, {}, {"x": 1})}) == 3


def test_plain_data_has_no_place_and_nothing_empty_that_is_new(town):
    found = as_plain_data(replace(town, notes=("a",), added={"later": 1}))
    assert not {"folder", "file", "notes", "added", "events", "disturbances", "tables", "observation"} & found.keys()
    assert found["sumo"]["routes"] == ["r.rou.xml"]
    more = as_plain_data(replace(town, events={"hard_braking": 4.0}, disturbances={"brake": 0.1}))
    assert (more["events"], more["disturbances"]) == ({"hard_braking": 4.0}, {"brake": 0.1})
    json.dumps(found)


def test_arguments_of_a_scenario_know_their_place(town):
    setup = ArgumentSetup(default=3, range="1:9")
    ego = replace(town.agents["ego"], arguments={"speed": setup})
    given = replace(town, arguments={"count": setup, "free": ArgumentSetup(range="1:9")}, agents={"ego": ego})
    assert {name: one.default for name, one in given.scenario_arguments().items()} == {"count": 3, "free": None}
    assert given.agent_arguments("ego")["speed"].default == 3
    assert argument_values(given) == {"count": 3}
    broken = replace(given, arguments={"count": ArgumentSetup(range="9:1")})
    with pytest.raises(Exception, match=re.escape(f"{given.origin}: arguments")):
        broken.scenario_arguments()
    assert with_action(town, "ego", "meta").agents["ego"].action == "meta"
    with pytest.raises(UsageError, match="action: 'odd' is not a form of actions"):
        with_action(town, "ego", "odd")


def test_descriptors_say_what_simulators_do(town):
    assert (GYM.shows_itself, HIGHWAY.shows_itself, SUMO.shows_itself, Backend().shows_itself) == (
        True, True, False, False,
    )  # fmt: skip
    assert (GYM.disturbances, GYM.reported_events, Backend().disturbances) == ((), (), None)
    assert [backend.forkable for backend in (GYM, HIGHWAY, SUMO, Backend())] == [False, True, True, False]
    assert [backend.plays_paths for backend in (GYM, HIGHWAY, SUMO, Backend())] == [False, True, True, False]
    assert [backend.one_per_process for backend in (GYM, HIGHWAY, SUMO)] == [False, False, True]
    assert [backend.per_processor for backend in (GYM, HIGHWAY, SUMO)] == [False, True, False]
    assert backend_of("sumo") is SUMO
    assert CrashRule().termination is False
    setup = GymSetup(id="a:A", crash=CrashRule(function="b:b", kind="c:c"), others="d:d")
    gym = Scenario(simulator="gym", tables={"gym": setup})
    assert set(gym.modules()) == {"a", "b", "c", "d"}
    assert SUMO.survey.refine is not None
    assert SUMO.right_of_way(load_scenario("intersection")).links
    with_core = SUMO.core.switched_off(town)
    assert with_core.table(SumoSetup).native is False
    assert SUMO.core.why_not(with_core) == "the scenario says so"
    kept = SUMO.load_order.keep(town)
    assert kept.table(SumoSetup).fix_link_order is False
    assert SUMO.load_order.why_not(kept) == "the scenario says so"


def test_options_of_reset_are_kept_with_a_scenario_and_are_arguments_of_its_environment():
    plain = Scenario(simulator="gym", tables={"gym": GymSetup(id="a:A")}, agents={"ego": AgentSetup()})
    found = plain.with_table(GymSetup(id="a:A", reset_options={"at": {"x": 1}}))
    assert [GYM.side_effect(one, {}, []) for one in (plain, found)] == ["", "it gives its environment arguments"]
    for one in (plain, found):
        data = as_plain_data(one)
        assert ("reset_options" in data["gym"]) == (one is found)  # an earlier version reads the file of the others
        again = scenario_from_dict(data, where="scenario.toml", folder=Path())
        assert again.table(GymSetup) == one.table(GymSetup)
    data["gym"]["reset_options"] = 3
    with pytest.raises(ScenarioError, match=r"gym\.reset_options = 3: not a table"):
        scenario_from_dict(data, where="scenario.toml", folder=Path())


def test_survey_of_traffic_refines_and_restores_the_scenario_itself(town, monkeypatch):
    monkeypatch.setattr(_ego_choice, "refine", lambda *given: ("refined", *given))
    monkeypatch.setattr(_ego_choice, "restore", lambda *given: ("restored", *given))
    assert SUMO.survey.refine(town, {"runs": []}) == ("refined", town, {"runs": []})
    assert SUMO.survey.restore(town, "kept") == ("restored", town, "kept")


def test_accelerator_of_highway_env_is_switched_off_and_steps_aside(monkeypatch):
    plain = Scenario(simulator="highway", tables={"highway": HighwaySetup(id="merge-v0")})
    assert HIGHWAY.accelerator.switched_off(plain).table(HighwaySetup).accelerate is False
    assert plain.table(HighwaySetup).accelerate is True
    for config, length_s in (({}, 1.0), ({"policy_frequency": 5}, 0.2), ({"policy_frequency": 0}, 1.0)):
        found = plain.with_table(HighwaySetup(id="x", config=config))
        assert HIGHWAY.step_length_s(found) == length_s
    for config, values, says in (
        ({"a": [{"type": "mine.Vehicle"}]}, {}, "its configuration names 'mine.Vehicle'"),
        ({"type": "highway_env.vehicle.behavior.IDMVehicle", "b": "plain", "c": 2.5}, {}, ""),
        ({}, {"who": "mine.Vehicle"}, "its configuration names 'mine.Vehicle'"),
    ):
        found = plain.with_table(HighwaySetup(id="x", config=config))
        assert HIGHWAY.side_effect(found, values, []) == says
    assert HIGHWAY.side_effect(plain, {}, ["a.B|c"]) == "its configuration names 'a.B|c'"


# SUMO's files.


def test_compressed_and_wide_files_are_read_as_sumo_does(tmp_path):
    wide = tmp_path / "wide.xml"
    text = '<?xml version="1.0" encoding="UTF-16"?><a encoding="x" b="ü"><?xml2 encoding="y"?></a>'
    wide.write_bytes(text.encode("utf-16"))
    assert read_xml(wide).decode() == text.replace(' encoding="UTF-16"', "", 1)
    said, advice, where = refusal(read_xml, tmp_path / "no.xml")
    assert (said, advice, where) == (
        "cannot be read: No such file or directory", "correct the file", str(tmp_path / "no.xml"),
    )  # fmt: skip
    (tmp_path / "cut.gz").write_bytes(b"\x1f\x8b\x08")
    assert refusal(read_xml, tmp_path / "cut.gz")[0].startswith("cannot be read: ")


def test_references_are_what_sumo_reads_and_writes():
    text = b"""<a><include href="x.xml"/><include href=""/><inductionLoop file="o.xml"/><inductionLoop file="NUL"/>
    <param key="device.ssm.file" value="s.xml"/><param key="file" value="t.xml"/><param key="other" value="u.xml"/>
    <param key="device.fcd-replay.file" value="v.xml"/><vType key="file" value="w.xml"/>
    <param key="file" value=""/></a>"""
    found = [(one.tag, one.attribute, one.value, one.kind) for one in references(text, "f")]
    assert ("include", "href", "x.xml", "read") in found
    assert ("inductionLoop", "file", "o.xml", "written") in found
    assert [value for *_, value, kind in found if kind == "written"] == ["o.xml", "s.xml", "t.xml"]
    assert [value for *_, value, kind in found if kind == "read"] == ["x.xml"]
    assert refusal(references, b'<include href="x"', "f")[1:] == ("correct the file", "f")


def test_file_in_a_folder_that_moves_names_others_relatively(tmp_path):
    other = tmp_path / "other.xml"
    other.write_text("<routes/>")
    file = tmp_path / "sub/a.xml"
    file.parent.mkdir()
    file.write_text(f'<routes><include href="{other}"/><include href="b.xml"/></routes>')
    assert movable(file) == b'<routes><include href="../other.xml"/><include href="b.xml"/></routes>'
    file.write_text('<routes><include href="b.xml"/></routes>')
    assert movable(file) is None
    file.write_text(f'<additional><inductionLoop file="{other}"/></additional>')
    assert movable(file) is None  # what is written goes nowhere


@pytest.mark.parametrize(("count", "more"), [(0, None), (1, ""), (2, " and 1 more"), (3, " and 2 more")])
def test_discarded_output_is_reported_once(tmp_path, count, more):
    loops = "".join(f'<inductionLoop id="{number}" file="o{number}.xml"/>' for number in range(count))
    (tmp_path / "a.xml").write_text(f"<additional>{loops}</additional>")
    found = written_by(tmp_path, ("a.xml", "a.xml"))
    if more is None:
        assert found == []
    else:
        (said,) = found
        assert said.startswith("a.xml: ")
        assert said.endswith(f"{more} (nothing is written)")
        assert ("more" in said) is bool(more)


def test_staged_files_read_each_other_and_paths_have_no_special_characters(town, tmp_path):
    (town.folder / "b.xml").write_text("<routes/>")
    (town.folder / "r.rou.xml").write_text(f'<routes><include href="{town.folder}/b.xml"/></routes>')
    special = tmp_path / "a,b"
    special.mkdir()
    staged = StagedFiles(town, special)
    words = dict(word.removeprefix("--").split("=", 1) for word in staged.arguments(5, {}))
    assert (words["seed"], words["step-length"]) == ("5", "0.1")
    for name in ("net-file", "route-files"):
        assert re.fullmatch(r"/proc/self/fd/\d+/\S+\.xml", words[name])
        assert Path(words[name]).samefile(special / Path(words[name]).name)
    assert words["net-file"].rpartition("/")[0] == words["route-files"].rpartition("/")[0]
    assert (special / "r.rou.xml").read_text() == f'<routes><include href="{special}/b.xml"/></routes>'
    assert (special / "b.xml").is_symlink()
    plain = tmp_path / "plain"
    plain.mkdir()
    words = dict(word.removeprefix("--").split("=", 1) for word in StagedFiles(town, plain).arguments(5, {}))
    assert words["net-file"] == str(plain / "net.xml")


def test_values_are_filled_into_files(town, tmp_path):
    assert filled_in(b"<a>${x} ${y} ${z}</a>", {"x": 1.5, "y": True, "z": "w"}) == b"<a>1.5 true w</a>"
    assert filled_in(b"<a>$</a>", {}) == b"<a>$</a>"
    (town.folder / "r.rou.xml").write_text('<routes><a v="${count}"/><inductionLoop file="o.xml"/></routes>')
    given = replace(
        town, arguments={"count": ArgumentSetup(default=3), "off": ArgumentSetup(default=1, option="scale")}
    )
    folder = tmp_path / "staged"
    folder.mkdir()
    staged = StagedFiles(given, folder)
    assert (folder / "r.rou.xml").read_text() == ""
    words = staged.arguments(1, {"count": 7, "off": 2.0})
    assert (folder / "r.rou.xml").read_text() == '<routes><a v="7"/><inductionLoop file="/dev/null"/></routes>'
    assert "--scale=2.0" in words


def test_options_of_every_device_are_harmless_and_those_of_windows_are_not():
    assert {"device.rerouting.probability", "device.ssm.explicit", "person-device.rerouting.deterministic"} <= HARMLESS
    assert not any(option.startswith(("game.", "gui-testing")) for option in HARMLESS)
    assert not any(option.endswith((".file", "-output")) for option in HARMLESS)
