"""Crashes that are kept in a repository, and run again with today's code."""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from conftest import wait_for

from crashhunt.corpus import add_case, find_cases, run_cases
from crashhunt.crashes import find_bundle
from crashhunt.errors import BundleError, HuntDirectoryError

DRIVER = """
class Driver:
    def __init__(self, speed: float = 12.0):
        self.speed = speed

    def reset(self, seed):
        pass

    def act(self, observation):
        return (self.speed, 0)
"""
MENDED = DRIVER.replace("(self.speed, 0)", "(min(self.speed, 3.0), 0)")
BROKEN = DRIVER.replace("return", "raise ValueError('no') or")
FROZEN = Path(__file__).parent / "frozen" / "case"


def hunted(shell):
    (shell.folder / "driver.py").write_text(DRIVER)
    words = ("--scenario", "toy", "--agent", "driver:Driver", "--arg", "speed=20:22", "--seed", "1", "--keep-going")
    shell.crashhunt("run", "h", "1", "2", "99", *words)
    for number, note in (("0", "too fast"), ("1", "ä \x1b[2J\n|")):
        path = next((shell.folder / "h" / "crashes").glob(f"00000{number}-*"))
        shell.crashhunt("corpus", "add", str(path), "--to", "kept crashes", "--note", note)


@pytest.fixture
def kept(toy, made_once, monkeypatch):
    """A folder with a hunt of two crashes, both of which are in a corpus, and the agent's code."""
    made_once(hunted, toy)
    monkeypatch.chdir(toy.folder)
    return toy


def drive(shell, code):
    (shell.folder / "driver.py").write_text(code)


def test_a_case_is_small_has_no_code_and_is_looked_at_like_a_hunt(kept):
    cases = kept.crashhunt("corpus", "list", "kept crashes", "--json").json["cases"]
    assert [case["expected"] for case in cases] == ["still", "still"]
    assert cases[0]["note"] == "too fast"
    assert all(case["bytes"] < 40_000 and case["log"] for case in cases)
    listed = kept.crashhunt("corpus", "list", "kept crashes").out
    assert "drove into leader" in listed
    assert "\x1b" not in listed
    case = Path(cases[0]["path"])
    assert not [file for file in (kept.folder / case).rglob("*") if file.suffix == ".py"]
    for command in ("show", "replay", "check"):
        kept.crashhunt(command, str(case))
    for file in (kept.folder / case).rglob("*.json"):
        assert str(kept.folder) not in file.read_text()


def test_todays_code_is_judged(kept):
    found = kept.crashhunt("corpus", "run", "kept crashes", "--keep", "out", "--json").json["cases"]
    assert [(case["got"], case["ok"]) for case in found] == [("still", True)] * 2
    assert kept.crashhunt("replay", found[0]["kept"], "--json").json["verdict"] == "reproduced"
    drive(kept, MENDED)
    done = kept.crashhunt("corpus", "run", "kept crashes")
    assert done.out.count("to be warned if it crashes again") == 2


def test_what_is_damaged_or_no_case_is_reported_and_does_not_keep_the_others(kept):
    first, second = find_cases([kept.folder / "kept crashes"])
    (next(first.glob("snapshots/*")) / "scenario" / "scenario.toml").write_text("schema = 1")
    (report, other) = run_cases([first, second], parallel=2)
    assert (report.got, other.got) == ("cannot_run", "still")
    assert "has changed; restore the case from the repository" in report.now  # there is no --force, as of a replay
    case = second / "crashhunt-case.toml"
    case.write_text("expect = 'maybe'")
    (report,) = run_cases([second])
    assert (report.got, report.ok) == ("cannot_run", False)
    assert "maybe" in report.now
    with pytest.raises(BundleError, match="no case of a corpus"):
        find_cases([kept.folder / "h"])
    assert "did you mean 'kept crashes'" in kept.crashhunt("corpus", "run", "kept crashs", expect=2).err


def test_a_full_disk_leaves_nothing_half_done(kept, monkeypatch):
    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("crashhunt.corpus._cases.write_log", full)
    with pytest.raises(HuntDirectoryError, match="No space left") as raised:
        add_case(find_bundle(kept.folder / "h", "0"), kept.folder / "full")
    assert "free some space" in raised.value.fix
    assert list((kept.folder / "full").iterdir()) == []


def test_two_add_the_same_at_once(kept, monkeypatch):
    from crashhunt.corpus import _cases

    build, corpus = _cases._build, kept.folder / "both"

    def overtaken(bundle, case, folder):
        build(bundle, case, folder)
        if not corpus.joinpath(case.name).exists():
            shutil.copytree(folder, corpus / case.name)

    monkeypatch.setattr(_cases, "_build", overtaken)
    assert not add_case(find_bundle(kept.folder / "h", "0"), corpus).new
    assert [path.name for path in corpus.iterdir()] == [path.name for path in find_cases([corpus])]


def test_ctrl_c_ends_all_and_reports_what_has_ended(kept):
    begun = kept.folder / "begun"
    drive(kept, DRIVER.replace("return", f"import time; open({str(begun)!r}, 'w'); time.sleep(60); return"))
    running = kept.begin("corpus", "run", "kept crashes", "--parallel", "1")
    wait_for(begun.exists)
    running.send_signal(signal.SIGINT)
    out, err = running.communicate(timeout=300)
    assert running.returncode == 130, err
    assert "2 cases: none has ended; interrupted after 0" in out


def test_a_case_of_an_earlier_version_is_run(shell):
    (report,) = run_cases([FROZEN], trusted=True)  # also where the tests lie outside their repository
    assert (report.got, report.ok, report.now) == ("still", True, report.was)


def test_pytests_start_imports_the_thin_module_only():
    code = (
        "import sys; import pytest; before = set(sys.modules); import crashhunt.corpus.pytest_plugin; "
        "print(*sorted(set(sys.modules) - before))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    ours = {name for name in done.stdout.split() if name.startswith("crashhunt")}
    assert ours == {
        "crashhunt", "crashhunt.base", "crashhunt.base.doors", "crashhunt.base.version", "crashhunt.corpus",
        "crashhunt.corpus.pytest_plugin",
    }  # fmt: skip
    assert {"numpy", "libsumo", "gymnasium", "pydantic"}.isdisjoint(done.stdout.split())


def test_the_plugin_is_registered():
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())
    assert project["project"]["entry-points"]["pytest11"] == {"crashhunt": "crashhunt.corpus.pytest_plugin"}
