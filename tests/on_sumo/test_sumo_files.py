"""SUMO's inputs as SUMO takes them: what is read is staged, what would be written is not, and what changes is told."""

from __future__ import annotations

import gzip
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, strategies as st

from crashhunt.errors import InvalidEpisodeError, ScenarioError, UsageError
from crashhunt.plans import Request, plan, with_settings
from crashhunt.scenario import as_plain_data, load_scenario, shipped_folder
from crashhunt.sumo._files import StagedFiles, references, rewritten
from crashhunt.sumo._options import canonical, is_true
from crashhunt.sumo._scenario_check import check_options
from crashhunt.sumo._side_effects import side_effect

ROUTES = (
    '<routes><route id="way" edges="south east north west"/>{}'
    '<flow id="f" route="way" begin="0" end="600" period="3" departSpeed="max"/></routes>'
)
NET = '<net-file value="net.net.xml"/>'


@pytest.fixture
def town(tmp_path):
    folder = tmp_path / "my, own ${town} ü"  # SUMO ends a name at a comma, and fills in ${…}
    folder.mkdir()
    shutil.copy(shipped_folder() / "loop" / "loop.net.xml", folder / "net.net.xml")
    (folder / "r.rou.xml").write_text(ROUTES.format(""))
    return folder


def config(folder: Path, text: str, routes: str = "r.rou.xml") -> Path:
    path = folder / "town.sumocfg"
    path.write_text(f'<configuration>{NET}<route-files value="{routes}"/>{text}</configuration>', encoding="utf-8")
    return path


def write_scenario(folder: Path, more: str = "") -> None:
    """Write a scenario of the town's network and routes."""
    text = 'schema = 1\n[sumo]\nnet = "net.net.xml"\nroutes = ["r.rou.xml"]\n[agents.ego]\nroute = "way"\n'
    (folder / "scenario.toml").write_text(text + more)


def staged(scenario, folder: Path, **values) -> dict[str, str]:
    folder.mkdir(exist_ok=True)
    words = StagedFiles(scenario, folder).arguments(1, {"scale": 1.0, **values})
    return dict(word.removeprefix("--").split("=", 1) for word in words)


def test_a_hunt_with_everything_that_people_have(town, shell, monkeypatch):
    """Compressed, included, nested, named by the environment, and with outputs wherever somebody wanted them."""
    (town / "in puts").mkdir()
    victim = town / "mine.xml"
    victim.write_text("what I have written")
    # SUMO goes on reading this one while it simulates.
    late = "".join(f'<vehicle id="late{time}" route="way" depart="{time}"/>' for time in range(700, 4000, 3))
    (town / "more.rou.xml").write_text(
        f'<routes><flow id="g" route="way" begin="1" end="600" period="3"/>{late}</routes>'
    )
    packed = ROUTES.format(f'<include href="{town}/more.rou.xml"/>')
    # As it happens, ${ is in it.
    (town / "in puts" / "r.rou.xml.gz").write_bytes(gzip.compress(f"{packed}<!-- ${{NOT_OURS}} -->".encode()))
    (town / "in puts" / "speeds.xml").write_text('<vss><step time="0" speed="9"/></vss>')
    (town / "in puts" / "a.add.xml").write_text(
        '<additional><variableSpeedSign id="v" lanes="south_0" file="speeds.xml"/>'
        '<inductionLoop id="d" lane="south_0" pos="50" period="10" file="out/e1.xml"/>'
        f'<inductionLoop id="e" lane="south_0" pos="50" period="10" file="{victim}"/>'
        f'<vType id="t"><param key="device.ssm.file" value="{victim}"/></vType></additional>'
    )
    config(
        town,
        '<a v="${INPUTS}/a.add.xml"/><tripinfo v="trips.xml"/><step-length value="0.2"/><threads value="2"/>'
        '<device.ssm.probability value="1"/>',
        routes="${INPUTS}/r.rou.xml.gz",
    )
    shell.environment["INPUTS"] = "in puts"
    before = {path: path.read_bytes() for path in town.rglob("*.xml")}
    words = (
        "run",
        str(town / "h"),
        "1",
        "2",
        "40",
        "--keep-going",
        "--scenario",
        str(town / "town.sumocfg"),
        "--ego",
        "g.0",
    )
    done = shell.crashhunt(*words, "--arg", "speed=20", "--set", "scale=2", "--json", "--timeout", "120")
    outcomes = done.json["outcomes"]
    assert outcomes.get("invalid", 0) == 0
    assert "which files are open" not in done.err  # so that the same worker goes on
    for part in ("${INPUTS}, which is 'in puts'", "threads 2 (it is 1", "tripinfo-output", "out/e1.xml", "nothing is"):
        assert part in done.err
    assert {path: path.read_bytes() for path in before} == before
    assert not list(shell.folder.glob("*ssm*"))
    assert not list(town.rglob("e1.xml"))
    # What the crash needs is in its snapshot, and nothing there leads back.
    (snapshot,) = (town / "h" / "snapshots").glob("[!.]*")
    names = {path.name for path in (snapshot / "scenario").rglob("*.*")}
    assert names >= {"net.net.xml", "r.rou.xml.gz", "more.rou.xml", "speeds.xml", "a.add.xml", "scenario.toml"}
    moved = shutil.copytree(snapshot / "scenario", shell.folder / "moved")
    shutil.rmtree(town)
    options = staged(load_scenario(moved), shell.folder / "stage")
    text = Path(options["route-files"]).read_text()
    assert 'href="../more.rou.xml"' in text
    assert "${NOT_OURS}" in text


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ('<include href="gone.xml"/>', ['<include href="gone.xml">', "there is no file"]),
        ('<variableSpeedSign id="v" lanes="south_0" file="gone.xml"/>', ["gone.xml", "there is no file"]),
        ('<include href="${which}.xml"/>', ["an argument of the scenario cannot choose the file"]),
        ('<include href="more.xml"/', ["not valid XML"]),
    ],
)
def test_what_is_not_there_is_named_before_anything_runs(town, content, says):
    (town / "r.rou.xml").write_text(ROUTES.format(content))
    with pytest.raises(ScenarioError) as caught:
        load_scenario(config(town, ""))
    for part in (*says, "r.rou.xml"):
        assert part in str(caught.value)


def test_a_scenario_reads_nothing_outside_its_folder(town):
    (town.parent / "other.xml").write_text("<routes/>")
    (town / "r.rou.xml").write_text(ROUTES.format('<include href="../other.xml"/>'))
    assert load_scenario(config(town, "")).folder == town.parent  # a configuration may lie anywhere
    write_scenario(town)
    with pytest.raises(ScenarioError, match="outside the scenario's folder"):
        load_scenario(town)


def test_files_that_include_each_other_end(town):
    (town / "r.rou.xml").write_text(ROUTES.format('<include href="other.xml"/>'))
    (town / "other.xml").write_text('<routes><include href="r.rou.xml"/></routes>')
    assert sorted(load_scenario(config(town, "")).files()) == ["net.net.xml", "other.xml", "r.rou.xml"]


@pytest.mark.parametrize(
    ("text", "kept", "says"),
    [
        ("", {"time-to-teleport": "300"}, ""),
        ('<time-to-teleport value="-1"/>', {"time-to-teleport": "-1"}, ""),
        ('<e v="90"/>', {"end": "90"}, "end 90"),
        ('<collision.action value="remove"/>', {"collision.action": "warn"}, "collision.action remove"),
        ('<collision.action value="warn"/>', {"collision.action": "warn"}, ""),
        ('<collision.mingap-factor value="0.0"/>', {"collision.mingap-factor": "0"}, ""),
        ('<collision.check-junctions value="yes"/>', {"collision.check-junctions": "true"}, ""),
        ('<routing-threads value="4"/>', {"device.rerouting.threads": "0"}, "device.rerouting.threads 4"),
        ('<abs-rand value="t"/>', {"random": "false"}, "random t"),
        ('<srand value="7"/>', {"seed": "1"}, "seed 7"),
        ('<output><step-method.ballistic value="true"/></output>', {"step-method.ballistic": "true"}, ""),
        ('<s value="0"/><no-internal-links>1</no-internal-links>', {"route-steps": "0", "no-internal-links": "1"}, ""),
        ('<load-state value="s.xml"/>', {}, "load-state s.xml"),
        ('<l value="log.txt"/><ndump value="n.xml"/>', {}, "log, netstate-dump"),
        ('<gui_only><delay value="9"/></gui_only><remote-port value="99"/><verbose value="1"/>', {}, ""),
        ('<thread-rngs value="8"/>', {"thread-rngs": "8"}, ""),
        ('<phemlight-path value="/usr/share/p"/>', {"phemlight-path": "/usr/share/p/"}, "not archived"),
    ],
)
def test_what_an_actor_wrote_is_kept_or_reported(town, tmp_path, text, kept, says):
    scenario = load_scenario(config(town, text))
    options = staged(scenario, tmp_path / "stage")
    assert {name: options[name] for name in kept} == kept
    assert not {"log", "netstate-dump", "load-state", "delay", "remote-port", "verbose"} & options.keys()
    (_, *told) = scenario.notes
    assert says in "".join(told)
    assert bool(told) is bool(says)


def test_a_jam_of_a_scenario_stays_one_unless_it_states_otherwise(town, tmp_path):
    write_scenario(town)
    assert staged(load_scenario(town), tmp_path / "a")["time-to-teleport"] == "-1"
    assert "literal" not in as_plain_data(load_scenario("loop"))["sumo"]  # so that hunts of before can go on
    with (town / "scenario.toml").open("a") as file:
        file.write("[sumo.options]\ntime-to-teleport = 60\n")
    assert staged(load_scenario(town), tmp_path / "b")["time-to-teleport"] == "60"


def test_a_value_is_never_taken_for_the_next_option(town, tmp_path):
    options = staged(load_scenario(config(town, '<no-internal-links v="--summary=x"/>')), tmp_path)
    assert options["no-internal-links"] == "--summary=x"


@pytest.mark.parametrize("value", ['"yes"', "true", "1", '"T"', '"x"', '"ON"', '" true"'])
def test_queues_are_refused(town, value):
    write_scenario(town, f"[sumo.options]\nmesosim = {value}\n")
    with pytest.raises(ScenarioError, match="none can be driven"):
        load_scenario(town)
    with pytest.raises(ScenarioError, match="none can be driven"):
        load_scenario(config(town, f"<mesosim v={value if value[0] == chr(34) else chr(34) + value + chr(34)}/>"))


@pytest.mark.parametrize("value", ["false", "0", "no", "off", "-"])
def test_vehicles_are_not(town, value):
    assert load_scenario(config(town, f'<mesoscopic><mesosim value="{value}"/></mesoscopic>'))


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[arguments.meso]\ndefault = false\noption = 'mesosim'", "none can be driven"),
        ("[arguments.jobs]\ndefault = 1\noption = 'routing-threads'", "sets itself"),
        ("[sumo.options]\nsrand = 3", "sets itself"),
        ("[sumo.options]\nn = 'other.net.xml'", "sets itself"),
        ("[sumo.options]\nb = 3\nbegin = 4", "give it once"),
        ("[sumo.options]\nc = 'other.sumocfg'", "more than a trial may take over"),
        ("[sumo.options]\nweights = 'gone.xml'", "'gone.xml' does not exist"),
        ("[sumo.options]\nweights = '/dev/null'", "is not"),
    ],
)
def test_options_under_any_name(town, text, says):
    write_scenario(town, f"{text}\n")
    with pytest.raises(ScenarioError) as caught:
        load_scenario(town)
    assert says in str(caught.value) or "does not exist" in str(caught.value)


@pytest.mark.parametrize(
    ("options", "found"),
    [
        ("begin = 5", ""), ("scale = 1.5", ""),
        ("tripinfo-output = 'out.xml'", "it sets SUMO's option 'tripinfo-output'"),
        ("remote-port = 8813", "it sets SUMO's option 'remote-port'"),
    ],
)  # fmt: skip
def test_an_option_with_a_side_effect_is_named_and_a_harmless_one_is_not(town, options, found):
    write_scenario(town, f"[sumo.options]\n{options}\n")
    assert side_effect(load_scenario(town), {"scale": 1.0}, ()) == found


def test_an_option_that_every_trial_has_is_refused_with_the_fix_and_an_output_is_disabled(town):
    write_scenario(town, "[sumo.options]\nseed = 3\n")
    with pytest.raises(ScenarioError, match=r"'seed'.*is an option that crashhunt sets itself") as caught:
        load_scenario(town)
    assert caught.value.fix == "remove it"
    check_options({"device.ssm.file": "ssm.xml", "device.toc.file": "toc.xml"}, "here")


def test_weights_are_read_from_the_stage(town, tmp_path):
    (town / "w.xml").write_text('<meandata><interval begin="0" end="9"><edge id="south"/></interval></meandata>')
    scenario = load_scenario(config(town, '<w v="w.xml"/>'))
    assert "w.xml" in list(scenario.files())
    assert staged(scenario, tmp_path / "stage")["weight-files"] == str(tmp_path / "stage" / "w.xml")


def test_what_is_filled_in_is_so_in_compressed_files_too(town, tmp_path):
    shutil.copytree(shipped_folder() / "loop", town / "own")
    routes = town / "own" / "traffic.rou.xml"
    (town / "own" / "traffic.rou.xml").write_bytes(gzip.compress(routes.read_bytes()))
    scenario = load_scenario(town / "own")
    values = {name: argument.default for name, argument in scenario.arguments.items()}
    options = staged(scenario, tmp_path / "stage", **values)
    assert "${" not in Path(options["route-files"]).read_text()
    (tmp_path / "again").mkdir()
    with pytest.raises(InvalidEpisodeError, match="imperfection"):
        StagedFiles(scenario, tmp_path / "again").arguments(1, {})


def test_what_a_scenario_would_have_written_is_reported_and_no_more_than_xml_is_asked(town, tmp_path):
    # What an argument stands for may be several attributes.
    (town / "a.add.xml").write_text('<additional><e1Detector file="x.xml" ${more} pos="3" period="9"/></additional>')
    (town / "scenario.toml").write_text(
        'schema = 1\n[sumo]\nnet = "net.net.xml"\nroutes = ["r.rou.xml"]\nadditional = ["a.add.xml"]\n'
        '[sumo.options]\ntripinfo = "t.xml"\n[arguments.more]\ndefault = "x"\n[agents.ego]\nroute = "way"\n'
    )
    scenario = load_scenario(town)
    assert "tripinfo-output (nothing is written)" in scenario.notes[0]
    options = staged(scenario, tmp_path / "stage", more="id='d' lane='south_0'")
    assert "tripinfo-output" not in options
    assert 'file="/dev/null" id=' in Path(options["additional-files"]).read_text()
    with pytest.raises(InvalidEpisodeError, match="not valid XML"):
        staged(scenario, tmp_path / "stage", more="<")


def test_a_traffic_light_of_the_network_writes_nothing_either(town, tmp_path):
    net = (town / "net.net.xml").read_text()
    light = '<tlLogic id="x" type="actuated" programID="0" offset="0"><param key="file" value="/tmp/log"/></tlLogic>'
    (town / "net.net.xml").write_text(net.replace("</net>", f"{light}</net>"))
    options = staged(load_scenario(config(town, "")), tmp_path / "stage")
    assert 'value="/dev/null"' in Path(options["net-file"]).read_text()


def test_the_form_of_action_of_a_bare_configuration(town):
    path = config(town, "")
    asked = Request(trials=1, max_steps=1, scenario=path, action="meta", arguments={"speed": "9"})
    scenario, settings = plan(asked)
    assert [setup.action for setup in scenario.agents.values()] == ["meta"]
    assert [setup.action for setup in with_settings(load_scenario(path), settings).agents.values()] == ["meta"]
    _, other = plan(replace(asked, action="", seed=settings.seed))
    assert other.differences(settings) == ["agents.ego.action was None and is now meta"]
    with pytest.raises(UsageError, match="give one of speed_and_lane"):
        plan(replace(asked, action="telepathic"))
    with pytest.raises(UsageError, match="is for SUMO"):
        plan(Request(trials=1, max_steps=1, scenario="merge-highway-env", action="meta"))


quoted = st.text(st.characters(codec="utf-8", exclude_categories=("Cc", "Cs"), exclude_characters="<&\"'"), max_size=9)
# What SUMO takes for no file is left as it is.
names = quoted.filter(
    lambda name: name.strip() and name not in ("NUL", "nul", "/dev/null", "stdout", "STDOUT", "-", "stderr", "STDERR")
)


@given(before=quoted, value=names, quote=st.sampled_from("\"'"), encoding=st.sampled_from(["utf-8"]))
def test_only_the_names_of_files_change(before, value, quote, encoding):
    other = '"' if quote == "'" else "'"
    text = f"<a>{before}<e1 id={quote} file={other}x{other}{before}{quote}\n file = {quote}{value}{quote} z='>'/>ü</a>"
    content = text.encode(encoding)
    found = [reference for reference in references(content, "here") if reference.value == value]
    changed = rewritten(content, found, lambda _: "/ö")
    assert changed.decode() == text.replace(f" = {quote}{value}{quote}", ' = "/&#246;"')


def test_the_names_of_options():
    assert [canonical(name) for name in ("n", "summary", "l", "device.ssm.knownveh", "made-up")] == [
        "net-file",
        "summary-output",
        "log",
        "device.ssm.explicit",
        "made-up",
    ]
    assert is_true(True)
    assert not is_true("maybe")
