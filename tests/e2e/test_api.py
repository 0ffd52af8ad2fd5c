"""What the command line does, from Python: also in a script without a guard, and on what is not finished."""

from __future__ import annotations

import shutil
import subprocess
import sys
import warnings
from typing import TYPE_CHECKING

import numpy as np
import pytest
from conftest import keeps_going

import crashhunt
from crashhunt.errors import CrashhuntError, HuntDirectoryError, UsageError
from crashhunt.results import HuntResults, IncompleteHuntWarning, SuiteResults

if TYPE_CHECKING:
    from crashhunt.results import HuntState

SCRIPT = """
import crashhunt
print("top level")
seen = []
report = crashhunt.run("h", 2, 20, 99, scenario="toy", arguments={"speed": "12:14"}, seed=1, watch=seen.append)
print(report.stopped_because, len(seen) > 0, seen[-1].phase)
found = crashhunt.load("h")
print(crashhunt.replay(found.crashes[0]).verdict)
"""


@pytest.mark.nightly  # by day, hunts/test_whole_hunts.py hunts from such a script
def test_a_script_needs_no_guard(toy):
    (toy.folder / "script.py").write_text(SCRIPT)
    done = subprocess.run(
        [sys.executable, "script.py"], cwd=toy.folder, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.stderr == ""
    assert done.stdout.split() == ["top", "level", "crash", "True", "done", "reproduced"]


@pytest.fixture
def hunt(toy, made_once, monkeypatch):
    monkeypatch.chdir(toy.folder)
    return made_once(keeps_going, toy)


@pytest.mark.nightly  # by day, results/test_results.py, and test_check.py replays with changes
def test_results_are_typed_objects_and_arrays(hunt):
    found = crashhunt.load("h")
    assert isinstance(found, HuntResults)
    assert repr(found).startswith("<hunt 'h': crashed, 25 of 25 trials,")
    table = found.trials()
    assert table.shape == (25,)
    assert table["number"].tolist() == list(range(25))
    assert table.dtype["ego.speed"] == np.float64
    crashed = table[table["outcome"] == "collision"]
    assert len(crashed) == len(found.crashes) == found.state.crashes
    frame = found.dataframe()
    assert list(frame.columns) == list(table.dtype.names)
    recording = found.crashes[0].recording()
    steps = found.crashes[0].result.steps
    assert recording.observations("ego").shape == (steps, 8, 7)
    assert recording.actions("ego").shape == (steps, 2)
    assert recording.scene(steps).roster.index["ego"] == 0
    assert found.scenario.title == "A toy"
    number = found.crashes[0].result.spec.number
    agent = found.agent(number)
    agent.reset(0)
    assert agent.act(recording.observations("ego")[0])[0] == pytest.approx(table["ego.speed"][number])
    assert crashhunt.replay("h", changes={"speed": 4}).verdict == "fixed"
    with pytest.raises(UsageError, match="trial 99 has not ended"):
        found.trial(99)
    with pytest.raises(UsageError, match="no controlled vehicle 'x'"):
        found.agent(0, "x")


@pytest.mark.nightly  # by day, test_python_calls.py tests what each function passes on
def test_what_is_not_finished_states_so(hunt):
    (hunt.folder / "s.toml").write_text(
        "[defaults]\nscenario='toy'\ntrials=2\nmax_steps=20\n[[hunts]]\nid='a'\n[[hunts]]\nid='b'\n"
    )
    suite = crashhunt.Suite.read("s.toml")
    assert repr(suite) == "<suite of 2 hunts, 2 runs: a, b>"
    assert suite.plan("s") == suite.plan("s")
    with pytest.warns(IncompleteHuntWarning, match="queued"):
        found = crashhunt.load("s")
    assert isinstance(found, SuiteResults)
    assert sorted(found) == ["a/0", "b/0"]
    assert repr(found) == "<suite 's': 2 hunts, 2 queued>"
    seen: list[list[HuntState]] = []
    done = suite.run("s", 2, watch=seen.append)
    assert {state.state for state in done} <= {"crashed", "finished"}
    assert seen
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(crashhunt.load("s")) == 2
    with pytest.raises(HuntDirectoryError, match="does not exist"):
        crashhunt.load("nowhere")


def test_comparisons_are_printable(hunt):
    shutil.copytree(hunt.folder / "h", hunt.folder / "again")  # the same trials
    found = crashhunt.compare("h", "again")
    assert repr(found).startswith("<comparison h: ")
    assert found.pairs[0].both == found.hunts[0].crashes


def test_mistakes_are_errors_of_ours(hunt):
    class Local:
        pass

    for words, message in (
        ({"agent": Local}, "is not in a module that workers can import"),
        ({"agent": "nothing:There"}, "cannot be imported"),
        ({"arguments": {"sped": 3}}, "did you mean"),
        ({"crash_on": ["boom"]}, "'boom' is not an outcome that can count as a crash"),
    ):
        with pytest.raises(CrashhuntError, match=message):
            crashhunt.run("x", 1, 1, 1, scenario="toy", **words)
    with pytest.raises(AttributeError, match="no attribute 'hunt_for'"):
        _ = crashhunt.hunt_for
