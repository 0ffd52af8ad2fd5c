"""Notes and tags of users: several writers, odd texts, damaged files, and archives."""

from __future__ import annotations

import json
import os
import zipfile
from concurrent.futures import ThreadPoolExecutor

import pytest
from conftest import examples
from hypothesis import given, settings, strategies as st
from test_archive import crash as crash

from crashhunt.base import layout
from crashhunt.crashes import (
    Note,
    add_note,
    export_crash,
    open_archive,
    read_bundle,
    read_notes,
    remove_note,
    subject_of,
    unreadable_notes,
)
from crashhunt.errors import BundleError, HuntDirectoryError, UsageError
from crashhunt.report import describe_note


def test_notes_of_two_writers_at_once_are_all_there(tmp_path):
    with ThreadPoolExecutor(8) as writers:  # flock tells open files apart, also within one process
        added = list(writers.map(lambda number: add_note(tmp_path, "", f"text {number}"), range(40)))
    assert sorted(note.number for note in added) == list(range(1, 41))
    assert {note.text for note in read_notes(tmp_path)} == {f"text {number}" for number in range(40)}


@settings(max_examples=examples(50))
@given(st.text(min_size=1, max_size=80).filter(str.strip))
def test_any_text_comes_back_as_it_was_written(tmp_path_factory, text):
    hunt = tmp_path_factory.mktemp("hunt")
    assert add_note(hunt, "000001-hang", text) == read_notes(hunt)[0]
    assert read_notes(hunt)[0].text == text.strip()
    assert "\n" not in describe_note(read_notes(hunt)[0])


def test_notes_are_found_by_crash_and_by_words(tmp_path):
    add_note(tmp_path, "", "the whole hunt", ["Nightly"])
    add_note(tmp_path, "000001-collision", "brakes late", ["to-fix", "to-fix", "late"])
    add_note(tmp_path, "probes/000001-collision", "of a fork")
    assert [note.text for note in read_notes(tmp_path, "000001-collision")] == ["brakes late"]
    assert [note.text for note in read_notes(tmp_path, "")] == ["the whole hunt"]
    found = read_notes(tmp_path)
    assert [note.tags for note in found] == [("Nightly",), ("to-fix", "late"), ()]
    assert [note.number for note in found if note.matches(["LATE", "to-fix"])] == [2]
    assert [note.number for note in found if note.matches(["nightly"])] == [1]
    assert [note.number for note in found if note.matches(["000001"])] == [2, 3]
    assert not any(note.matches(["brakes", "nightly"]) for note in found)


def test_number_of_a_removed_note_is_not_used_again(tmp_path):
    add_note(tmp_path, "", "one")
    assert remove_note(tmp_path, add_note(tmp_path, "", "two").number).text == "two"
    assert add_note(tmp_path, "", "three").number == 3
    assert [note.text for note in read_notes(tmp_path)] == ["one", "three"]
    with pytest.raises(BundleError, match=r"no note 2; give one of 1, 3$"):
        remove_note(tmp_path, 2)


def test_torn_line_of_a_killed_writer_spoils_no_other(tmp_path):
    add_note(tmp_path, "", "one")
    path = tmp_path / layout.NOTES
    path.write_bytes(path.read_bytes() + b'{"number": 2, "te')
    assert add_note(tmp_path, "", "three").number == 2
    assert [note.text for note in read_notes(tmp_path)] == ["one", "three"]
    assert unreadable_notes(tmp_path) == [2]


WRONG_TYPE = '{"number": "1", "crash": "", "at": "", "by": "", "text": "", "tags": []}'


@pytest.mark.parametrize(
    "line",
    ["[]", "3", "null", '"removed"', '{"removed": []}', '{"number": 1}', WRONG_TYPE, "[" * 100_000, "\xff"],
)
def test_line_that_is_no_note_is_reported_and_skipped(tmp_path, line):
    (tmp_path / layout.NOTES).write_text(f"{line}\n", encoding="latin-1")
    add_note(tmp_path, "", "mine")
    assert [note.text for note in read_notes(tmp_path)] == ["mine"]
    assert unreadable_notes(tmp_path) == [1]


def test_link_that_leads_out_of_a_hunt_is_neither_read_nor_written(tmp_path):
    (tmp_path / "secret").write_text(json.dumps(Note(1, "", "", "", "secret").to_json()))
    hunt = tmp_path / "hunt"
    hunt.mkdir()
    (hunt / layout.NOTES).symlink_to(tmp_path / "secret")
    before = (tmp_path / "secret").read_bytes()
    assert read_notes(hunt) == ()
    with pytest.raises(HuntDirectoryError, match="cannot be written"):
        add_note(hunt, "", "x")
    assert (tmp_path / "secret").read_bytes() == before


def test_pipe_in_place_of_the_notes_blocks_no_reader_and_no_writer(tmp_path):
    os.mkfifo(tmp_path / layout.NOTES)
    assert read_notes(tmp_path) == ()
    with pytest.raises(HuntDirectoryError, match="cannot be written"):
        add_note(tmp_path, "", "x")


def test_folder_that_cannot_be_written_is_named(tmp_path):
    with pytest.raises(HuntDirectoryError, match=r"notes\.jsonl: cannot be written: No such file"):
        add_note(tmp_path / "gone", "", "x")


@pytest.mark.parametrize(
    ("text", "tags", "words"),
    [
        (" \n", [], "the note is empty; give a text, or --tag TAG"),
        ("x" * 10_001, [], "has 10,001 characters"),
        ("x", ["two words"], "'two words'"),
        ("x", ["a,b"], "'a,b'"),
        ("x", [""], "--tag is ''"),
        ("x", ["t" * 51], "1 to 50 characters"),
        ("x", [f"t{number}" for number in range(21)], "21 tags"),
    ],
)
def test_note_that_is_empty_or_too_long_is_refused(tmp_path, text, tags, words):
    with pytest.raises(UsageError, match=words):
        add_note(tmp_path, "", text, tags)
    assert not (tmp_path / layout.NOTES).exists()


def test_long_note_is_shortened_in_the_middle_only_in_lists():
    note = Note(1, "", "now", "ana", "a" * 5_000 + "b" * 5_000, ("t",))
    assert len(describe_note(note)) > 10_000
    short = describe_note(note, whole=False)
    assert len(short) < 250
    assert "a … b" in short
    assert short.endswith("b #t")


def test_exported_crash_has_its_own_notes_only(crash, tmp_path):
    hunt = crash.hunt
    add_note(hunt, subject_of(crash), "on the crash", ["known"])
    add_note(hunt, "", "on the hunt")
    add_note(hunt, "000099-hang", "on another")
    try:
        export_crash(crash, tmp_path / "crash.zip")
    finally:
        (hunt / layout.NOTES).unlink()
    with zipfile.ZipFile(tmp_path / "crash.zip") as archive:  # where earlier versions accept no further file
        assert layout.NOTES not in archive.namelist()
    with open_archive(tmp_path / "crash.zip") as unpacked:
        inside = read_bundle(unpacked.directory / layout.CRASHES / crash.id)
        assert [note.text for note in read_notes(unpacked.directory)] == ["on the crash"]
        assert read_notes(unpacked.directory, subject_of(inside))[0].tags == ("known",)
    export_crash(crash, tmp_path / "plain.zip")
    with open_archive(tmp_path / "plain.zip") as unpacked:
        assert not (unpacked.directory / layout.NOTES).exists()
