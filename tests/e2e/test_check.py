"""What lies on disk is what was written: damage is told in one line, and nobody is shown anything else."""

from __future__ import annotations

import contextlib
import io
import json
import os
import py_compile
import random
import shutil
import sqlite3
import traceback
from contextlib import closing
from pathlib import Path

import pytest

import crashhunt
from crashhunt.base.integrity import digest_of_data
from crashhunt.cli import main
from crashhunt.errors import HuntDirectoryError

HUNT = ("1", "5", "99", "--scenario", "toy", "--arg", "speed=11:14", "--set", "gap_m=20:30", "--seed", "4")


def hunted(shell):
    shell.environment["XDG_STATE_HOME"] = str(shell.folder / "state")
    shell.crashhunt("run", "h", *HUNT, "--keep-going", "--keep-trials", "--keep", "2")


@pytest.fixture
def hunt(toy, made_once, monkeypatch):
    """A hunt that has crashes, in the folder where this process is too."""
    made_once(hunted, toy)
    monkeypatch.chdir(toy.folder)
    monkeypatch.setenv("XDG_STATE_HOME", str(toy.folder / "state"))
    return toy.folder / "h"


@pytest.fixture
def crash(hunt):
    """The first of its crashes."""
    return min((hunt / "crashes").iterdir())


def edited(path, change, *, schema: int = 2):
    """Change a crash.json; as one of schema 1, which had no digest, or as one of today."""
    data = json.loads(path.read_text())
    change(data)
    if schema == 1:
        data["schema"] = 1
        del data["integrity"], data["files"]
    path.write_text(json.dumps(data))


def command(*words: object) -> tuple[int, str, str]:
    """Run a command in this process: exit code, or -1 for a traceback; standard output; standard error."""
    out, err, code = io.StringIO(), io.StringIO(), 0
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            main([str(word) for word in words])
        except SystemExit as ended:
            code = ended.code or 0
        except BaseException:
            traceback.print_exc(file=err)
            code = -1
    return code, out.getvalue(), err.getvalue()


JUNK = (None, True, -1, 0, 10**30, 1e308, "", "x", "../../etc", "\ud800\x1b[2J", [], [[]], {}, {"x": 1})


@pytest.mark.parametrize(("seed", "times"), [(5, 12), pytest.param(6, 60, marks=pytest.mark.nightly)])
def test_any_value_in_a_crash_json_is_at_most_one_line(tmp_path, seed, times):
    generator = random.Random(seed)
    crash = Path(shutil.copytree(Path(__file__).parent / "frozen" / "version-1" / "hunt", tmp_path / "h"), "crashes",
                 "000000-collision")  # fmt: skip
    before = (crash / "crash.json").read_text()
    for _ in range(times):
        data = json.loads(before)
        del data["integrity"]
        here, path = data, []
        while True:
            path.append(generator.choice(list(here) if isinstance(here, dict) else range(len(here))))
            if not isinstance(here[path[-1]], dict | list) or not here[path[-1]] or generator.random() < 0.3:
                break
            here = here[path[-1]]
        here[path[-1]] = generator.choice(JUNK)
        (crash / "crash.json").write_text(json.dumps({**data, "integrity": digest_of_data(data)}))
        for words in (("show", crash), ("check", crash, "--json")):
            code, _, err = command(*words)
            assert code in (0, 1, 2), (path, here[path[-1]], words, err)
            assert "this should not happen" not in err, (path, here[path[-1]], err)
            assert len([line for line in err.splitlines() if line.startswith("crashhunt:")]) <= 1, (path, err)


def test_a_crash_json_that_was_edited_is_refused(hunt, crash):
    file = crash / "crash.json"
    before = file.read_text()
    for change, says in (
        (lambda data: data["collision"].update(role="victim"), "the file has changed since it was written"),
        (lambda data: data.update(seed=data["seed"] + 1), "the file has changed since it was written"),
        (lambda data: data.pop("integrity"), "older than format version 1"),
        (lambda data: data.update(schema=99), "schema version 99"),
    ):
        edited(file, change)
        for words in (("show", crash), ("replay", crash), ("export", crash, "x.zip"), ("report", "h")):
            code, _, err = command(*words)
            assert code == 2, words
            assert says in err
            assert "crash.json" in err
        file.write_text(before)


def test_a_log_belongs_to_its_crash(hunt, crash):
    other = max((hunt / "crashes").iterdir())
    shutil.copy(other / "log.mcap", crash / "log.mcap")
    for words in (("show", crash), ("replay", crash), ("report", "h")):
        code, _, err = command(*words)
        assert (code, "log.mcap" in err) == (2, True), words
    assert command("show", other)[0] == 0
    assert command("show", "h", "--crash", other.name)[0] == 0  # one that is damaged is in nobody's way


def test_a_log_of_text_that_was_edited_states_so(hunt, crash):
    (crash / "run.log").write_text("all is well\n")
    number = str(int(crash.name[:6]))
    assert "run, which has changed since it was written <==" in command("logs", "h", "--trial", number)[1]


def test_a_snapshot_that_has_more_or_other_files_is_refused(hunt, crash):
    (snapshot,) = (hunt / "snapshots").iterdir()
    code = snapshot / "code"
    evil = hunt.parent / "evil.py"
    evil.write_text(f"open({str(hunt.parent / 'ran')!r}, 'a').write('x')\n")
    for name in (
        "sitecustomize.py",
        "numpy.pyc",
        "crashhunt/agents/toy.so",
        "x.pth",
        "scenario.cpython-311-x86_64-linux-gnu.so",
    ):
        (code / name).write_bytes(b"")
        if name.endswith(".pyc"):
            py_compile.compile(str(evil), cfile=str(code / name))
        assert f"code/{name} was not there" in command("replay", crash)[2]
        (code / name).unlink()
    (code / "linked").symlink_to(hunt.parent)
    assert "code/linked was not there" in command("replay", crash)[2]
    (code / "linked").unlink()
    # What Python would take for the compiled form of what is there: removed, as it will be made again.
    source = code / "crashhunt" / "episode" / "_episode.py"
    stray = source.parent / "__pycache__" / "_episode.cpython-311.pyc"
    stray.parent.mkdir(exist_ok=True)
    times = source.stat()
    kept = source.read_bytes()
    source.write_bytes(evil.read_bytes().ljust(len(kept), b"#"))
    os.utime(source, (times.st_atime, times.st_mtime))
    py_compile.compile(
        str(source), cfile=str(stray.with_name(f"_episode.{__import__('sys').implementation.cache_tag}.pyc"))
    )
    source.write_bytes(kept)
    os.utime(source, (times.st_atime, times.st_mtime))
    report = crashhunt.replay(crash)
    assert report.verdict == "reproduced"
    assert not (hunt.parent / "ran").exists()
    assert not list(code.rglob("*.pyc"))
    for name in ("manifest.json", "environment.json", "hunt.toml"):
        before = (snapshot / name).read_text()
        (snapshot / name).write_text(before.replace("1", "2", 1))
        assert command("replay", crash)[0] == 2, name
        (snapshot / name).write_text(before)
    manifest = json.loads((snapshot / "manifest.json").read_text())
    for name in ("../../../evil.py", "/etc/passwd", "code/../../x"):
        told = {**manifest, "files": {**manifest["files"], name: {"size": 1, "blake2b": ""}}}
        del told["integrity"]
        (snapshot / "manifest.json").write_text(json.dumps({**told, "integrity": digest_of_data(told)}))
        assert "leads out of the snapshot" in command("export", crash, "x.zip")[2]


def test_a_snapshot_that_is_damaged_is_made_again(hunt, toy):
    (snapshot,) = (hunt / "snapshots").iterdir()
    (snapshot / "code" / "crashhunt" / "episode" / "_episode.py").write_text("")
    toy.crashhunt("run", "h", "1", "6", *HUNT[2:], "--keep-going", "--keep-trials", "--keep", "2")
    assert command("check", "h")[0] == 0


def test_check_states_what_is_lost_and_saves_the_rest(hunt, crash, toy):
    whole = command("check", "h", "--json")
    found = json.loads(whole[1])
    assert (whole[0], found["fine"], found["hunts"][0]["trials"]) == (0, True, 5)
    first, second, *_ = sorted((hunt / "crashes").iterdir())
    (first / "log.mcap").write_bytes(b"")
    (hunt / "crashes" / ".000099-hang.part").mkdir()
    with closing(sqlite3.connect(hunt / "ledger.sqlite")) as database, database:
        database.execute("UPDATE trials SET steps = 5 WHERE number = 3")
    code, out, _ = command("check", "h", "--json", "--salvage", "saved")
    assert code == 1
    found = json.loads(out)
    (state,) = found["hunts"]
    assert (state["damaged_trials"], state["damaged_crashes"]) == ([3], [first.name])
    assert {finding["lost"] for finding in state["findings"] if finding["damaged"]} == {
        "trials 3", f"the crash {first.name}"
    }  # fmt: skip
    assert any(".000099-hang.part" in finding["where"] for finding in state["findings"] if not finding["damaged"])
    assert found["salvaged"] == {"trials": 3, "crashes": len(list((hunt / "crashes").glob("[!.]*"))) - 1}
    assert not any(
        finding["damaged"] for finding in json.loads(command("check", "saved", "--json")[1])["hunts"][0]["findings"]
    )
    # The same hunt goes on there, and has in the end what it had.
    before = hunt.with_name("before")
    toy.crashhunt("run", "saved", *HUNT, "--keep-going", "--keep-trials", "--keep", "2")
    hunt.rename(before)
    columns = ("number", "outcome", "steps", "digest")
    trials = [
        {name: row[name] for name in columns} for row in json.loads(command("trials", "saved", "--format", "json")[1])
    ]
    assert [row["number"] for row in trials] == list(range(5))
    assert (hunt.with_name("saved") / "crashes" / first.name / "log.mcap").stat().st_size
    assert command("check", "saved")[0] == 0
    assert "the directory exists already" in command("check", "before", "--salvage", "saved")[2]
    assert second.name


def test_hunts_are_not_compared_where_one_has_a_damaged_ledger(hunt):
    with closing(sqlite3.connect(hunt / "ledger.sqlite")) as database, database:
        # In a column that compare itself does not read, of the trial that is read for the time at which it ended.
        database.execute("UPDATE trials SET snapshot = 'x' WHERE number = (SELECT max(number) FROM trials)")
    with pytest.raises(HuntDirectoryError, match="crashhunt check"):
        crashhunt.compare(hunt, hunt)
