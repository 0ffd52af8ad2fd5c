"""The most dangerous trials without a crash are kept as bundles of their own, and work as those of crashes do."""

from __future__ import annotations

import json

import pytest

WORDS = ("run", "h", "1", "8", "30", "--scenario", "toy", "--seed", "4", "--keep-going", "--arg", "speed=6:16")


def with_near_misses(toy):
    done = toy.crashhunt(*WORDS, "--near-misses", "2", "--no-snapshot", "--json")
    (toy.folder / "run.json").write_text(json.dumps(done.json))


@pytest.fixture
def hunt(toy, made_once):
    return made_once(with_near_misses, toy)


def survivors(hunt):
    """By danger, the greatest first."""
    rows = hunt.crashhunt("trials", "h", "--format", "json").json
    return sorted((row for row in rows if row["outcome"] in ("survived", "finished")), key=lambda row: -row["danger"])


def test_it_is_reported_around_the_moment_when_it_was_nearest(hunt):
    number = str(survivors(hunt)[0]["number"])
    words = ("h", "--crash", number)
    told = hunt.crashhunt("show", *words, "--last-seconds", "1", "--json").json
    nearest, danger = told["nearest"], told["danger"]
    (kept,) = (one for one in json.loads((hunt.folder / "run.json").read_text())["near_misses"]
               if str(one["trial"]) == number)  # fmt: skip
    # The danger that trials are ranked by is the agent's own.
    assert danger["ranked_by"] == kept["danger"] == pytest.approx(danger["own"]["over_the_trial"])
    assert (danger["own"]["step"], danger["own"]["other"]) == (nearest["step"], nearest["other"])
    assert nearest["danger"] == danger["own"]["greatest"] > 0
    assert told["other"] == nearest["other"] != ""
    steps = [one["step"] for one in danger["steps"]]
    around = range(max(0, nearest["step"] - 5), min(30, nearest["step"] + 5) + 1)
    assert steps == [moment["step"] for moment in told["moments"]] == list(around)
    assert danger["steps"][steps.index(nearest["step"])]["own"] == pytest.approx(nearest["danger"])
    text = hunt.crashhunt("show", *words, "--last-seconds", "1").out
    assert f"after step {nearest['step']}: a criticality of {nearest['danger']:.2f}, to {nearest['other']}." in text
    (marked,) = (line for line in text.splitlines() if line.endswith("<- nearest"))
    assert int(marked.split()[0]) == nearest["step"]
    film = ("--from-log", "--frames", "f", "--size", "64x64", "--last-step-repeats", "0", "--no-panels")
    made = hunt.crashhunt("replay", *words, *film, "--last-seconds", "1", "--json").json
    assert made["written"] == {"f": len(around)}
    refused = hunt.crashhunt("replay", *words, "--before", "99", expect=2)
    assert f"but the closest moment is at step {nearest['step']}" in refused.err


def test_the_page_shows_them_after_the_crashes(hunt):
    done = hunt.crashhunt("report", "h", "--json").json
    page = (hunt.folder / "h" / "report.html").read_text()
    data = json.loads(page.split('<script id="data" type="application/json">')[1].split("</script>")[0])
    assert [crash["id"] for crash in data["crashes"]] == [*done["crashes"], *done["near_misses"]]
    assert len(done["near_misses"]) == 2
    for crash in data["crashes"]:
        assert (crash["nearest"] is None) == (crash["category"] != "no crash")
        assert crash["danger"]
        assert crash["behind"]
    told = hunt.crashhunt("show", "h", "--crash", done["near_misses"][0], "--json").json
    assert data["crashes"][-2]["nearest"] == told["nearest"]["step"]
    assert sum(len(kind["members"]) for kind in data["kinds"]) == len(done["crashes"])


def test_without_a_crash_there_is_nothing_to_be_fixed(hunt):
    number = str(survivors(hunt)[0]["number"])
    slower = hunt.crashhunt("replay", "h", "--crash", number, "--set", "speed=5", "--json", expect=1).json
    assert slower["verdict"] == "diverged"
    faster = hunt.crashhunt("replay", "h", "--crash", number, "--set", "gap_m=10", expect=1)
    assert "changed: it crashes now" in faster.out
