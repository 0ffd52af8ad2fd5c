"""Which of the two steps SUMO, the compiled core or Python: told at the start, by status and in environment.json."""

from __future__ import annotations

import json
from importlib import metadata

import pytest

from crashhunt.native import why_no_link_order, why_not

LIBSUMO = metadata.version("libsumo")


@pytest.mark.parametrize("native", [True, False])
def test_it_is_reported(shell, native):
    words = () if native else ("--no-native",)
    done = shell.crashhunt("run", "h", "1", "1", "3", "--seed", "1", *words)
    reason = why_not(LIBSUMO) if native else "--no-native"
    told = f"not used: {reason}" if reason else "used"
    assert f"the compiled core is {told}" in done.out
    assert shell.crashhunt("status", "h", "--json").json["hunts"][0]["core"] == told
    assert f"compiled core {told}" in shell.crashhunt("status", "h").out
    (environment,) = (shell.folder / "h/snapshots").glob("*/environment.json")
    recorded = json.loads(environment.read_text())
    assert recorded["core"] == told
    reason = why_no_link_order(LIBSUMO)  # which the core has no part in
    assert recorded["load_order"] == (f"not fixed: {reason}" if reason else "fixed")
    assert ("the order of SUMO's links is not fixed" in done.out) == bool(reason)
    assert ("native = false" in (shell.folder / "h/hunt.toml").read_text()) == (not native)
