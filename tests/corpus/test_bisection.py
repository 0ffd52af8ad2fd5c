"""Which commit introduced a crash, with real commits and a case that is judged by a file, in process."""

from __future__ import annotations

import json
import subprocess
from types import SimpleNamespace

import pytest

from crashhunt.base.errors import CrashhuntError, UsageError
from crashhunt.corpus import Bisected, _bisection as _bisect


def git(folder, *words, **options):
    done = subprocess.run(["git", *words], cwd=folder, check=True, capture_output=True, text=True, **options)
    return done.stdout.strip()


def history(branch, statuses, parent=""):
    """Return commands for git's fast-import: on a branch, a commit for each status of the crash."""
    for number, status in enumerate(statuses):
        mark = "" if parent else f"mark :{number + 1}\n"
        yield f"commit refs/heads/{branch}\n{mark}committer a <a@b> {number} +0000\n"
        yield f"data <<END\nchange {number}\nEND\n"
        if parent and not number:
            yield f"from {parent}\n"
        for file, text in (("agents/status", status), ("number", str(number))):
            yield f"M 100644 inline {file}\ndata {len(text)}\n{text}\n"


@pytest.fixture
def repository(tmp_path, monkeypatch):
    """Returns a function that makes a repository with a commit for each status of the crash, and bisects it."""
    top = tmp_path / "project"
    (top / "agents").mkdir(parents=True)
    git(top, "init", "-q", "-b", "main")
    texts = {"ego.policy": [str(tmp_path / "policy.zip"), "status"]}
    (tmp_path / "policy.zip").touch()
    runs, settings = [], {"ego": "agents.driver:Driver", "second": "crashhunt.agents:KeepLaneWithSpeed"}

    def run(case, folder, tree, modules):
        runs.append((case, folder.relative_to(tree), modules))
        return (folder / "status").read_text(), ""

    def add_case(bundle, corpus):
        assert bundle.hunt == tmp_path / "hunt"
        return SimpleNamespace(case=SimpleNamespace(path=corpus / "case"))

    def read_settings(path):
        assert path == tmp_path / "hunt" / "hunt.toml"
        agents = {name: SimpleNamespace(agent=word) for name, word in settings.items()}
        return SimpleNamespace(agents=agents, texts=texts)

    monkeypatch.setattr(_bisect, "_run", run)
    monkeypatch.setattr(_bisect, "add_case", add_case)
    monkeypatch.setattr(_bisect, "read_settings", read_settings)

    def bisect(*statuses, good="", mended=(), **options):
        stream = [*history("main", statuses), *history("mended", mended, f":{len(statuses) - 1}")]
        git(top, "fast-import", "--quiet", input="".join(stream))
        (top / "agents" / "status").write_text("not committed")
        commits = git(top, "log", "--format=%H", "--reverse", "main").split()
        bundle = SimpleNamespace(hunt=tmp_path / "hunt")
        found = _bisect.bisect(bundle, good or commits[0], folder=top / "agents", **options)
        assert (top / "agents" / "status").read_text() == "not committed"
        return found, commits, runs

    return bisect


@pytest.mark.parametrize("first", [pytest.param(1, marks=pytest.mark.nightly), 3])
def test_first_commit_with_the_crash_is_found(repository, first):
    seen = []
    found, commits, runs = repository(
        *["fixed"] * first, *["still"] * (4 - first), watch=lambda revision, got, why: seen.append((revision, got))
    )
    assert (found.commit, found.subject, found.candidates) == (commits[first], f"change {first}", ())
    assert [revision for revision, _ in seen[:2]] == [commits[3], commits[0]]
    assert found.tried == dict(seen)
    assert len(seen) == len(runs) == len(found.tried) <= 4  # each revision runs once
    assert all(got == ("still" if commits.index(revision) >= first else "fixed") for revision, got in seen)
    (case,) = {case for case, _, _ in runs}
    assert (case.name, case.is_absolute()) == ("case", True)
    assert {(str(folder), *modules) for _, folder, modules in runs} == {("agents", "agents.driver")}


def test_revisions_without_a_clear_status_leave_candidates(repository):
    found, commits, _ = repository("fixed", "changed", "cannot_run", "still")
    assert (found.commit, found.subject) == (None, "")
    assert {*found.candidates} == {*commits[1:]}
    assert Bisected.from_json(json.loads(json.dumps(found.to_json()))) == found


@pytest.mark.parametrize(
    ("statuses", "good", "message"),
    [
        pytest.param(
            ("fixed", "cannot_run"), "", "--bad HEAD: there, the crash is cannot run, and not still",
            marks=pytest.mark.nightly,
        ),
        (("still", "still"), "main~1", "--good main~1: there, the crash is still, and not fixed"),
    ],
)  # fmt: skip
def test_ends_without_the_expected_status_are_refused(repository, statuses, good, message):
    with pytest.raises(UsageError) as caught:
        repository(*statuses, good=good)
    assert str(caught.value) == f"{message}; give another revision"


def test_each_revision_is_built_and_one_that_cannot_be_built_is_skipped(repository):
    command = "test ! -e made && ! grep broken status && cp status made && echo changed > status && cp made status"
    seen = []
    found, commits, runs = repository(
        "fixed", "broken", "still", build=command, watch=lambda *words: seen.append(words), tell=seen.append
    )
    assert (found.commit, {*found.candidates}) == (None, {*commits[1:]})
    assert len(runs) == 2  # nothing ran without its build
    assert found.tried[commits[1]] == "cannot_run"
    assert "every revision uses the same file: " in seen[0]
    assert "policy.zip (ego.policy)" in seen[0]
    assert [got for _, got, _ in seen[1:]] == ["still", "fixed", "cannot_run"]
    assert seen[3][2].startswith(f"{commits[1][:12]}: --build 'test ! -e made ")
    assert [why for *_, why in seen[1:3]] == ["", ""]


def test_end_that_cannot_be_built_is_refused_with_the_output_of_the_build(repository):
    with pytest.raises(
        UsageError, match=r"--bad HEAD cannot run: \w+: --build 'echo no & .*' exited with 7: no; "
    ) as caught:
        repository("fixed", "still", build="echo no & wait; exit 7")
    assert caught.value.fix == "give another revision"


def test_good_revision_on_another_branch_names_the_common_ancestor(repository, tmp_path):
    with pytest.raises(UsageError) as caught:
        repository("still", "still", mended=("fixed",), good="mended", bad="main")
    ancestor = git(tmp_path / "project", "rev-parse", "main~1")
    assert str(caught.value) == (
        f"--good mended is not before --bad main: their common ancestor {ancestor[:12]} already has the crash; "
        "give a --good revision before that ancestor"
    )
    assert len(git(tmp_path / "project", "worktree", "list").splitlines()) == 1


@pytest.fixture
def judge(monkeypatch, tmp_path):
    """Runs a case with a process that prints what is given; returns its status and the commands."""

    def judge_it(printed, origin="agents/driver.py", code=0):
        (tmp_path / "agents").mkdir(exist_ok=True)
        ran = []

        def run_to_end(command, folder, environment):
            ran.append((command[1:], folder, environment))
            is_import = command[2] == "-c"
            place = tmp_path / origin if not origin.startswith("/") else origin
            return SimpleNamespace(
                returncode=code if is_import else 1, stdout=f"{place}\n" if is_import else printed,
                stderr=f"Traceback\n{'x' * 400}\n",
            )  # fmt: skip

        monkeypatch.setattr(_bisect, "run_to_end", run_to_end)
        monkeypatch.setattr(_bisect, "import_environment", lambda folder, tree: {"PATHS": f"{folder} {tree}"})
        got, why = _bisect._run(tmp_path / "case", tmp_path / "agents", tmp_path, {"z", "agents.driver"})
        assert why == (f"'agents.driver' cannot be imported: {'x' * 400}" if got == "cannot_run" else "")
        return got, ran

    return judge_it


def test_case_runs_with_the_code_of_the_work_tree(judge, tmp_path):
    got, ran = judge('{"cases": [{"got": "fixed"}]}')
    assert got == "fixed"
    assert [command[-1] for command, _, _ in ran] == ["agents.driver", "z", "--json"]
    assert ran[2][0] == ["-P", "-m", "crashhunt", "corpus", "run", str(tmp_path / "case"), "--json"]
    assert {folder for _, folder, _ in ran} == {tmp_path / "agents"}
    assert {environment["PATHS"] for _, _, environment in ran} == {f"{tmp_path / 'agents'} {tmp_path}"}
    assert judge("", code=1)[0] == "cannot_run"  # a revision without the module
    with pytest.raises(UsageError, match=r"'agents.driver' is imported from /usr/x.py, independent of the revision"):
        judge("", origin="/usr/x.py")


@pytest.mark.parametrize("printed", ["", "{}", '{"cases": []}', "Traceback"])
def test_case_without_a_report_is_an_error(judge, printed):
    with pytest.raises(CrashhuntError) as caught:
        judge(printed)
    assert caught.value.message == f"the corpus case could not be run: {'x' * 300}"
