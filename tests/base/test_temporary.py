"""Temporary things go with their process, and those of a killed process with the next command."""

from __future__ import annotations

import errno
import gc
import mmap
import os
import shutil
import signal
import stat
import subprocess
import sys
import threading
import time
import uuid
import weakref
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from multiprocessing import shared_memory
from pathlib import Path

import pytest

from crashhunt.base import process_owners, shared_memory as segments, temporary
from crashhunt.base.files import exchange, put_in_place, whole_file
from crashhunt.base.process_owners import OwnerProcess, has_ended, owner_in, start_time, this_process
from crashhunt.base.temporary import (
    TemporaryFolder,
    new_folder,
    remove_at_once,
    remove_ended,
    remove_leftovers,
    remove_scratch,
    remove_tree,
    temporary_beside,
    temporary_folder,
    temporary_name,
)

KEPT: list[object] = []  # what is lost is removed
ODD = ["plain", "with space\nand line", "-f", "Zürich 東京", "*?[x]", "x" * 250, os.fsdecode(b"\xff\xfe")]


@pytest.fixture(autouse=True)
def place(tmp_path, monkeypatch):
    """The folder for the processes of this user, in a folder for temporary files of the test's own."""
    files = tmp_path / "temporary files"
    files.mkdir()
    monkeypatch.setenv("TMPDIR", str(files))
    if temporary._things._count:  # what other tests of this process have not yet removed is in the folder they chose
        gc.collect()
        monkeypatch.setattr(temporary, "_things", temporary._TemporaryFiles())
    return files / f"crashhunt-temporary-{os.getuid()}"


def in_child(function) -> int:
    """Call a function in a fork, and return how that ended: its exit code, or minus the number of the signal."""
    pid = os.fork()
    if pid == 0:
        code = 99
        with suppress(BaseException):
            function()
            code = 0
        os._exit(code)
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])


def die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def begun(path: Path, **options) -> Path:
    """Begin something temporary beside a path, and keep it."""
    KEPT.append(temporary_beside(path, **options))
    return KEPT[-1].__enter__()


@contextmanager
def alive(function):
    """A fork that has called a function and lives; yields its process id."""
    done, tell = os.pipe()
    hold, release = os.pipe()
    pid = os.fork()
    if pid == 0:
        os.close(release)
        with suppress(BaseException):
            function()
            os.write(tell, b"x")
            os.read(hold, 1)
        os._exit(0)
    os.close(hold)
    try:
        assert os.read(done, 1) == b"x"
        yield pid
    finally:
        for descriptor in (release, done, tell):
            os.close(descriptor)
        os.waitpid(pid, 0)


def everything(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*")}


def test_nothing_is_left_at_the_end_nor_after_an_error(place, tmp_path):
    with temporary_folder("replay") as folder, temporary_beside(tmp_path / "made") as beside:
        (folder / "below").mkdir()
        (folder / "below" / "file").write_text("x")
        beside.mkdir()
        assert folder.parent == place / this_process().token
        assert folder.name.startswith("replay-")
        assert stat.S_IMODE(place.lstat().st_mode) == 0o700
        assert beside.name == f".made.{this_process().token}.part"
    with pytest.raises(KeyError), temporary_folder("replay") as folder:
        raise KeyError
    kept = TemporaryFolder("environment")
    assert kept.path.is_dir()
    del kept  # as a Gymnasium environment that is never closed
    assert everything(tmp_path) == {"temporary files"}


def test_what_a_killed_process_leaves_goes_with_the_next_look(place, tmp_path):
    def leaves():
        KEPT.append(folder := TemporaryFolder("replay"))
        (folder.path / "file").write_text("x")
        (tmp_path / "there").mkdir()
        for name in ODD:
            begun(tmp_path / "there" / name).mkdir()
            begun(tmp_path / "there" / name, name=temporary_name(Path(name), ".csv")).touch()
        die()

    assert in_child(leaves) == -signal.SIGKILL
    assert len([*(tmp_path / "there").iterdir()]) == 2 * len(ODD)
    assert len([*place.iterdir()]) == 1
    remove_leftovers()
    assert everything(tmp_path) == {"temporary files", "there"}


def test_temporary_name_is_shortened_no_more_than_the_system_needs():
    assert temporary_name(Path("a.csv")) == f".a.{this_process().token}.csv"
    assert temporary_name(Path("a.csv"), ".x") == f".a.csv.{this_process().token}.x"
    assert len(temporary_name(Path(f"{'a' * 250}.csv"))) == 255
    assert len(os.fsencode(temporary_name(Path(f"{'ä' * 124}.csv")))) in (254, 255)


def test_threads_that_write_the_same_file_have_temporary_files_of_their_own(tmp_path):
    """Two threads that minimized the same crash removed each other's files."""
    both, folder = threading.Barrier(2), tmp_path / "there"
    folder.mkdir()

    def write(word):
        with temporary_beside(folder / "a") as there:
            there.write_text(word)
            both.wait(300)
            return there.name, there.read_text(), owner_in(there.name)

    with ThreadPoolExecutor(2) as threads:
        (one, word, owner), (other, *rest) = threads.map(write, ["one", "two"])
    assert one != other
    assert (word, owner, rest) == ("one", this_process(), ["two", this_process()])
    assert list(folder.iterdir()) == []


def test_the_first_thing_of_a_process_removes_leftovers_too(place):
    assert in_child(lambda: (KEPT.append(TemporaryFolder("replay")), die())) == -signal.SIGKILL

    def uses():
        with temporary_folder("judge"):
            assert [path.name for path in place.iterdir()] == [this_process().token]

    temporary._things.swept = False
    try:
        assert in_child(uses) == 0
    finally:
        temporary._things.swept = True


def test_a_file_that_was_being_written_goes_and_the_one_that_was_there_stays(place, tmp_path):
    (tmp_path / "report.html").write_text("old")

    def leaves():
        with whole_file(tmp_path / "report.html") as half:
            half.write_text("hal")
            die()

    assert in_child(leaves) == -signal.SIGKILL
    assert len([*tmp_path.glob(".report.*.html")]) == 1
    remove_leftovers()
    assert everything(tmp_path) == {"temporary files", "report.html"}
    assert (tmp_path / "report.html").read_text() == "old"


def test_a_living_process_keeps_everything(place, tmp_path):
    def makes():
        KEPT.append(TemporaryFolder("replay"))
        begun(tmp_path / "made").touch()

    with alive(makes) as pid:
        before = everything(tmp_path)
        assert len(before) == 6
        remove_leftovers()
        remove_ended(tmp_path)
        assert everything(tmp_path) == before
        (folder,) = place.iterdir()
        # Not even where its start time says that it has ended: it holds the lock.
        owner = owner_in(folder.name)
        assert owner.pid == pid
        wrong = OwnerProcess(pid, owner.started + 1, owner.boot, owner.namespace)
        folder.rename(folder.with_name(wrong.token))
        remove_leftovers()
        assert (place / wrong.token / "replay-1").is_dir()
    remove_leftovers()
    assert not place.exists()


def owned(place: Path, owner: OwnerProcess) -> Path:
    folder = place / owner.token / "replay-1"
    folder.mkdir(parents=True)
    place.chmod(0o700)
    return folder


def test_a_process_id_that_was_given_to_another_process_is_not_taken_for_the_owner(place):
    here = this_process()
    folder = owned(place, OwnerProcess(here.pid, here.started - 1, here.boot, here.namespace))
    (place / f"x{ended().token}").mkdir()
    remove_leftovers()
    assert not folder.exists()
    assert (place / f"x{ended().token}").exists()


def test_a_process_that_proc_does_not_show_counts_as_alive(monkeypatch):
    other = OwnerProcess(os.getppid(), 5, this_process().boot, this_process().namespace)
    assert has_ended(other)
    monkeypatch.setattr(process_owners, "start_time", lambda pid: -1)
    assert not has_ended(other)


@pytest.mark.parametrize("field", ["boot", "namespace", "unknown"])
def test_what_another_host_boot_or_container_has_stays(place, field):
    here = this_process()
    gone = next(pid for pid in range(4_000_000, 5_000_000) if start_time(pid) == 0)
    theirs = {
        "boot": OwnerProcess(gone, 5, "0123456789ab", here.namespace),
        "namespace": OwnerProcess(gone, 5, here.boot, "01234567"),
        "unknown": OwnerProcess(gone, 0, "0" * 12, "0" * 8),
    }[field]
    folder = owned(place, theirs)
    ours = owned(place, OwnerProcess(gone, 5, here.boot, here.namespace))
    remove_leftovers()
    assert (folder.exists(), ours.exists()) == (True, False)


def test_where_a_process_does_not_know_itself_it_removes_nothing_of_others(place, monkeypatch):
    here = this_process()
    with monkeypatch.context() as patched, fresh():
        patched.setattr(process_owners, "_BOOT_ID", "/nowhere")
        assert this_process().boot == "0" * 12
        folder = owned(place, OwnerProcess(here.pid, 1, here.boot, here.namespace))
        unknown = owned(place, OwnerProcess(here.pid + 1, 0, "0" * 12, "0" * 8))
        remove_leftovers()
        assert folder.exists()
        assert unknown.exists()
        with temporary_folder("replay") as mine:
            assert mine.is_dir()
        assert not mine.parent.exists()
    assert this_process() == here


@contextmanager
def fresh():
    """Nothing is remembered of this process, before and after."""
    process_owners.owner_of.cache_clear()
    process_owners.boot_id.cache_clear()
    try:
        yield
    finally:
        process_owners.owner_of.cache_clear()
        process_owners.boot_id.cache_clear()


def ended() -> OwnerProcess:
    """An owner of which it is certain that it has ended."""
    here = this_process()
    return OwnerProcess(here.pid, here.started - 1, here.boot, here.namespace)


def test_a_symbolic_link_that_looks_like_a_leftover_stays_and_so_does_its_target(place, tmp_path):
    thesis = tmp_path / "thesis"
    thesis.mkdir()
    (thesis / "thesis.tex").write_text("x")
    place.mkdir(mode=0o700)
    (place / ended().token).symlink_to(thesis)
    (tmp_path / f".made.{ended().token}.part").symlink_to(thesis)
    remove_leftovers()
    remove_ended(tmp_path)
    assert (place / ended().token).is_symlink()
    assert (tmp_path / f".made.{ended().token}.part").is_symlink()
    # One inside of a leftover is removed, and not followed.
    (place / ended().token).unlink()
    folder = owned(place, ended())
    (folder / "link").symlink_to(thesis)
    remove_leftovers()
    assert not place.exists()
    assert (thesis / "thesis.tex").read_text() == "x"


def test_a_link_to_what_has_not_the_name_of_the_process_removes_nothing(place, tmp_path):
    other = OwnerProcess(ended().pid, ended().started - 1, ended().boot, ended().namespace)
    names = ["thesis.tex", f".made.{other.token}.part", f".{other.token}.{ended().token}.part", "fifo"]
    for name in names[:3]:
        (tmp_path / name).write_text("x")
    os.mkfifo(fifo := tmp_path / f".fifo.{ended().token}.part")
    folder = owned(place, ended()).parent
    for number, target in enumerate([*(tmp_path / name for name in names[:3]), fifo, tmp_path / "gone"]):
        (folder / f"elsewhere-{number}").symlink_to(target)
    remove_leftovers()
    assert not place.exists()
    assert everything(tmp_path) == {"temporary files", *names[:3], fifo.name}


@pytest.mark.skipif(os.getuid() != 0, reason="only root can give files away")
def test_what_another_user_owns_stays_and_is_not_used(place, tmp_path):
    place.mkdir(mode=0o777)
    folder = owned(place, ended())
    os.chown(folder.parent, 4711, 4711)
    remove_leftovers()
    assert folder.exists()
    os.chown(place, 4711, 4711)  # another user was first to make it
    with temporary_folder("replay") as mine:
        assert mine.parent.parent == place.parent
        assert mine.parent.name == f"crashhunt-temporary-{this_process().token}"
    assert in_child(lambda: (KEPT.append(TemporaryFolder("replay")), die())) == -signal.SIGKILL
    assert len([*place.parent.iterdir()]) == 2
    remove_leftovers()
    assert [*place.parent.iterdir()] == [place]
    assert folder.exists()
    beside = tmp_path / f".made.{ended().token}.part"
    beside.touch()
    os.chown(beside, 4711, 4711)
    remove_ended(tmp_path)
    assert beside.exists()


@pytest.mark.parametrize("kind", ["link", "writable", "file"])
def test_a_folder_that_others_may_write_is_not_used(place, tmp_path, kind):
    if kind == "link":
        (tmp_path / "theirs").mkdir()
        place.symlink_to(tmp_path / "theirs")
    elif kind == "writable":
        place.mkdir()
        place.chmod(0o777)
    else:
        place.touch()
    with temporary_folder("replay") as mine:
        assert mine.parent.parent == place.parent
    assert [*place.parent.iterdir()] == [place]


def test_names_that_only_look_like_leftovers_stay(tmp_path):
    token = ended().token
    stay = [f"made.{token}.part", ".made.4711.part", f".made.{token}0.part", ".hunt.4711.toml", ".building-4711"]
    go = [f".made.{token}.part", f".building-{token}", f".scratch-{token}", f".hunt.{token}.toml"]
    for name in stay:
        (tmp_path / name).touch()
    for name in go:
        (tmp_path / name).mkdir()
    remove_ended(tmp_path)
    assert everything(tmp_path) == {"temporary files", *stay}


def test_a_kernel_without_time_namespaces_has_owners_too(tmp_path, monkeypatch):
    before = this_process()
    (tmp_path / "pid").symlink_to(os.readlink("/proc/self/ns/pid"))  # noqa: PTH115 - it is no path
    with monkeypatch.context() as patched, fresh():
        patched.setattr(process_owners, "_NAMESPACE_FOLDER", str(tmp_path))
        here = this_process()
        assert (here.pid, here.started, here.boot) == (before.pid, before.started, before.boot)
        assert here.namespace not in (before.namespace, "0" * 8)
        assert has_ended(OwnerProcess(here.pid, here.started - 1, here.boot, here.namespace))
    assert this_process() == before


def test_a_zombie_has_ended():
    pid = os.fork()
    if pid == 0:
        os._exit(0)
    os.waitid(os.P_PID, pid, os.WEXITED | os.WNOWAIT)
    try:
        assert start_time(pid) == 0
        assert has_ended(OwnerProcess(pid, 5, this_process().boot, this_process().namespace))
    finally:
        os.waitpid(pid, 0)
    assert start_time(pid) == 0
    assert start_time(os.getpid()) == this_process().started > 0
    assert not has_ended(this_process())


def test_a_process_whose_first_thread_has_ended_is_alive():
    code = (
        "import ctypes, os, threading, time\n"
        "def say():\n"
        "    while open('/proc/self/stat').read().rpartition(')')[2].split()[0] != 'Z': time.sleep(0.005)\n"
        "    os.write(1, b'x'); os.read(0, 1); os._exit(0)\n"
        "threading.Thread(target=say).start()\n"
        "ctypes.CDLL(None).pthread_exit(None)\n"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout.read(1) == b"x"
        assert start_time(process.pid) > 0
        process.communicate(b"x")


def test_a_fork_removes_nothing_of_its_parent(place, tmp_path):
    with temporary_folder("replay") as folder:
        beside = begun(tmp_path / "made")
        beside.touch()

        def leaves():
            with temporary_folder("replay") as mine:
                assert mine.parent.name == this_process().token
            KEPT[-1].__exit__(None, None, None)
            weakref.finalize._exitfunc()  # which Python calls at its end

        kept = TemporaryFolder("environment")
        assert in_child(leaves) == 0
        assert kept.path.is_dir()
        kept.remove()
        assert beside.exists()
        KEPT.pop().__exit__(None, None, None)
        assert not beside.exists()
        assert folder.is_dir()
        assert [path.name for path in place.iterdir()] == [this_process().token]


def test_several_threads_share_the_folder(place):
    errors = []

    def use():
        try:
            for number in range(40):
                with temporary_folder("replay") as folder, whole_file(folder / f"{number}", lasting=False) as file:
                    file.touch()
        except BaseException as error:
            errors.append(error)

    threads = [threading.Thread(target=use) for _ in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not errors
    assert not place.exists()


def test_several_processes_make_and_remove_the_same_parent(place):
    def use():
        for _ in range(50):
            with temporary_folder("replay") as folder:
                assert folder.is_dir()
            remove_leftovers()

    pids = []
    for _ in range(4):
        pids.append(os.fork())
        if not pids[-1]:
            code = 99
            with suppress(BaseException):
                use()
                code = 0
            os._exit(code)
    assert [os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) for pid in pids] == [0] * 4
    assert not place.exists()


def test_a_folder_that_the_system_cleared_is_made_again(place):
    with temporary_folder("replay"):
        remove_tree(place)
        with temporary_folder("judge") as folder:
            assert folder.is_dir()
    assert not place.exists()


def test_a_full_disk_for_temporary_files_keeps_no_file_from_being_written(tmp_path, monkeypatch):
    def full(*_, **__):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def fails(*, noted):
        with whole_file(tmp_path / "other", noted=noted) as file:
            file.write_text("x")
            raise KeyError

    for noted in (True, False):
        with pytest.raises(KeyError):
            fails(noted=noted)
    assert everything(tmp_path) == {"temporary files"}
    monkeypatch.setattr(temporary.Path, "mkdir", full)
    with whole_file(tmp_path / "report.html") as file:
        file.write_text("x")
    assert (tmp_path / "report.html").read_text() == "x"
    with pytest.raises(OSError, match="No space left"), temporary_folder("replay"):
        pass


def test_what_cannot_be_removed_yet_is_tried_again(place, tmp_path, monkeypatch):
    def leaves():
        monkeypatch.setattr(temporary, "remove_scratch", lambda path: None)
        with temporary_beside(tmp_path / "made") as beside:
            beside.mkdir()

    assert in_child(leaves) == 0
    assert len([*tmp_path.glob(".made.*")]) == 1
    remove_leftovers()
    assert everything(tmp_path) == {"temporary files"}


def test_permissions_are_no_obstacle(tmp_path):
    (tmp_path / "a" / "b" / "c").mkdir(parents=True)
    (tmp_path / "a" / "b" / "c" / "file").touch()
    for path in ("a/b/c", "a/b", "a"):
        (tmp_path / path).chmod(0)

    def removes():
        os.chdir(tmp_path)
        if os.getuid() == 0:  # whom permissions do not keep out
            for path in (tmp_path, *tmp_path.rglob("*")):
                os.chown(path, 65534, 65534)
            os.setuid(65534)
        remove_tree(Path("a"))

    assert in_child(removes) == 0
    assert everything(tmp_path) == {"temporary files"}
    remove_tree(tmp_path / "a")


def test_a_folder_is_put_in_the_place_of_another(tmp_path):
    for name in ("old", "new"):
        (tmp_path / name).mkdir()
        (tmp_path / name / name).touch()
    assert exchange(tmp_path / "old", tmp_path / "new")
    assert (tmp_path / "old" / "new").exists()
    assert not exchange(tmp_path / "old", tmp_path / "gone")
    put_in_place(tmp_path / "new", tmp_path / "old")
    assert (tmp_path / "old" / "old").exists()
    put_in_place(tmp_path / "old", tmp_path / "third")
    assert (tmp_path / "third" / "old").exists()
    remove_at_once(tmp_path / "third")
    remove_at_once(tmp_path / "third")
    assert everything(tmp_path) == {"temporary files", "new", "new/new"}


def test_where_folders_cannot_be_exchanged_the_old_one_goes_first(tmp_path, monkeypatch):
    monkeypatch.setattr("crashhunt.base.files.exchange", lambda *_: False)
    (tmp_path / "old" / "x").mkdir(parents=True)
    (tmp_path / "new").mkdir()
    put_in_place(tmp_path / "new", tmp_path / "old")
    assert everything(tmp_path) == {"temporary files", "old"}


def test_a_name_that_is_the_longest_leaves_room_for_the_owner(tmp_path):
    for stem in ("x" * 251, "東" * 82):
        target = tmp_path / f"{stem}.csv"
        with whole_file(target) as file:
            assert file.suffix == ".csv"
            assert owner_in(file.name) == this_process()
            file.write_text("x")
        target.unlink()


def created(scratch: Path) -> shared_memory.SharedMemory:
    segments.record_shared_memory(scratch)
    found = shared_memory.SharedMemory(create=True, size=8)
    found.close()
    return found


def test_shared_memory_of_a_trial_goes_and_that_of_others_stays(tmp_path):
    scratch = tmp_path / "confirmations" / "shared-0"
    scratch.mkdir(parents=True)
    theirs = shared_memory.SharedMemory(create=True, size=8)
    names = tmp_path / "names"

    def creates():
        mine = created(scratch)
        shared_memory.SharedMemory(theirs.name).close()  # which attaches
        again = shared_memory.SharedMemory(create=True, size=8)
        again.close()
        Path("/dev/shm", again.name).unlink()
        subprocess.run(["touch", f"/dev/shm/{again.name}"], check=True)  # another program has taken the name
        names.write_text(f"{mine.name} {again.name}")
        die()

    try:
        with alive(lambda: created(scratch)):
            segments.release_shared_memory(scratch, of_ended=True)
            (record,) = scratch.iterdir()
            living = record.read_text().split()[-1]
            assert Path("/dev/shm", living).exists()
            assert in_child(creates) == -signal.SIGKILL
            mine, taken = names.read_text().split()
            segments.release_shared_memory(scratch, of_ended=True)
            assert [Path("/dev/shm", name).exists() for name in (mine, taken, theirs.name, living)] == [
                False, True, True, True
            ]  # fmt: skip
        remove_scratch(tmp_path)  # the folder of a hunt that has those of confirmations inside
        assert not Path("/dev/shm", living).exists()
        assert Path("/dev/shm", theirs.name).exists()
        Path("/dev/shm", taken).unlink()
    finally:
        theirs.close()
        theirs.unlink()


def in_trial(scratch, act):
    """Return the exit code of a process that acts as a trial does."""

    def run():
        segments.record_shared_memory(scratch)
        segments.begin_records()
        act()
        segments.end_records()
        os._exit(0)

    return in_child(run)


@pytest.fixture
def name():
    """The beginning of names in /dev/shm; what is left of them is removed."""
    found = f"crashhunt-test-{os.getpid()}-{uuid.uuid4().hex}"
    yield found
    for path in Path("/dev/shm").glob(f"{found}*"):
        shutil.rmtree(path) if path.is_dir() else path.unlink()


def left(name):
    return sorted(path.name.removeprefix(name) for path in Path("/dev/shm").glob(f"{name}*"))


def test_files_that_a_trial_opened_in_shared_memory_go(tmp_path, name):
    Path(f"/dev/shm/{name}-theirs").write_text("x")

    def act():
        Path(f"/dev/shm/{name}-opened").write_text("x")
        os.close(os.open(f"/dev/shm/{name}-made".encode(), os.O_CREAT | os.O_WRONLY))
        Path(f"/dev/shm/{name}-folder").mkdir()
        Path(f"/dev/shm/{name}-folder/part").touch()
        Path(f"/dev/shm/{name}-theirs").write_text("y")
        in_child(lambda: Path(f"/dev/shm/{name}-fork").write_text("x") and os._exit(0))
        segments.release_shared_memory(tmp_path, of_ended=True)
        assert "-fork" in left(name)  # the trial may read what its worker has written

    assert in_trial(tmp_path, act) == 0
    assert left(name) == ["-folder", "-fork", "-made", "-opened", "-theirs"]
    segments.release_shared_memory(tmp_path, of_ended=True)
    assert left(name) == ["-theirs"]


def test_later_file_with_the_name_of_a_trials_file_stays(tmp_path, name):
    path = Path(f"/dev/shm/{name}")
    record = tmp_path / f"shared-memory-{ended().token}.txt"
    for time_ns, stays in ((time.time_ns() + 10**10, True), (time.time_ns() - 10**10, False)):
        path.touch()
        record.write_text(f"opened {time_ns} {name}\n")
        segments.release_shared_memory(tmp_path)
        assert path.exists() == stays


SHM_OPEN = """
import ctypes, mmap, os, sys
kept = []
for name in sys.argv[1:]:
    kept.append(ctypes.CDLL(None).shm_open(name.encode(), os.O_RDWR | os.O_CREAT, 0o600))
print("there", flush=True)
sys.stdin.read()
"""


def test_shared_memory_of_programs_that_a_trial_started_goes_and_that_of_others_stays(tmp_path, name, monkeypatch):
    def start(*names):
        program = subprocess.Popen([sys.executable, "-c", SHM_OPEN, *names], stdin=subprocess.PIPE,
                                   stdout=subprocess.PIPE, text=True)  # fmt: skip
        programs.append(program)
        assert program.stdout.readline() == "there\n"
        return program

    programs = []
    try:
        start(f"/{name}-before")
        watch = segments.SharedMemoryWatch()
        ours = start(f"/{name}-before", f"/{name}-ours", f"/{name}-both")
        other = start(f"/{name}-theirs", f"/{name}-both")
        below = [program.pid for program in programs if program is not other]
        monkeypatch.setattr(segments, "descendants_of", lambda pid: below if pid == os.getpid() else [])
        watch.look()
        ours.kill()
        ours.wait()
        watch.remove()
        assert left(name) == ["-before", "-both", "-theirs"]
    finally:
        for program in programs:
            program.kill()
            program.communicate()


@pytest.mark.parametrize(("writes", "remaining"), [(True, []), (False, [""])])
def test_shared_memory_that_a_trial_has_mapped_at_its_end_goes_if_it_is_written(tmp_path, name, writes, remaining):
    def act():
        subprocess.run(["truncate", "-s", "4096", f"/dev/shm/{name}"], check=True)  # C code creates it
        flags, access = (os.O_RDWR, mmap.ACCESS_WRITE) if writes else (os.O_RDONLY, mmap.ACCESS_READ)
        file = os.open(f"/dev/shm/{name}", flags)
        kept.append(mmap.mmap(file, 4096, access=access))
        os.close(file)

    kept = []
    assert in_trial(tmp_path, act) == 0
    segments.release_shared_memory(tmp_path)
    assert left(name) == remaining


def test_file_in_a_folder_of_shared_memory_is_no_segment_of_a_trial(tmp_path, name):
    """The black box lies in such a folder where TMPDIR is in memory, and a look at all processes takes 15 ms."""

    def act():
        folder.mkdir()
        with (folder / "box").open("w+b") as file:
            file.truncate(4096)
            kept.append(mmap.mmap(file.fileno(), 4096))

    kept, folder = [], Path("/dev/shm", name)
    try:
        assert in_trial(tmp_path, act) == 0
        assert not any("used" in record.read_text() for record in tmp_path.glob("shared-memory-*.txt"))
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def test_a_record_that_an_agent_forged_removes_no_file_elsewhere(tmp_path):
    file = tmp_path / "thesis.tex"
    file.touch()
    found = file.lstat()
    record = tmp_path / f"shared-memory-{ended().token}.txt"
    lines = [f"{found.st_dev} {found.st_ino} ../..{file}", "x y z", "1 2", f"{found.st_dev} {found.st_ino} .", "\xff",
             f"opened 0 ../..{file}", f"used {found.st_ino} ../..{file}", "opened x y"]  # fmt: skip
    record.write_bytes("\n".join(lines).encode("latin-1"))
    segments.release_shared_memory(tmp_path)
    assert file.exists()
    assert not record.exists()


def test_owners_are_read_from_names():
    here = this_process()
    assert owner_in(here.token) == here
    assert owner_in(f".x-1.{here.token}.part") == here
    other = OwnerProcess(1, 2, "a" * 12, "b" * 8)
    for name in (
        "",
        "1-2-3-4",
        "12345678901-2-aaaaaaaaaaaa-bbbbbbbb",
        f"{here.token}f",
        f"{here.token}.{other.token}",
        "1-2-aaaaaaaaaaaa-bbbbbbb",
    ):
        assert owner_in(name) is None, name


def test_new_folder_appears_when_it_is_complete(tmp_path):
    place = tmp_path / "place"
    place.mkdir()
    with new_folder(place / "made", mode=0o700) as building:
        (building / "file").touch()
        assert not (place / "made").exists()
    assert [path.name for path in place.iterdir()] == ["made"]
    assert (place / "made" / "file").exists()
    assert (place / "made").stat().st_mode & 0o777 == 0o700
    with pytest.raises(FileExistsError, match="another process has written there"), new_folder(place / "b"):
        (place / "b" / "of another process").mkdir(parents=True)
    with pytest.raises(ZeroDivisionError), new_folder(place / "c"):
        raise ZeroDivisionError
    assert sorted(path.name for path in place.iterdir()) == ["b", "made"]


def test_existing_folder_stays_itself_and_receives_the_contents(tmp_path, monkeypatch):
    place = tmp_path / "place"
    place.mkdir()
    monkeypatch.chdir(place)  # a user's shell would be left in a removed folder
    before = place.stat().st_ino
    with new_folder(Path()) as building:
        assert building.parent == place
        (building / "folder").mkdir()
        (building / "folder" / "file").touch()
        (place / f"{building.name[:-6]}0.part").mkdir()  # another process begins to write there
        assert not (place / "folder").exists()
    assert (place / "folder" / "file").exists()
    assert not building.exists()
    assert Path.cwd().stat().st_ino == before
    with pytest.raises(FileExistsError, match="another process has written there"), new_folder(Path()) as building:
        (building / "folder").touch()
    assert (place / "folder").is_dir()


def test_owner_of_records_is_known_before_a_fork_that_may_outlive_it(monkeypatch):
    with monkeypatch.context() as patched, fresh():
        patched.setattr(segments, "_recording_process", [os.getpid()])
        segments._know_owner()
        patched.setattr(process_owners, "start_time", lambda _: 0)  # the process of the trial has ended
        assert process_owners.owner_of(os.getpid()).started > 0


def test_folder_that_is_lost_while_another_is_made_is_removed():
    """The garbage collector may find it anywhere, also inside of the function that makes the other one."""
    lost, made = TemporaryFolder("lost"), []

    def make_another(folder):
        lost.remove()
        made.append(folder / "another")
        made[0].mkdir()
        return made[0]

    thread = threading.Thread(target=lambda: temporary._things.make(make_another), daemon=True)
    thread.start()
    thread.join(60)
    assert not thread.is_alive()
    assert (made[0].is_dir(), lost.path.exists()) == (True, False)
    temporary._things.end(made[0])
    assert not made[0].parent.exists()
