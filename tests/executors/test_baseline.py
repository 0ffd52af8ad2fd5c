"""What a worker takes for a user's own."""

from __future__ import annotations

import calendar
import os
from pathlib import Path

from crashhunt.executors._baseline import Baseline


def test_pythons_own_library_is_nobodys_code_wherever_a_worker_is(tmp_path, monkeypatch):
    """A node of a cluster may work in /, below which everything is."""
    (tmp_path / "mine.py").write_text("VALUES = [1]\n")
    monkeypatch.syspath_prepend(tmp_path)
    import mine  # type: ignore[import-not-found]

    monkeypatch.chdir("/")
    baseline = Baseline((), tmp_path / "scratch")
    monkeypatch.setattr(calendar, "error", ValueError)
    assert Path(os.__file__).is_relative_to("/")
    assert baseline.change() == ""
    mine.VALUES.append(2)
    assert baseline.change() == "mine.VALUES"
