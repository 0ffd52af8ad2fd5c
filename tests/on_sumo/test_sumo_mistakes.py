"""Mistakes in a scenario of SUMO: refused before the hunt where its files tell, else SUMO's words with file and key."""

from __future__ import annotations

import gzip
import re
import shutil
from contextlib import nullcontext

import pytest

from crashhunt.errors import ScenarioError
from crashhunt.scenario import load_scenario, shipped_folder
from crashhunt.sumo._scenario_check import explained

ROUTES = """<routes>
  <vType id="car"/><vType id="ego"/>
  <route id="way" edges="south east"/>
  <flow id="left" type="car" route="way" begin="0" end="60" number="3"/>
  <vehicle id="van &amp; co" type="car" route="way" depart="7.5"/>
  <vehicle type="car"
           id='odd.one' route="way" depart="8"/>
  <person id="0" depart="0"><personTrip from="south" to="east" modes="car"/></person>
  {more}
</routes>"""


@pytest.fixture
def town(tmp_path):
    shutil.copy(shipped_folder() / "loop" / "loop.net.xml", tmp_path / "net.net.xml")
    (tmp_path / "town.sumocfg").write_text(
        '<configuration><net-file value="net.net.xml"/><route-files value="r.rou.xml"/></configuration>'
    )
    (tmp_path / "r.rou.xml").write_text(ROUTES.format(more=""))
    return tmp_path


@pytest.mark.parametrize(
    ("ego", "says"),
    [
        (
            "nobody",
            "--ego 'nobody': the files of the scenario have no vehicle 'nobody'; there are left.0, van & co, odd.one",
        ),
        ("od.one", "did you mean 'odd.one'?"),
        ("left", "'left' is a flow, not a vehicle; name one of its vehicles: left.0, left.1"),
        ("ego", "the files of the scenario have no vehicle 'ego'"),  # which is a type
        ("lft.2", "did you mean 'left.0'?"),
        ("route=wya", "--ego 'route=wya': the files of the scenario have no route 'wya'; did you mean 'way'?"),
        ("edges=south,eest", "the files of the scenario have no edge 'eest'"),
    ],
)
def test_who_is_not_there_is_refused_at_once(town, ego, says):
    with pytest.raises(ScenarioError) as caught:
        load_scenario(town / "town.sumocfg", ego=ego)
    assert says in str(caught.value)
    assert caught.value.where == str(town / "town.sumocfg")


@pytest.mark.parametrize("ego", ["left.2", "van & co", "odd.one", "0_0", "route=way", "edges=south,east"])
def test_who_may_be_there_is_not(town, ego):
    load_scenario(town / "town.sumocfg", ego=ego)


@pytest.mark.parametrize(
    "more",
    [
        '<vehicle id="${name}" route="way" depart="9"/>',
        '<trip id="&#110;o" depart="9"/>',
    ],
)
def test_where_the_files_do_not_tell_nothing_is_refused(town, more):
    (town / "r.rou.xml").write_text(ROUTES.format(more=more))
    path = town / "town.sumocfg"
    path.write_text(path.read_text().replace("r.rou.xml", "r.rou.xml.gz"))
    (town / "r.rou.xml.gz").write_bytes(gzip.compress((town / "r.rou.xml").read_bytes()))
    try:
        load_scenario(path, ego="nobody")
    except ScenarioError as error:  # for another reason
        assert "no vehicle" not in str(error)


@pytest.mark.parametrize(
    ("line", "wrong", "says"),
    [
        (
            'type = "ego"',
            'type = "egoo"',
            "agents.ego.type: the files of the scenario have no type 'egoo'; did you mean 'ego'?",
        ),
        (
            'route = "counterclockwise"',
            'route = "clockwize"',
            "agents.ego.route: the files of the scenario have no route 'clockwize'",
        ),
        (
            'route = "counterclockwise"',
            'edges = ["south", "eats"]',
            "agents.ego.edges: the files of the scenario have no edge 'eats'",
        ),
        (
            'route = "counterclockwise"',
            "existing = true",
            "agents.ego: the files of the scenario have no vehicle 'ego'",
        ),
    ],
)
def test_names_in_a_scenario_are_looked_up(tmp_path, line, wrong, says):
    shutil.copytree(shipped_folder() / "loop", tmp_path / "own")
    file = tmp_path / "own" / "scenario.toml"
    file.write_text(file.read_text().replace(line, wrong))
    with pytest.raises(ScenarioError) as caught:
        load_scenario(file)
    assert says in str(caught.value)
    load_scenario(file, kept=True)  # a snapshot's has been run


@pytest.mark.parametrize(("route", "is_known"), [("!left.1", True), ("left.1!", False)])
def test_route_with_the_name_that_sumo_gives_it_is_not_looked_up(tmp_path, route, is_known):
    shutil.copytree(shipped_folder() / "loop", tmp_path / "own")
    file = tmp_path / "own" / "scenario.toml"
    file.write_text(file.read_text().replace('route = "counterclockwise"', f'route = "{route}"'))
    with nullcontext() if is_known else pytest.raises(ScenarioError, match=f"no route '{route}'"):
        load_scenario(file)


def test_the_default_of_the_vehicle_that_is_replaced_is_looked_up(town):
    (town / "scenario.toml").write_text(
        'schema = 1\n[sumo]\nnet = "net.net.xml"\nroutes = ["r.rou.xml"]\n[arguments.who]\ndefault = "left.1"\n'
        '[agents.ego]\nreplaces = "who"\n'
    )
    load_scenario(town)
    file = town / "scenario.toml"
    file.write_text(file.read_text().replace("left.1", "lft.1"))
    with pytest.raises(
        ScenarioError, match=r"arguments.who.default: the files of the scenario have no vehicle 'lft.1'"
    ):
        load_scenario(town)


@pytest.fixture
def own(tmp_path):
    """A scenario whose mistakes only SUMO finds."""
    shutil.copytree(shipped_folder() / "loop", tmp_path / "own")
    file = tmp_path / "own" / "scenario.toml"
    text = file.read_text().replace("depart_lane = ", 'depart_speed = "fast"\ndepart_lane = ')
    text = text.replace("[sumo]", '[sumo]\noptions = { lateral-resolutoin = 0.8, max-depart-delay = "wide" }')
    file.write_text(text.replace('help = "in each direction"', 'option = "scael"'))
    return load_scenario(file)


STAGED = "/some/where/.scratch/stage-17"


@pytest.mark.parametrize(
    ("message", "output", "where", "says"),
    [
        (
            "Could not parse commandline options.",
            "Warning: x\nError: On processing option '--lateral-resolutoin':\n No option 'x'.\nError: y\n",
            "scenario.toml",
            "sumo.options.lateral-resolutoin: SUMO says: On processing option '--lateral-resolutoin': No",
        ),
        (
            "Could not parse commandline options.",
            "Error: On processing option '--scael':\n No option with the name 'scael' exists.\n",
            "scenario.toml",
            "arguments.vehicles.option: SUMO says",
        ),
        ("Invalid Number Format (double) wide", "", "scenario.toml", "sumo.options.max-depart-delay = 'wide': SUMO"),
        (
            "Invalid departSpeed definition 'fast' for vehicle 'ego'; must be one of …",
            "",
            "scenario.toml",
            "agents.ego.depart_speed = 'fast': SUMO says: Invalid departSpeed",
        ),
        (
            f"expected end of tag 'routs' In file '{STAGED}/traffic.rou.xml' At line/column 14/3.",
            "",
            "traffic.rou.xml, line 14",
            "SUMO says: expected end of tag 'routs'; correct it there",
        ),
        (
            "Process Error",
            f"Error: expected end of tag 'nt'\n In file '{STAGED}/loop.net.xml'\n At line/column 133/3.\n",
            "loop.net.xml, line 133",
            "SUMO says: expected end of tag 'nt'",
        ),
        (
            "'number' is needed in flow 'left'.",
            "",
            "traffic.rou.xml, line 11",
            "is needed in flow 'left'; correct it there",
        ),
        (
            "TraCIException",  # which has no text of its own
            "Error: Attribute 'number' in definition of flow 'left' Invalid Number Format (int range) 9e99.\n",
            "traffic.rou.xml, line 11",
            "SUMO says: Attribute 'number' in definition of flow 'left' Invalid Number Format (int range) 9e99",
        ),
        ("something new", "", "scenario.toml", "SUMO says: something new; see [sumo]"),
    ],
)
def test_sumos_words_get_file_key_and_fix(own, message, output, where, says):
    error = explained(f"SUMO could not set up the episode: {message}", output, own)
    assert error is not None
    assert error.where == str(own.folder / where)
    assert says in str(error)
    assert error.fix
    assert "stage-" not in str(error)


LATER = """<routes><vType id="late"/><route id="last" edges="x"/>
<vehicle id="v" route="last"/><vehicle id="w" route="last"/><vehicle id="w" route="last"/></routes>"""
USERS = """<additional><include href="inner/deep.add.xml.gz"/>
<calibrator id="c" edge="e"><flow type="late" begin="0"/></calibrator>
<flow id="f" type="nowhere"/><flow id="g" type="late"/>
<rerouter id="r" edges="e"/><vTypeDistribution id="d" vTypes="late"/>
<inductionLoop id="1" lane="gone_0"/><laneAreaDetector id="2" lane="gone_0"/><e3Detector id="3"><detEntry lane="gone_0"/></e3Detector>
<busStop id="b" lane="gone_0"/><variableSpeedSign id="s" lanes="gone_0"/>
<WAUT id="x"/><wautJunction wautID="y" junctionID="gone"/></additional>"""  # noqa: E501


@pytest.fixture
def several(tmp_path):
    """A scenario whose additional file uses things that are defined later, or nowhere."""
    shutil.copytree(shipped_folder() / "loop", tmp_path / "own")
    folder = tmp_path / "own"
    (folder / "late.rou.xml").write_text(LATER)
    (folder / "a.add.xml").write_text(USERS)
    (folder / "inner").mkdir()
    with gzip.open(folder / "inner" / "deep.add.xml.gz", "wb") as file:
        file.write(b'<additional>\n\n<parkingArea id="p" lane="gone_0"/></additional>')
    text = (folder / "scenario.toml").read_text()
    found = re.search(r'routes = \["(.*?)"\]', text)
    files = f'routes = ["{found[1]}", "late.rou.xml"]\nadditional = ["a.add.xml"]'
    (folder / "scenario.toml").write_text(text.replace(found[0], files))
    return load_scenario(folder / "scenario.toml")


@pytest.mark.parametrize(
    ("says", "where"),
    [
        ("Unknown vehicle type 'late' in calibrator 'c'.", "a.add.xml, line 2"),
        ("The vehicle type 'nowhere' for flow 'f' is not known.", "a.add.xml, line 3"),
        ("The vehicle type 'late' for flow 'g' is not known.", "a.add.xml, line 3"),
        ("rerouter 'r': Alternative route 'last' does not exist.", "a.add.xml, line 4"),
        ("The edge 'gone' to use within rerouter 'r' is not known.", "a.add.xml, line 4"),
        ("Unknown vtype 'late' in distribution 'd'.", "a.add.xml, line 4"),
        ("The lane with the id 'gone_0' is not known (while building e1Detector '1').", "a.add.xml, line 5"),
        ("The lane with the id 'gone_0' is not known (while building e2Detector '2').", "a.add.xml, line 5"),
        ("The lane with the id 'gone_0' is not known (while building e3Detector '3').", "a.add.xml, line 5"),
        ("The lane gone_0 to use within the busStop 'b' is not known.", "a.add.xml, line 6"),
        ("The lane gone_0 to use within the parkingArea 'p' is not known.", "inner/deep.add.xml.gz, line 3"),
        ("The lane 'gone_0' to use within MSLaneSpeedTrigger 's' is not known.", "a.add.xml, line 6"),
        ("TLS 'gone' to switch in WAUT 'x' was not yet defined.", "a.add.xml, line 7"),
        ("Waut 'y' was not yet defined.", "a.add.xml, line 7"),
        ("stop for vehicle 'v' on lane 'south_0' is not downstream the current route.", "late.rou.xml, line 2"),
        ("Another vehicle with the id 'w' exists.", "scenario.toml"),  # either of two
        ("The vehicle type 'late' for vehicle 'nobody' is not known.", "scenario.toml"),
        ("The route 'no such' for vehicle 'w' is not known.", "scenario.toml"),
    ],
)
def test_place_is_of_the_element_that_uses_what_is_unknown(several, says, where):
    error = explained(f"SUMO could not set up the episode: {says}", "", several)
    assert error.where == str(several.folder / where)
    is_later = "'late'" in says or "'last'" in says
    assert ("late.rou.xml, which SUMO reads later; list that file first in additional-files" in error.fix) == is_later


def test_a_process_that_died_at_set_up_states_what_it_said(own):
    error = explained("the process died of SIGSEGV", "Error: Attribute 'shape' is missing of lane 'south_0'.\n", own)
    assert str(own.folder / "loop.net.xml, line ") in error.where
    assert "the process died of SIGSEGV" in error.message
    assert explained("the vehicle 'ego' was not on the road", "", own) is None


def test_a_hunt_reports_it(shell):
    shutil.copytree(shipped_folder() / "loop", shell.folder / "own")
    file = shell.folder / "own" / "traffic.rou.xml"
    file.write_text(file.read_text().replace('<vType id="ego"', '<vType id="ego" carFollowModel="nope"'))
    told = shell.crashhunt("run", "h", "1", "1", "5", "--scenario", "own", expect=3).out
    assert f"{file}, line 8: SUMO says: Unknown car following model 'nope'" in told
    assert str(file) in shell.crashhunt("logs", "h").out


def test_included_files_are_looked_into(town):
    (town / "r.rou.xml").write_text(ROUTES.format(more='<include href="more.rou.xml"/>'))
    (town / "more.rou.xml").write_text('<routes><trip id="late" from="south" to="east" depart="9"/></routes>')
    load_scenario(town / "town.sumocfg", ego="late")
    with pytest.raises(ScenarioError, match="did you mean 'late'"):
        load_scenario(town / "town.sumocfg", ego="lte")
