"""A module of an agent or an environment that does harm when it is imported: the command reports it unharmed."""

from __future__ import annotations

import re
import subprocess
import sys
from functools import cache
from importlib import metadata
from importlib.util import find_spec

import pytest

CHANGED = ("--code", "current", "--set", "initial_spacing=2")
GYM = """
schema = 1
simulator = "gym"
gym = { id = "harmful:Pole-v1", crash = { termination = true } }
agents.cart.agent = "random"
"""
AGENT = "\nfrom crashhunt.agents import KeepLaneWithSpeed as Agent\n"


def test_an_agent_that_ends_the_process_that_imports_it_is_an_error(toy):
    # Its child holds what it has inherited.
    (toy.folder / "harmful.py").write_text(f"import os, time\nos.fork() or time.sleep(1e9); os._exit(3)\n{AGENT}")
    done = toy.crashhunt("run", "h", "1", "2", "5", "--scenario", "toy", "--agent", "harmful:Agent", expect=2)
    assert "'harmful:Agent' cannot be imported: its process exited with 3 meanwhile" in done.err
    assert len(done.err.splitlines()) == 1
    assert not (toy.folder / "h").exists()


def test_an_environment_that_ends_the_process_that_imports_it_is_an_error(toy):
    (toy.folder / "harmful.py").write_text("import os\nos._exit(0)\n")
    (toy.folder / "gym.toml").write_text(GYM)
    done = toy.crashhunt("run", "h", "1", "2", "5", "--scenario", "gym.toml", expect=2)
    assert "'harmful' cannot be imported: its process exited with 0 meanwhile" in done.err


@pytest.mark.parametrize(
    ("option", "says"),
    [
        (("--oracle", "harmful:It"), "the oracle 'harmful:It' cannot be created"),
        (("--disturb", "harmful:It=0.1"), "the disturbance 'harmful:It' cannot be created"),
        (("--sampler", "harmful:It"), "the sampler 'harmful:It' cannot be imported"),
        (("--executor", "harmful:It"), "the executor 'harmful:It' cannot be imported"),
    ],
)
def test_a_plugin_that_ends_the_process_that_imports_it_is_an_error(toy, option, says):
    (toy.folder / "harmful.py").write_text("import os\nos._exit(0)\n")
    done = toy.crashhunt("run", "h", "1", "2", "5", "--scenario", "toy", *option, expect=2)
    assert f"{says}: its process exited with 0 meanwhile" in done.err
    assert len(done.err.splitlines()) == 1


PLUGINS = """
import sqlite3, sys
from crashhunt.agents import KeepLaneWithSpeed as Agent

with open("imports", "a") as file:
    file.write("once ")
print("imported")
sys.stdout = sqlite3.connect = None

class Oracle:
    name = "near"
    outcomes = {"too_near": "traffic crash"}

    def check(self, scene, agents):
        return []"""


def test_a_foreign_module_is_imported_once_to_describe_it_and_once_for_trials_and_harms_no_command(toy):
    (toy.folder / "plugins.py").write_text(PLUGINS)
    words = ["--scenario", "toy", "--agent", "plugins:Agent", "--arg", "speed=1", "--oracle", "plugins:Oracle"]
    done = toy.crashhunt("run", "h", "1", "2", "5", *words, "--snapshot-limit", "99")
    assert (toy.folder / "imports").read_text().split() == ["once", "once"]
    assert '"too_near"' in (toy.folder / "h" / "hunt.toml").read_text()
    assert "No crash was found." in done.out
    assert "imported" not in done.out + done.err
    assert [*(toy.folder / "h" / "snapshots").glob("*/code/plugins.py")]


# The current folder may be a stranger's. Each name there that Python or a package could import writes down that it ran.


@cache
def names_to_import():
    needed = [re.split(r"[^\w-]", requirement)[0] for requirement in metadata.requires("crashhunt") or ()]
    names = {*sys.stdlib_module_names, *metadata.packages_distributions(), *(name.replace("-", "_") for name in needed)}
    return names - {"crashhunt"}


@pytest.fixture
def strange_folder(shell):
    for name in names_to_import():
        tells = "import pathlib; pathlib.Path(__file__).with_suffix('.ran').touch(); raise SystemExit('ran')"
        (shell.folder / f"{name}.py").write_text(tells)
    return shell.folder


@pytest.mark.parametrize(
    "more",  # a confirmation begins as a replay does
    [(), pytest.param((["agents"], ["replay", "out", *CHANGED], ["report", "out"]), marks=pytest.mark.nightly)],
    ids=["", "more"],
)
def test_no_command_imports_from_the_current_folder_what_the_user_has_not_named(strange_folder, shell, more):
    length = ("2", "100") if more else ("1", "3")
    for words in (["run", "out", "1", *length, "--scenario", "highway", "--seed", "3"], *more):
        shell.process(*words, expect=None)
        assert not list(strange_folder.glob("*.ran")), words
    assert (strange_folder / "out" / "report.html").is_file() == bool(more)


def test_python_m_imports_no_package_from_the_current_folder(strange_folder, shell):
    for name in sys.stdlib_module_names:  # some of which Python itself imports before it runs crashhunt
        (strange_folder / f"{name}.py").unlink(missing_ok=True)
    subprocess.run([sys.executable, "-m", "crashhunt", "oracles"], cwd=strange_folder, capture_output=True, check=True)
    assert not list(strange_folder.glob("*.ran"))


@pytest.mark.nightly
@pytest.mark.skipif(find_spec("ray") is None, reason="needs ray")
def test_workers_of_ray_import_nothing_from_the_current_folder(strange_folder, shell):
    shell.process("run", "out", "1", "2", "20", "--scenario", "highway", "--executor", "ray")
    assert not list(strange_folder.glob("*.ran"))
