"""One defect is one kind of crash, and two are two: in hunts of an agent with planted ones."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from conftest import keeps_going

from crashhunt.crashes import list_bundles

PLANTED = Path(__file__).with_name("planted.py")


@pytest.mark.nightly  # by day, test_signature.py has crashes of every kind
def test_each_defect_is_a_kind(shell):
    shutil.copy(PLANTED, shell.folder)
    arguments = ("--agent", "planted:Planted", "--arg", "defect=asleep|blind|reads")
    words = ("run", "h", "2", "9", "150", "--scenario", "loop", *arguments, "--seed", "5", "--json")
    first = shell.crashhunt(*words, "--distinct", "2").json
    assert first["stopped_because"] == "distinct"
    assert first["trials_run"] < 9
    assert len(first["kinds"]) >= 2  # two may end at once
    again = shell.crashhunt(*words, "--distinct", "2").json
    assert (again["stopped_because"], again["trials_run"]) == ("distinct", first["trials_run"])
    rest = shell.crashhunt(*words, "--keep-going").json
    assert (rest["stopped_because"], rest["trials_run"]) == ("all_trials", 9)
    (state,) = shell.crashhunt("status", "h", "--json").json["hunts"]
    assert state["kinds"] == rest["kinds"]
    assert state["newest_kind_s"] >= 0
    assert "3 types" in shell.crashhunt("status", "h").out

    found = shell.crashhunt("crashes", "h", "--json").json
    bundles = {str(bundle.path.relative_to(shell.folder)): bundle for bundle in list_bundles(shell.folder / "h")}
    kinds = [
        {bundles[name].result.spec.arguments["ego"]["defect"] for name in group["members"]} for group in found["groups"]
    ]
    assert all(len(defects) == 1 for defects in kinds)
    assert sorted(kinds, key=str) == [{"asleep"}, {"blind"}, {"reads"}]
    assert sorted(name for group in found["groups"] for name in group["members"]) == sorted(bundles)
    same = [
        {"words": group["words"], "count": group["count"]}
        | {name: Path(group[name]).name for name in ("first", "shortest")}
        for group in found["groups"]
    ]
    assert rest["kinds"] == same  # the hunt tells them as the command does
    asleep, blind = (
        next(group for group, of in zip(found["groups"], kinds, strict=True) if of == {name})
        for name in ("asleep", "blind")
    )
    assert asleep["words"] == "rear end, the agent into the other"
    assert (blind["outcome"], blind["manner"]) == ("off_road", "off road")
    assert bundles[asleep["shortest"]].result.steps == min(bundles[name].result.steps for name in asleep["members"])

    lines = shell.crashhunt("crashes", "h").out.splitlines()
    assert lines[0] == f"{len(bundles)} crashes of {len(kinds)} types:"
    assert len(lines) == 3 + len(kinds)

    broken = bundles[asleep["shortest"]].path / "log.mcap"
    broken.write_bytes(broken.read_bytes()[:-200])
    done = shell.crashhunt("crashes", "h", "--json")
    assert sum(group["count"] for group in done.json["groups"]) == len(bundles) - 1
    assert len(done.json["left_out"]) == 1
    assert "skipped: " in done.err
    assert "log.mcap" in done.err


def test_what_has_no_crashes_and_what_is_no_hunt(toy, made_once):
    shutil.rmtree(made_once(keeps_going, toy).folder / "h" / "crashes")
    assert toy.crashhunt("crashes", "h").out == "No crash was saved.\n"
    assert toy.crashhunt("crashes", "h", "--json").json == {"groups": [], "left_out": []}
    done = toy.crashhunt("crashes", "h2", expect=2)
    assert "'h2' does not exist" in done.err
