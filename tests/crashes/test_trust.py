"""What a stranger's scenario may do without being trusted: simulate, and of that what is known."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from crashhunt.crashes import _bundle_trust as _trust, refuse_side_effects
from crashhunt.crashes._bundle_trust import TrustedOrigin, remove_trusted
from crashhunt.errors import UsageError
from crashhunt.scenario import load_scenario

ROUTES = """<routes>
    <vType id="car" vClass="passenger"/>
    <route id="r" edges="a"/>
    <flow id="f" type="car" route="r" begin="0" end="100" number="${count}"/>
    %s
</routes>"""
SCENARIO = """
title = "A stranger's"
schema = 1
simulator = "sumo"
[sumo]
net = "n.net.xml"
routes = ["t.rou.xml"]
[sumo.options]
%s
[arguments.count]
default = 3
range = "1:9"
%s
[agents.ego]
agent = "keep-lane"
type = "car"
route = "r"
"""


def settings(*oracles, **asked):
    specs = {name: SimpleNamespace(kind=kind, spec=spec) for name, (kind, spec) in asked.items()}
    return SimpleNamespace(oracles=oracles, scenario_arguments=specs)


@pytest.fixture
def sumo(tmp_path):
    def make(routes="", options="", argument=""):
        (tmp_path / "n.net.xml").write_text('<net><edge id="a"><lane id="a_0" index="0"/></edge></net>')
        (tmp_path / "t.rou.xml").write_text(ROUTES % routes)
        (tmp_path / "scenario.toml").write_text(SCENARIO % (options, argument))
        return load_scenario(tmp_path / "scenario.toml", kept=True)

    return make


def plain(tmp_path, text):
    (tmp_path / "scenario.toml").write_text('title = "x"\nschema = 1\n' + text + '[agents.ego]\nagent = "random"\n')
    return load_scenario(tmp_path / "scenario.toml", kept=True)


def test_an_origin_is_removed_by_what_names_it_alone(tmp_path, monkeypatch):
    known = [
        TrustedOrigin(fingerprint=fingerprint, path=path, runs="", trusted_at="")
        for fingerprint, path in (("abcdef1", "/a"), ("abcdef2", "/b"), ("0123456", "/c"))
    ]
    for origin in known:
        (tmp_path / f"{origin.fingerprint}.json").touch()
    monkeypatch.setattr(_trust, "list_trusted", lambda: known)
    monkeypatch.setattr(_trust, "_folders", lambda: [tmp_path])
    with pytest.raises(UsageError, match="--remove 'abcdef' matches 2 origins"):
        remove_trusted(["0123456", "abcdef"])
    with pytest.raises(UsageError, match="--remove '01234': no trusted origin has this name"):
        remove_trusted(["01234"])  # too short
    assert len(list(tmp_path.iterdir())) == 3
    assert remove_trusted(["ABCDEF2", "/c"]) == known[1:]
    assert [path.stem for path in tmp_path.iterdir()] == ["abcdef1"]


def refused(scenario, asked=None, values=None):
    with pytest.raises(UsageError) as caught:
        refuse_side_effects(scenario, asked or settings(), values if values is not None else {"count": 3})
    assert caught.value.message.startswith("the crash was not made on this machine, and ")
    assert "--trust" in caught.value.fix
    return caught.value.message


def test_what_only_simulates_is_let_through(sumo, tmp_path):
    refuse_side_effects(sumo(), settings("overlap", "off-road"), {"count": 3})
    refuse_side_effects(sumo(options="scale = 2.0"), settings(count=("str", "whatever.it.is")), {"count": 3})
    label = '<vType id="v"><param key="who" value="plain"/></vType>'
    refuse_side_effects(sumo(label), settings(), {"count": 3})
    refuse_side_effects(plain(tmp_path, 'simulator = "toy"\n'), settings(), {})


def test_what_would_be_imported_is_refused(sumo, tmp_path):
    assert "the configuration of the scenario imports the module 'evil:Oracle'" in refused(
        sumo(), settings("overlap", "evil:Oracle")
    )
    for table in (
        'simulator = "gym"\n[gym]\nid = "evil:Env-v0"\n',
        'simulator = "highway"\n[highway]\nid = "evil:x-v0"\n',
    ):
        assert "the configuration of the scenario imports the module 'evil'" in refused(
            plain(tmp_path, table), values={}
        )


def test_arguments_of_an_environment_are_refused(tmp_path):
    gym = 'simulator = "gym"\n[gym]\nid = "CartPole-v1"\n'
    refuse_side_effects(plain(tmp_path, gym), settings(), {})
    for text, values in (
        (gym + "[gym.kwargs]\na = 1\n", {}),
        (gym + "[arguments.a]\ndefault = 1\n", {}),
        (gym, {"a": 1}),
    ):
        assert "gives its environment arguments" in refused(plain(tmp_path, text), values=values)


def test_classes_in_a_configuration_are_those_of_highway_env(tmp_path):
    def highway(config=""):
        return plain(tmp_path, f'simulator = "highway"\n[highway]\nid = "merge-v0"\n{config}')

    good = "highway_env.vehicle.behavior.IDMVehicle"
    refuse_side_effects(highway(f'[highway.config]\nother_vehicles_type = "{good}"\n'), settings(), {"x": "plain"})
    refuse_side_effects(highway(), settings(lanes=("int", "2.5"), kind=("str", good)), {"kind": good, "n": 2.5})
    bad = '[highway.config]\nother_vehicles_type = "os.system"\n'
    assert "its configuration names 'os.system'" in refused(highway(bad), values={})
    nested = '[highway.config.observation]\nfeatures = [["a", "os.path"]]\n'
    assert "'os.path'" in refused(highway(nested), values={})
    assert "'my.Car'" in refused(highway(), values={"kind": "my.Car"})
    assert "'my.Car'" in refused(highway(), settings(kind=("str", "my.Car")), values={})


@pytest.mark.parametrize(
    "option",
    ["netstate-dump", "ndump", "tripinfo", "summary", "vehroutes", "C", "l", "log-file", "save-state.prefix",
     "device.ssm.file", "device.toc.file", "fcd-output", "made-up", "remote-port", "configuration-file", "weights",
     "scale=1 --summary"],
)  # fmt: skip
def test_options_that_write_or_that_no_one_knows_are_refused(sumo, option):
    try:
        scenario = sumo(argument=f'option = "{option}"')
    except Exception:  # no scenario may say it at all
        return
    assert f"it sets SUMO's option '{option}'" in refused(scenario)


@pytest.mark.parametrize(
    ("routes", "says"),
    [
        ('<event commandPosix="rm x"/>', "<event>"),
        ('<vType id="v" imgFile="/etc/passwd"/>', "imgFile"),
        ('<vType id="v"><param key="device.ssm.file" value="/home/x"/></vType>', "might name a file"),
        ('<vType id="v"><param key="&#100;evice.ssm.file" value="/home/x"/></vType>', "might name a file"),
        ('<vType id="v"><param key="x" value="C:y"/></vType>', "might name a file"),
        ('<vType id="v"><param key="x" value="a\\b"/></vType>', "might name a file"),
        ("<unclosed>", "cannot be checked|which has an unknown effect"),
        ("${unknown}", "cannot be checked"),
    ],
)
def test_files_with_anything_else_are_refused(sumo, routes, says):
    import re

    try:
        scenario = sumo(routes)
    except Exception as error:
        assert "unknown" in str(error)
        return
    found = refused(scenario)
    assert "t.rou.xml" in found
    assert re.search(says, found), found


def test_a_document_type_is_refused(sumo, tmp_path):
    scenario = sumo()
    (tmp_path / "t.rou.xml").write_text('<!DOCTYPE r SYSTEM "x"><routes/>')
    assert "has a document type" in refused(scenario)
    (tmp_path / "t.rou.xml").write_text("<routes>")
    assert "cannot be checked" in refused(scenario)
