"""What `crashhunt rerun` says after Ctrl-C."""

from __future__ import annotations

from argparse import Namespace

import pytest

import crashhunt.suites
from crashhunt.cli import _suite


def test_interrupted_rerun_names_the_command_that_resumes(tmp_path, monkeypatch, capsys):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(crashhunt.suites, "rerun", interrupt)
    monkeypatch.setattr(_suite, "chosen_runs", lambda directory, runs: [directory])
    monkeypatch.setattr(_suite, "chosen_of_machine", lambda options: {})
    options = Namespace(
        directory=tmp_path, run=[], json=False, sets=[], all=False, to=None, parallel=0, trust=False
    )  # fmt: skip
    with pytest.raises(KeyboardInterrupt):
        _suite._rerun(options, [])
    assert capsys.readouterr().out == f"Interrupted. crashhunt rerun {tmp_path} resumes the hunts that have begun.\n"
