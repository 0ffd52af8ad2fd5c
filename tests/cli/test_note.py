"""`crashhunt note` on a real hunt, and where the notes are shown."""

from __future__ import annotations

import json
import shutil

import pytest
from conftest import one_in

from crashhunt.base import layout
from crashhunt.crashes import list_bundles


def hunted(shell):
    words = ("--arg", "speed=14", "--seed", "1", "--keep-going", "--no-snapshot")
    shell.crashhunt("run", "out", "1", "2", "99", "--scenario", "toy", *words)


@pytest.fixture
def hunt(toy, made_once):
    return made_once(hunted, toy)


def test_notes_are_added_found_shown_and_removed(hunt):
    crash = list_bundles(hunt.folder / "out")[0].id
    hunt.crashhunt("note", "out", "nightly", "run", "--tag", "ci,loop")
    done = hunt.crashhunt("note", "out", "--crash", crash, "brakes too late", "--tag", "to-fix", "--json")
    (added,) = done.json["added"]
    assert (added["number"], added["crash"], added["text"], added["tags"]) == (2, crash, "brakes too late", ["to-fix"])
    listed = hunt.crashhunt("note", "out", "--json").json["notes"]
    assert [(one["crash"], one["text"], one["tags"]) for one in listed] == [
        ("", "nightly run", ["ci", "loop"]), (crash, "brakes too late", ["to-fix"]),
    ]  # fmt: skip
    assert [one["number"] for one in hunt.crashhunt("note", ".", "--find", "TO-FIX late", "--json").json["notes"]] == [
        2
    ]
    assert hunt.crashhunt("note", ".", "--find", "blue").out == (
        "no note of 2 notes contains 'blue' (tags: ci, loop, to-fix; texts: 'nightly run', 'brakes too late')\n"
    )
    assert hunt.crashhunt("note", f"out/crashes/{crash}", "--json").json["notes"][0]["number"] == 2

    for words in (("show", "out", "--crash", crash), ("crashes", "out"), ("status", "out")):
        assert "brakes too late #to-fix" in hunt.crashhunt(*words).out
        assert "brakes too late" in hunt.crashhunt(*words, "--json").out
    assert "nightly run" not in hunt.crashhunt("show", "out", "--crash", crash).out
    assert "brakes too late #to-fix" in hunt.crashhunt("trials", "out").err
    report = hunt.folder / hunt.crashhunt("report", "out", "--json").json["file"]
    assert "brakes too late #to-fix" in report.read_text()
    assert "nightly run #ci #loop" in report.read_text()

    assert hunt.crashhunt("check", "out", "--json").json["fine"]
    assert hunt.crashhunt("note", "out", "--remove", "1", "--json").json["removed"][0]["text"] == "nightly run"
    assert "nightly run" not in hunt.crashhunt("status", "out").out


def test_crash_outside_its_hunt_has_no_report_and_no_notes(hunt):
    shutil.copytree(list_bundles(hunt.folder / "out")[0].path, hunt.folder / "sent" / "copy" / "crash")
    for words in (("report", "sent/copy/crash"), ("note", "sent/copy/crash", "mine"), ("note", "sent/copy/crash")):
        refused = hunt.crashhunt(*words, expect=2)
        assert refused.err.startswith("crashhunt: 'sent/copy/crash' is a crash outside the directory of its hunt; give")
    assert not list((hunt.folder / "sent").glob("*.*"))


def test_no_output_changes_a_file_of_a_hunt(hunt):
    ledger = (hunt.folder / "out" / layout.LEDGER).read_bytes()
    for words in (
        ("export", "out"),
        ("report", "out", "--output"),
        ("trials", "out", "--out"),
        ("rate", "out", "--html"),
        ("crashes", "out", "--summary"),
    ):
        refused = hunt.crashhunt(*words, "out/ledger.sqlite", expect=2)
        assert refused.err.splitlines()[-1] == (
            "crashhunt: out/ledger.sqlite: would change a file of a hunt, a crash or a scenario; give another file"
        )
    assert (hunt.folder / "out" / layout.LEDGER).read_bytes() == ledger


def test_salvaged_hunt_keeps_its_notes_and_a_new_hunt_has_none(hunt):
    hunt.crashhunt("note", "out", "mine")
    hunt.crashhunt("check", "out", "--salvage", "saved")
    assert [one["text"] for one in hunt.crashhunt("note", "saved", "--json").json["notes"]] == ["mine"]
    hunt.crashhunt("run", "saved", "1", "1", "20", "--scenario", "toy", "--overwrite")
    assert hunt.crashhunt("note", "saved", "--json").json["notes"] == []


@pytest.mark.parametrize(
    ("words", "message"),
    one_in(
        3,
        [
            (("out", "x", "--crash", "99"), "there is no crash '99'"),
            (("gone", "x"), "'gone' does not exist"),
            (("out", "--remove", "7"), "there is no note 7; the hunt has no notes"),
            (("out", "x", "--find", "y"), "--find cannot be combined"),
            (("out", "x", "--remove", "1"), "TEXT and --remove cannot be combined"),
            (("out", ""), "the note is empty"),
            (("file", "x"), "is an exported file, which cannot change"),
            (("out", "x", "--colour"), "there is no option '--colour'"),
        ],
    ),
)
def test_wrong_words_are_refused_in_one_line(hunt, words, message):
    (hunt.folder / "file").touch()
    done = hunt.crashhunt("note", *words, expect=2)
    assert message in done.err
    assert done.err.count("\n") == 1
    assert not (hunt.folder / "out" / layout.NOTES).exists()


def test_damaged_notes_are_found_by_check_and_lose_nothing_else(hunt):
    hunt.crashhunt("note", "out", "mine")
    with (hunt.folder / "out" / layout.NOTES).open("a") as file:
        file.write("{broken\n")
    (found,) = hunt.crashhunt("check", "out", "--json", expect=1).json["hunts"]
    assert [one["what"] for one in found["findings"] if one["damaged"]] == ["lines 2 cannot be read as notes"]
    assert json.loads(hunt.crashhunt("note", "out", "--json").out)["notes"][0]["text"] == "mine"
