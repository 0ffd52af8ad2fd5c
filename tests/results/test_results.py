"""What `crashhunt.load` returns of a hunt and of a suite."""

from __future__ import annotations

import shutil
import sys
import warnings
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from crashhunt.errors import HuntDirectoryError, UntrustedError, UsageError
from crashhunt.ledger import Ledger
from crashhunt.results import FACTS, HuntResults, IncompleteHuntWarning, SuiteResults, load

FROZEN = Path(__file__).parents[1] / "e2e" / "frozen" / "version-1" / "hunt"


@pytest.fixture
def hunt(tmp_path):
    """A hunt of four trials on the toy, of which two crashed."""
    return Path(shutil.copytree(FROZEN, tmp_path / "h"))


def enter(hunt, state, detail=""):
    with closing(Ledger(hunt / "ledger.sqlite", writable=True)) as ledger:
        ledger.enter(state, detail)


def edit(hunt, old, new):
    file = hunt / "hunt.toml"
    text = file.read_text()
    assert text.count(old) == 1
    file.write_text(text.replace(old, new))


def test_one_hunt_is_a_hunt_and_hunts_below_a_folder_are_a_suite(hunt):
    shutil.copytree(hunt, hunt.parent / "town" / "0")
    with warnings.catch_warnings():
        warnings.simplefilter("error", IncompleteHuntWarning)
        one, suite = load(hunt), load(hunt.parent)
    assert type(one) is HuntResults
    assert one.directory == hunt
    assert repr(one) == f"<hunt {str(hunt)!r}: crashed, 4 of 4 trials, 2 crashes>"
    assert type(suite) is SuiteResults
    assert list(suite) == ["h", "town/0"]
    assert suite["town/0"].directory == hunt.parent / "town" / "0"
    assert suite.directory == hunt.parent
    assert repr(suite) == f"<suite {str(hunt.parent)!r}: 2 hunts, 2 crashed>"


def test_an_unfinished_hunt_is_loaded_with_a_warning(hunt):
    shutil.copytree(hunt, hunt.parent / "town" / "0")
    enter(hunt, "interrupted", "at noon")
    with pytest.warns(
        IncompleteHuntWarning, match="interrupted, 4 of 4 trials, 2 crashes> is not finished: at noon"
    ) as one:
        load(hunt)
    with pytest.warns(IncompleteHuntWarning) as both:
        load(hunt.parent)
    assert len(one) == len(both) == 1
    assert one[0].filename == __file__  # the line that called


def test_trials_are_rows_columns_and_results(hunt):
    found = load(hunt)
    arguments = ("ego.speed", "scenario.fail_at_step", "scenario.leader_speed")
    assert found.columns == (*FACTS, *arguments)
    assert [trial.outcome.value for trial in found.results()] == ["collision", "survived"] * 2
    assert [trial.spec.number for trial in found.results(outcomes=["survived"])] == [1, 3]
    rows = list(found.rows(outcomes=["collision"]))
    assert [row["number"] for row in rows] == [0, 2]
    assert tuple(rows[0]) == found.columns
    assert rows[0]["ego.speed"] == pytest.approx(14.451185)
    assert len(list(found.trial_rows())) == 4
    assert found.trial(2).steps == 59
    assert [crash.id for crash in found.crashes] == ["000000-collision", "000002-collision"]
    with pytest.raises(UsageError, match=r"trial 4 has not ended.*4 trials that have ended"):
        found.trial(4)


def test_a_table_has_an_array_of_its_kind_for_each_column(hunt):
    table = load(hunt).trials()
    assert table.shape == (4,)
    assert table["number"].tolist() == [0, 1, 2, 3]
    kinds = {name: table.dtype[name].kind for name in ("number", "seed", "ego.speed", "danger", "outcome", "digest")}
    assert kinds == {"number": "i", "seed": "i", "ego.speed": "f", "danger": "f", "outcome": "U", "digest": "U"}
    assert np.isnan(table["danger"]).all()  # that version did not measure it
    assert table["outcome"].tolist() == ["collision", "survived"] * 2


def test_a_dataframe_has_the_columns_of_the_table_and_needs_pandas(hunt, monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", SimpleNamespace(DataFrame=lambda table: list(table.dtype.names)))
    assert load(hunt).dataframe() == list(load(hunt).columns)
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(UsageError, match="a dataframe needs pandas"):
        load(hunt).dataframe()


def test_a_crash_has_its_recording_as_arrays(hunt):
    found = load(hunt)
    crash = found.crashes[0]
    recording, steps = crash.recording(), crash.result.steps
    assert recording.observations("ego").shape[0] == steps > 0
    assert recording.observations("ego").ndim == 3
    assert recording.actions("ego").shape == (steps, 2)
    assert recording.scene(steps).roster.index["ego"] == 0
    acted = found.agent(0, trust=True).act(recording.observations("ego")[0])
    assert acted[0] == pytest.approx(found.trials()["ego.speed"][0])
    assert found.scenario.title


def test_columns_follow_what_the_hunt_was_asked(hunt):
    plain = load(hunt).columns
    edit(hunt, "schema = 1\n", 'schema = 1\ndisturb = ["brake=0.1"]\nprobe = "4s"\nbranch = true\n')
    added = [name for name in load(hunt).columns if name not in plain]
    assert added[:2] == ["disturbances", "log_likelihood"]
    assert {name.partition("_")[0] for name in added[2:]} >= {"branches"}
    with closing(Ledger(hunt / "ledger.sqlite", writable=True)) as ledger:
        ledger.note(origins=True)
    assert [name for name in load(hunt).columns if name not in (*plain, *added)] == ["parent", "origin"]


def test_trials_that_were_drawn_independently_are_known(hunt):
    assert load(hunt).independent
    assert load(hunt).plain_origin == ""
    with closing(Ledger(hunt / "ledger.sqlite", writable=True)) as ledger:
        ledger.note(plain_origin="random")
    assert load(hunt).plain_origin == "random"
    edit(hunt, 'sampler = "random"', 'sampler = "guided"')
    assert not load(hunt).independent


def test_files_of_two_hunts_are_refused(hunt):
    edit(hunt, "\nseed = 1\n", "\nseed = 2\n")
    with pytest.raises(HuntDirectoryError, match="has seed 2, but the trials have seed 1"):
        _ = load(hunt).settings
    (hunt / "ledger.sqlite").unlink()
    with pytest.warns(IncompleteHuntWarning):
        assert load(hunt).settings.seed == 2


def test_an_agent_is_made_as_in_a_trial_of_trusted_code_only(hunt):
    found = load(hunt)
    with pytest.raises(UntrustedError, match="nothing proves that you began this hunt"):
        found.agent(0)
    assert found.agent(2, trust=True).act(None)[0] == pytest.approx(12.210998)
    assert found.agent(0, "ego", trust=True).act(None)[0] == pytest.approx(14.451185)
    with pytest.raises(UsageError, match="there is no controlled vehicle 'other'"):
        found.agent(0, "other", trust=True)
    with pytest.raises(UsageError, match="trial 9 has not ended"):
        found.agent(9, trust=True)
    shutil.rmtree(hunt / "snapshots")
    with pytest.raises(HuntDirectoryError, match="it has no snapshot"):
        _ = load(hunt).scenario
