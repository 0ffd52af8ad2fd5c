"""What an older crashhunt has left is read, shown and replayed. Every version that is released leaves a bundle here."""

from __future__ import annotations

from importlib.metadata import version
from pathlib import Path

import pytest

BUNDLES = sorted((Path(__file__).parent / "bundles").glob("*.zip"))
SAME_TRAFFIC = version("libsumo") == "1.28.0"  # which recorded them; another one may compute other traffic
pytestmark = pytest.mark.parametrize("bundle", list(map(str, BUNDLES)), ids=[path.stem for path in BUNDLES])


def test_its_crash_is_replayed_by_the_crashhunt_inside(shell, bundle):
    report = shell.crashhunt("replay", bundle, "--trust", "--json", expect=0 if SAME_TRAFFIC else None).json
    assert report["verdict"] == "reproduced" if SAME_TRAFFIC else report["verdict"] in ("reproduced", "not_comparable")
    if SAME_TRAFFIC:
        assert report["digest_replayed"] == report["digest_recorded"] != ""


def test_it_is_told_and_driven_from_its_log_without_running_its_code(shell, bundle):
    assert "drove into left.8 at step 40" in shell.crashhunt("show", bundle).out
    shell.crashhunt("report", bundle, "--output", "page.html")
    assert "left.8" in (shell.folder / "page.html").read_text()
    driven = shell.crashhunt("replay", bundle, "--from-log", "--json", expect=0 if SAME_TRAFFIC else None)
    assert driven.json["code"] == "log"
