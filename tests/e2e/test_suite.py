"""Suites: many hunts from one file, also when some cannot run, when somebody interrupts, and when it is killed."""

from __future__ import annotations

SUITE = """
[defaults]
scenario = "toy"
trials = 8
max_steps = 100
seed = 3

[[hunts]]
id = "fast"
runs = 2
arguments.speed = "12:14"

[[hunts]]
id = "slow"
arguments = { speed = 4 }
scenario_arguments.gap_m = 50
"""


def written(shell, text: str) -> None:
    (shell.folder / "suite.toml").write_text(text, encoding="utf-8")


def test_snapshots_of_a_suite_take_in_what_is_asked_for(toy):
    (toy.folder / "maps").mkdir()
    (toy.folder / "maps" / "town.csv").write_text("1,2")
    written(toy, "[[hunts]]\nid = 'a'\nscenario = 'toy'\ntrials = 1\nsnapshot_roots = ['maps']\nkeep_trials = true")
    toy.crashhunt("suite", "run", "suite.toml", "out", "1")
    assert [path.name for path in toy.folder.glob("out/a/0/snapshots/*/code/**/town.csv")] == ["town.csv"]
    assert (toy.folder / "out/a/0/trials/000000/params.json").exists() or list(toy.folder.glob("out/a/0/crashes/*"))


def test_a_suite_that_has_changed_is_refused(toy):
    from crashhunt.suites import Suite

    written(toy, SUITE)
    Suite.read(toy.folder / "suite.toml").plan(toy.folder / "out")
    toy.crashhunt("run", "single", "1", "1", "5", "--scenario", "toy", "--no-snapshot")
    written(toy, SUITE.replace("speed = 4", "speed = 5"))
    refused = toy.crashhunt("suite", "run", "suite.toml", "out", expect=2)
    assert "the hunt 'slow' was planned in this folder with other settings" in refused.err
    # What cannot be planned leaves nothing behind.
    written(toy, SUITE.replace("speed = 4", "speed = 5").replace("runs = 2", "runs = 3"))
    toy.crashhunt("suite", "run", "suite.toml", "out", expect=2)
    assert not (toy.folder / "out/fast/2").exists()
    assert "the directory contains a hunt" in toy.crashhunt("suite", "run", "suite.toml", "single", expect=2).err
    written(toy, SUITE.replace("seed = 3", "seed = 3\nsnapshot_roots = ['toy']"))
    assert "other settings" in toy.crashhunt("suite", "run", "suite.toml", "out", expect=2).err
    assert "cannot be read" in toy.crashhunt("suite", "run", "nowhere.toml", "out", expect=2).err


def test_the_default_suite_is_a_suite_of_everything(toy):
    from crashhunt.scenario import shipped_scenarios
    from crashhunt.suites import Suite

    text = toy.crashhunt("suite", "defaults").out
    written(toy, text)
    suite = Suite.read(toy.folder / "suite.toml")
    assert sorted(entry.scenario for entry in suite.entries) == sorted(shipped_scenarios())
    # What is commented out is right as well.
    written(toy, text.replace("# arguments", "arguments").replace("# scenario_arguments", "scenario_arguments"))
    assert all(entry.scenario_arguments for entry in Suite.read(toy.folder / "suite.toml").entries)
