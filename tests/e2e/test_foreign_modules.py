"""A module of an agent or an environment that does harm when it is imported: the command reports it unharmed."""

from __future__ import annotations

import pytest

GYM = """
schema = 1
simulator = "gym"
gym = { id = "harmful:Pole-v1", crash = { termination = true } }
agents.cart.agent = "random"
"""
AGENT = "\nfrom crashhunt.agents import KeepLaneWithSpeed as Agent\n"


@pytest.mark.parametrize(
    ("does", "why"),
    [
        ("os._exit(0)", "exited with 0"),
        ("os.kill(os.getpid(), 11)", "was killed by SIGSEGV"),
        ("os.fork() or time.sleep(1e9); os._exit(3)", "exited with 3"),  # its child holds what it has inherited
    ],
)
def test_an_agent_that_ends_the_process_that_imports_it_is_an_error(toy, does, why):
    (toy.folder / "harmful.py").write_text(f"import os, time\n{does}\n{AGENT}")
    done = toy.crashhunt("run", "h", "1", "2", "5", "--scenario", "toy", "--agent", "harmful:Agent", expect=2)
    assert f"'harmful:Agent' cannot be imported: its process {why} meanwhile" in done.err
    assert len(done.err.splitlines()) == 1
    assert not (toy.folder / "h").exists()


def test_an_environment_that_ends_the_process_that_imports_it_is_an_error(toy):
    (toy.folder / "harmful.py").write_text("import os\nos._exit(0)\n")
    (toy.folder / "gym.toml").write_text(GYM)
    done = toy.crashhunt("run", "h", "1", "2", "5", "--scenario", "gym.toml", expect=2)
    assert "'harmful' cannot be imported: its process exited with 0 meanwhile" in done.err


def test_a_module_of_an_agent_changes_nothing_in_the_process_of_the_command(toy):
    harm = "import sqlite3, sys\nprint('imported')\nsys.stdout = None\nsqlite3.connect = None\n"
    (toy.folder / "harmful.py").write_text(harm + AGENT)
    words = ["--scenario", "toy", "--agent", "harmful:Agent", "--arg", "speed=1", "--snapshot-limit", "99"]
    done = toy.crashhunt("run", "h", "1", "2", "5", *words)
    assert "No crash was found." in done.out
    assert "imported" not in done.out + done.err
    code = [path.name for path in (toy.folder / "h" / "snapshots").glob("*/code/*")]
    assert "harmful.py" in code
