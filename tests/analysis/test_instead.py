"""What an agent did instead of what it omitted, from speeds alone."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace

import pytest

from crashhunt.analysis import _omissions


def instead(*speeds, dt=0.5, first=0):
    """Speeds in m/s at each step; the last one is that after the crash."""
    roster = SimpleNamespace(index={"ego": 0})
    scenes = [SimpleNamespace(roster=roster, speeds=[speed]) for speed in speeds]
    search = object.__new__(_omissions._Search)
    search._agent, search._dt = "ego", dt
    search._recording = SimpleNamespace(scenes=lambda: scenes)
    found = search._speeds(first)
    return search._instead(found), search._kept_s(found)


@pytest.mark.parametrize(
    ("speeds", "expected"),
    [
        ((20, 21, 22, 23, 24, 25, 3), "sped up"),
        ((20, 20, 20, 20, 20, 20, 3), "kept its speed"),
        ((16, 18, 20, 20, 20, 20, 20.5, 3), "kept its speed"),  # it sped up before the last 2 s, and for a moment
        ((20, 20, 20, 20, 19.9, 19.4, 3), "braked too little"),
        ((25, 20, 21, 22, 23, 24, 3), "braked too little"),  # it has slowed down since the period began
        ((20, 20, 21, 22, 22, 23, 30), "sped up"),  # the crash itself does not count
        ((20, 25, 26, 27, 27, 27, 27, 3), "sped up"),  # to its top speed, 1.5 s before the crash
        ((20, 23, 26, 27, 27, 27, 27, 27, 3), "kept its speed"),  # its top speed was reached 2 s before
        ((20, 20.1, 20.2, 20.3, 20.4, 20.5, 3), "kept its speed"),  # by 0.2 m/s²
        ((20, 3), "kept its speed"),
        ((20, 30, 40, 40, 40, 39, 38, 37, 3), "braked too little"),  # faster than at the beginning of the period
        ((20, 22, 24, 26, 26, 25.8, 25.7, 25.6, 3), "kept its speed"),  # by less than 0.5 m/s
    ],
)
def test_agent_sped_up_if_it_did_so_on_average_over_the_last_two_seconds(speeds, expected):
    assert instead(*speeds)[0] == expected


def test_speeds_before_the_period_do_not_count():
    assert instead(30, 20, 20, 20, 20, 20, 3, first=1) == ("kept its speed", 2.0)


@pytest.mark.parametrize(
    ("speeds", "kept_s"),
    [
        ((32, 34, 36, 38, 40, 40, 40, 3), 1.0),  # not while it sped up before
        ((20.4, 20.0, 20.4, 20.0, 3), 1.5),
        ((20, 19.5, 20, 20, 3), 0.5),
        ((20, 3), 0.0),
    ],
)
def test_speed_is_kept_as_long_as_it_is_that_of_the_end(speeds, kept_s):
    assert instead(*speeds)[1] == kept_s


@dataclass(frozen=True)
class Spec:
    max_steps: int = 60


@pytest.mark.parametrize("repeated", [True, False])
def test_omission_is_reported_only_if_its_run_can_be_repeated(monkeypatch, repeated):
    digests = iter(["a", "b", "c", "a" if repeated else "d"])
    search = object.__new__(_omissions._Search)
    search._dt, search._left, search._end, search.runs = 0.5, 10, 40, []
    search._rerun = SimpleNamespace(spec=Spec())
    monkeypatch.setattr(search, "_omission", lambda candidate, faculty: "omitted", raising=False)
    monkeypatch.setattr(search, "_judged", lambda *_: SimpleNamespace(ending="none"), raising=False)
    ended = lambda: SimpleNamespace(result=SimpleNamespace(digest=next(digests)))  # noqa: E731
    monkeypatch.setattr(search, "_run", lambda specs, faculty, steps: [ended() for _ in steps], raising=False)
    found = search._try({"first": 30, "last": 38, "actor": "", "faculty": "speed"}, "speed")
    assert (found.omission, len(found.runs)) == ("omitted" if repeated else None, 3)
    assert found.why_not == ("" if repeated else "a run with the reference driver could not be repeated")
