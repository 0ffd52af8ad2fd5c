"""The directory of a hunt, where several want it at once."""

from __future__ import annotations

import errno
import os
import queue
import threading
from multiprocessing import get_context
from types import SimpleNamespace

import pytest
from conftest import examples

from crashhunt.errors import BusyError, HuntDirectoryError
from crashhunt.plans import HuntSettings
from crashhunt.results import HuntDirectory, _hunt_directory

SETTINGS = HuntSettings(scenario="loop", scenario_digest="x", trials=1, max_steps=1, seed=1)


def _claim(path, said, meeting, *, is_first):
    """Claim a directory again and again, in a process that meets the others while the first one has it."""
    try:
        busy = 0
        place = HuntDirectory(path)
        if is_first:
            with place.locked():
                meeting.wait()
                meeting.wait()  # until the others have tried
        else:
            meeting.wait()
            with pytest.raises(BusyError), place.locked():
                pass
            busy += 1
            meeting.wait()
        had = 0
        while had < examples(50):
            try:
                with place.locked():
                    place.claim(SETTINGS, ["crashhunt"], overwrite=had % 5 == 4, seed_given=True)
                    (path / "snapshots").mkdir(exist_ok=True)
                had += 1
            except BusyError:
                busy += 1
        said.put(busy)
    except BaseException as error:
        said.put(f"{type(error).__name__}: {error}")


@pytest.mark.parametrize(
    "kind",
    [
        SimpleNamespace(Queue=queue.Queue, Barrier=threading.Barrier, Process=threading.Thread),  # the lock is a file's
        pytest.param(
            get_context("spawn"), marks=pytest.mark.nightly
        ),  # forking a process with threads is asking for it
    ],
    ids=["threads", "processes"],
)
def test_of_several_at_once_one_has_it_and_the_others_are_reported_that_it_is_busy(tmp_path, kind):
    said, meeting = kind.Queue(), kind.Barrier(3, timeout=140)
    processes = [
        kind.Process(target=_claim, args=(tmp_path / "hunt", said, meeting), kwargs={"is_first": number == 0})
        for number in range(3)
    ]
    for process in processes:
        process.start()
    answers = [said.get(timeout=150) for _ in processes]
    assert all(isinstance(answer, int) for answer in answers), answers
    assert sum(answers) >= 2


def test_a_folder_of_another_stays_as_it_is(tmp_path):
    (tmp_path / "thesis.tex").write_text("x")
    with pytest.raises(HuntDirectoryError, match=r"not a hunt: it has 'thesis\.tex'"), HuntDirectory(tmp_path).locked():
        pass
    (tmp_path / ".lock").write_text("theirs")
    with pytest.raises(HuntDirectoryError, match=r"not a hunt: it has 'thesis\.tex'"), HuntDirectory(tmp_path).locked():
        pass
    assert (tmp_path / ".lock").read_text() == "theirs"
    assert len(list(tmp_path.iterdir())) == 2


def test_what_a_hunt_left_that_could_not_begin_is_in_nobodys_way(tmp_path):
    for name in (".lock", ".hunt.4711.toml"):
        (tmp_path / name).touch()
    (tmp_path / ".scratch").mkdir()
    with HuntDirectory(tmp_path).locked():
        pass


def test_full_disk_is_named_by_the_directory_that_is_on_it(tmp_path, monkeypatch):
    """The error of a write names no file, so crashhunt took it for one of its standard output."""

    def refuse(descriptor, data):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("crashhunt.results._hunt_directory.os", SimpleNamespace(write=refuse, getpid=os.getpid))
    with (
        pytest.raises(HuntDirectoryError, match="h: cannot be written: No space left"),
        HuntDirectory(tmp_path / "h").locked(),
    ):
        pass
    assert not list(tmp_path.iterdir())


def _fail(place, *, begins=False, file=""):
    with place.locked():
        place.claim(SETTINGS, ["crashhunt"], overwrite=False, seed_given=True)
        (place.path / "snapshots").mkdir()
        if file:
            (place.path / file).touch()
        place.has_begun = begins
        raise ValueError("no snapshot")


def test_directory_of_a_hunt_that_cannot_begin_is_removed_if_it_was_made_for_it(tmp_path):
    for name in ("new", "begun", "own"):
        place = HuntDirectory(tmp_path / name)
        if name == "own":
            place.path.mkdir()
        with pytest.raises(ValueError, match="no snapshot"):
            _fail(place, begins=name == "begun")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["begun", "own"]
    assert (tmp_path / "begun" / "hunt.toml").exists()


def test_directory_is_removed_even_if_no_folder_can_be_opened(tmp_path, monkeypatch):
    monkeypatch.setattr(
        _hunt_directory, "shutil", SimpleNamespace(rmtree=lambda *_, **__: None)
    )  # as with a low limit on open files
    with pytest.raises(ValueError, match="no snapshot"):
        _fail(HuntDirectory(tmp_path / "new"))
    assert not (tmp_path / "new").exists()


def test_file_of_the_user_in_a_directory_that_is_removed_stays(tmp_path):
    with pytest.raises(ValueError, match="no snapshot"):
        _fail(HuntDirectory(tmp_path / "new"), file="thesis.tex")
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["thesis.tex"]
