"""Peers in the study of samplers, `scripts/studies/run search`: optional packages, and the limit for slow samplers."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import pytest

SCRIPTS = Path(__file__).parents[2] / "scripts" / "studies" / "search"


@pytest.fixture(scope="module")
def study():
    before = {*sys.modules}
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(SCRIPTS))
        yield importlib.import_module("search")
    for name in {*sys.modules} - before:
        path = getattr(sys.modules[name], "__file__", None)
        if path is not None and Path(path).parent == SCRIPTS:
            del sys.modules[name]


def test_a_peer_whose_package_is_missing_is_skipped_with_one_line(study, monkeypatch, capsys):
    monkeypatch.setattr(sys.modules["peers"].importlib.util, "find_spec", lambda name: None if name == "smac" else name)
    assert study._installed(["guided", "smac", "turbo", "optuna-tpe"]) == ["guided", "turbo", "optuna-tpe"]
    assert capsys.readouterr().err == "skipped, because a package is not installed: smac (pip install smac)\n"


def test_slow_peers_and_those_with_packages_are_peers(study):
    peers = sys.modules["peers"]
    assert {*peers.SLOW} <= {*peers.PEERS}
    assert {*peers._PACKAGES} <= {*peers.PEERS}


def test_a_hunt_ends_at_the_limit(study):
    runs = [study.synthetic_run("needle", "random", seed, limit=7) for seed in range(3)]
    assert [(run.trials, run.found) for run in runs] == [(7, False)] * 3  # one trial in 5000 crashes


def test_cost_of_the_delay_counts_as_many_random_draws_as_results_arrive_later(study):
    def runs(trials):
        return [
            study.Run(problem=name, sampler="guided", seed=seed, trials=trials, found=True)
            for name in ("smooth", "blind") for seed in range(3)
        ]  # fmt: skip

    smooth, blind, every, learnable = study.delay_table(runs(50), runs(60), 28).splitlines()[2:]
    assert smooth == (
        # 28 of 500 crash early: (1 - 0.998^28) * 500 + 0.998^28 * 50 = 74.5
        "| smooth | 3 | 50 | 60 | 1.20 (1.20-1.20) | 1.56 (1.56-1.56) | 1.49 (1.49-1.49) |"
    )
    assert blind.startswith("| blind | 3 | 50 | 60 | 1.20 (1.20-1.20) | 1.56 (1.56-1.56) |")
    assert every.startswith("| *all: 2* | | | | 1.20 ")
    assert learnable.startswith("| *criticality leads to the crash: 1* | | | | 1.20 ")
