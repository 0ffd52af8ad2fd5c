"""What `crashhunt rerun` says at its end, and after Ctrl-C."""

from __future__ import annotations

import json

import pytest

import crashhunt.suites
from crashhunt.cli import _suite
from crashhunt.cli._common import CommandOptions
from crashhunt.results import HuntState


@pytest.fixture
def rerun(tmp_path, monkeypatch):
    """Runs the command, in which a function replaces the work."""

    def run(work, *, as_json=False):
        monkeypatch.setattr(crashhunt.suites, "rerun", work)
        monkeypatch.setattr(_suite, "chosen_runs", lambda directory, runs: [directory])
        monkeypatch.setattr(_suite, "chosen_of_machine", lambda options: {})
        options = CommandOptions(
            directory=tmp_path, run=[], json=as_json, sets=[], all=False, to=None, parallel=0, trust=False
        )
        return _suite._rerun(options, [])

    return run


def test_interrupted_rerun_names_the_command_that_resumes(rerun, tmp_path, capsys):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        rerun(interrupt)
    assert capsys.readouterr().out == f"Interrupted. crashhunt rerun {tmp_path} resumes the hunts that have begun.\n"


def test_rerun_names_the_hunts_that_it_has_replaced(rerun, tmp_path, capsys):
    places = [tmp_path / "0.replaced-0", tmp_path / "1 b.replaced-0"]
    states = [HuntState(dir="0", state="finished")]
    assert rerun(lambda *_, **__: (states, places)) == 0
    said = f"replaced: {places[0]}\nreplaced: '{places[1]}'\n"
    assert capsys.readouterr().out.startswith(said)
    assert rerun(lambda *_, **__: (states, places), as_json=True) == 0
    out, err = capsys.readouterr()
    assert (json.loads(out)["replaced"], err.startswith(said)) == ([*map(str, places)], True)
