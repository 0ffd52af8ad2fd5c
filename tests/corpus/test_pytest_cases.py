"""Cases of a corpus as tests of pytest, in this process, with cases that end as given."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from crashhunt.corpus import CaseReport


@pytest.fixture
def run(tmp_path, monkeypatch, capsys):
    """Runs pytest on a corpus in a folder with a space; returns its exit code, what it prints, and its JUnit file."""
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")
    monkeypatch.delenv("PYTEST_ADDOPTS", raising=False)
    monkeypatch.chdir(tmp_path)
    asked = []

    def run_them(*, place="kept crashes", words=(), **reports):
        def run_cases(paths, **options):
            asked.append((paths, options))
            (path,) = paths
            return [CaseReport(path=path, was="it hit", now="it hits", **reports[path.name])]

        monkeypatch.setattr("crashhunt.corpus.run_cases", run_cases)
        folder = (tmp_path / place).resolve()
        for name in reports:
            (folder / name).mkdir(parents=True)
            (folder / name / "crashhunt-case.toml").touch()
            (folder / name / "other.toml").touch()
        usual = (
            "-q",
            "-c",
            "/dev/null",
            "--rootdir",
            str(tmp_path),
            "-p",
            "no:cacheprovider",
            "-p",
            "no:faulthandler",
            "--color=no",
        )
        plugin = ("-p", "crashhunt.corpus.pytest_plugin", "--junit-xml", "junit.xml", "-rxP")
        code = pytest.main([*usual, *plugin, *words, str(folder)])
        suite = ET.parse(tmp_path / "junit.xml").getroot()[0]
        return code, capsys.readouterr().out, suite, asked

    return run_them


def test_each_case_passes_fails_or_is_expected_to_fail(run, tmp_path):
    code, out, suite, asked = run(
        a={"expected": "still", "got": "still", "note": "too fast"},
        b={"expected": "fixed", "got": "fixed"},
        c={"expected": "fixed", "got": "still"},
        d={"expected": "still", "got": "fixed"},
        e={"expected": "still", "got": "cannot_run"},
        f={"expected": "still", "got": "changed"},
    )
    assert code == 1
    assert [suite.attrib[key] for key in ("tests", "failures", "errors", "skipped")] == ["6", "3", "0", "1"]
    assert "it hits (too fast)" in out  # the reason of the expected failure
    properties = {
        case.attrib["name"]: {one.attrib["name"]: one.attrib["value"] for one in case.iter("property")}
        for case in suite.iter("testcase")
    }
    assert [*properties] == ["a", "b", "c", "d", "e", "f"]
    assert properties["d"] == {"crashhunt_expected": "still", "crashhunt_got": "fixed"}
    assert "c: still crashes, and fixed was expected\n" in out
    assert "crash c" in out  # its title
    for name, hinted in (("c", True), ("f", True), ("a", False), ("e", False)):
        hint = f"look at it: crashhunt corpus run 'kept crashes/{name}' --keep out && crashhunt show out/{name}"
        assert (hint in out) == hinted, name
    assert "e: cannot run, and still was expected\n" in out
    assert "crash d" in out.partition("PASSES")[2]
    assert 'crashhunt-case.toml may say: expect = "fixed"' in out
    assert out.count("may say") == 1
    assert "Traceback" not in out
    assert [paths for paths, _ in asked] == [[tmp_path / "kept crashes" / name] for name in "abcdef"]
    assert all(options == {"parallel": 1, "trusted": True} for _, options in asked)


def test_case_outside_the_current_folder_is_named_by_its_whole_path(run):
    _, out, _, asked = run(place="../else where", one={"expected": "fixed", "got": "still"})
    ((path,), _) = asked[0]
    assert f"look at it: crashhunt corpus run '{path}' --keep out" in out


def test_error_of_the_plugin_itself_has_its_traceback(run):
    code, _, suite, _ = run(one={"expected": "fixed"})
    assert (code, suite.attrib["failures"]) == (1, "1")
    (failure,) = suite.iter("failure")
    assert "missing 1 required" in failure.text
    assert Path(__file__).name in failure.text
