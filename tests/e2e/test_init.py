"""``crashhunt init``: what it refuses, and what it leaves behind."""

from __future__ import annotations

import importlib.util
import re
import signal
import time

import pytest

needs_programs = pytest.mark.skipif(
    importlib.util.find_spec("sumo") is None, reason="needs eclipse-sumo: pip install 'crashhunt[maps]'"
)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--grid", "4"), "--grid '4' is not of the form NxM"),
        (("--osm", "none.osm"), "there is no such map"),
        (("--osm", "empty.osm"), "the file is empty"),
        (("--osm", "faulty.py"), "does not have the ending"),
        (("--grid", "2x2", "--demand", "0:1"), "--demand '0:1' is not a range"),
        (("--grid", "2x2", "--demand", "nan"), "--demand 'nan' is not a range"),
        (("--grid", "2x2", "--agent", "faulty:Nobody"), "Nobody"),
        (("--osm", "none.osm", "--bbox="), "--bbox '' is not four numbers"),
        (("--grid", "2x2", "--agent="), "'' is not a registered name of agents"),
        (
            ("--grid", "2x2", "--agent", "json:loads"),
            "--agent json:loads: the agent needs the argument 's'; give",
        ),
        (("--grid", "2x2", "--agent", "ending:Driver"), "'ending:Driver' cannot be imported: its process exited"),
        ((), "one of the arguments --osm"),
        (("--grid", "2x2", "--spider", "5x2"), "not allowed with"),
    ],
)
def test_wrong_input_is_one_line_and_leaves_nothing(shell, words, message):
    (shell.folder / "empty.osm").touch()
    (shell.folder / "ending.py").write_text("import os\nos._exit(0)\n")
    before = sorted(shell.folder.iterdir())
    done = shell.crashhunt("init", "place", *words, expect=2)
    assert message in done.err
    assert done.err.count("\n") == 1
    assert done.out == ""
    assert [path for path in sorted(shell.folder.iterdir()) if path.name != "__pycache__"] == before


def test_folder_with_files_is_refused_as_json(shell):
    (shell.folder / "place").mkdir()
    (shell.folder / "place" / "mine").touch()
    done = shell.crashhunt("init", "place", "--grid", "2x2", "--json", expect=2)
    assert done.json["error"]["message"] == "exists and is not empty"
    assert [path.name for path in (shell.folder / "place").iterdir()] == ["mine"]


def test_missing_programs_are_named_with_the_command_that_installs_them(shell):
    # An environment without eclipse-sumo: the module is hidden from the process, which is what not installed means.
    (shell.folder / "sitecustomize.py").write_text(
        "import importlib.util as u\nfind = u.find_spec\n"
        "u.find_spec = lambda name, *more: None if name == 'sumo' else find(name, *more)\n"
    )
    shell.environment = {**shell.environment, "PYTHONPATH": str(shell.folder)}
    done = shell.process("init", "place", "--grid", "2x2", expect=2)
    assert re.search(r"eclipse-sumo is not installed; .*pip'? install -e '?/.*\[maps\]'?$", done.err)
    assert not (shell.folder / "place").exists()


@needs_programs
@pytest.mark.nightly
@pytest.mark.parametrize(
    ("shape", "sign"), [("6x6", ".place*"), ("2x2", "tmp/crashhunt-temporary-*/*/try-*/hunt/ledger.sqlite")]
)
def test_init_that_is_interrupted_leaves_no_half_folder(shell, shape, sign):
    """While it makes the network, and while the trial runs."""
    (shell.folder / "tmp").mkdir()
    shell.environment = {**shell.environment, "TMPDIR": str(shell.folder / "tmp")}
    begun = shell.start("init", "place", "--grid", shape)
    deadline = time.monotonic() + 300
    while not [*shell.folder.glob(sign)] and time.monotonic() < deadline and begun.poll() is None:
        time.sleep(0.02)
    assert [*shell.folder.glob(sign)], "it has not begun"
    begun.send_signal(signal.SIGINT)
    _, err = begun.communicate(timeout=300)
    assert begun.returncode == 130, err
    assert err == "crashhunt: interrupted; place was not made\n"
    assert not [path for path in shell.folder.iterdir() if "place" in path.name]
    assert not [*(shell.folder / "tmp").iterdir()]


@needs_programs
@pytest.mark.nightly
def test_made_scenario_is_hunted_with_its_own_commands(shell):
    made = shell.crashhunt("init", "my place", "--grid", "2x2", "--json").json
    assert made["trial"]["outcome"] in ("finished", "survived", "collision")
    assert made["plain"][0]["entered"] > 0
    assert made["next"][0] == "cd 'my place'"
    shell.folder = shell.folder / "my place"
    shell.environment = {**shell.environment, "PYTHONPATH": ""}
    found = shell.process(
        "run", "hunt", "1", "3", "100", "--scenario", ".", "--agent", "agent:Driver", "--seed", "1", "--json"
    ).json
    assert found["trials_run"] == 3 or found["crashes"]
    assert not found["outcomes"].get("invalid")


@needs_programs
@pytest.mark.nightly
def test_map_is_hunted_by_its_name(shell):
    road = '<tag k="highway" v="residential"/>'
    nodes = "".join(f'<node id="{n}" lat="48.{100 + n}" lon="11.5{n % 2}" version="1"/>' for n in range(1, 5))
    refs = "".join(f'<nd ref="{n}"/>' for n in range(1, 5))
    (shell.folder / "town.osm").write_text(
        f'<osm version="0.6">{nodes}<way id="9" version="1">{refs}{road}</way></osm>'
    )
    shell.environment = {**shell.environment, "XDG_CACHE_HOME": str(shell.folder / "cache")}
    words = ("1", "2", "50", "--scenario", "town.osm", "--seed", "1", "--json")
    first = shell.process("run", "one", *words).json
    again = shell.process("run", "two", *words).json
    assert first["outcomes"] == again["outcomes"]
    assert first["trials_run"] == 2
