"""The check of banned words, `scripts/tools/words.py`."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[1] / "scripts" / "tools" / "words.py"
spec = importlib.util.spec_from_file_location("words", SCRIPT)
assert spec is not None
assert spec.loader is not None
words = importlib.util.module_from_spec(spec)
spec.loader.exec_module(words)


@pytest.fixture
def project(tmp_path, monkeypatch):
    """A project of one module with one allowed finding."""
    (tmp_path / "scripts" / "tools").mkdir(parents=True)
    (tmp_path / "README.md").write_text("Clear.\n")
    package = tmp_path / "crashhunt"
    package.mkdir()
    (package / "m.py").write_text('"""Somebody drives."""\n')
    (tmp_path / "scripts" / "tools" / "words.json").write_text('{"crashhunt/m.py": 1}')
    monkeypatch.setattr(words, "ROOT", tmp_path)
    monkeypatch.setattr(words, "LIMITS", tmp_path / "scripts" / "tools" / "words.json")
    return tmp_path


@pytest.mark.parametrize(
    "line",
    ["# nobody knows", 'print("x is told")', "_told = 1", "def f(whom):\n    pass", '"""It goes\non."""', "_what = 1"],
)
def test_new_banned_word_fails_with_its_line_and_a_replacement(project, capsys, line):
    module = project / "crashhunt" / "m.py"
    assert words.main([]) == 0
    module.write_text('"""Somebody drives."""\nx = 1\n' + line + "\n")
    assert words.main([]) == 1
    report = capsys.readouterr().out
    assert "crashhunt/m.py:3: " in report
    assert "; write: " in report


def test_file_that_is_not_listed_may_have_no_finding(project):
    (project / "crashhunt" / "n.py").write_text("# told\n")
    assert words.main([]) == 1


def test_write_lowers_the_numbers_and_never_raises_them(project):
    limits = project / "scripts" / "tools" / "words.json"
    (project / "crashhunt" / "m.py").write_text("# told\n# told\n")
    words.main(["--write"])
    assert json.loads(limits.read_text()) == {"crashhunt/m.py": 1}
    (project / "crashhunt" / "m.py").write_text("x = 1\n")
    words.main(["--write"])
    words.main(["--write"])
    assert json.loads(limits.read_text()) == {}
    (project / "crashhunt" / "m.py").write_text("# told\n")
    words.main(["--write"])
    assert json.loads(limits.read_text()) == {}


def test_deleted_list_allows_nothing(project):
    (project / "scripts" / "tools" / "words.json").unlink()
    assert words.main([]) == 1


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("One fact; another fact.\n", ["';'"]),
        ("`a; b` is code.\n", []),
        ("```\na; b\n```\n", []),
        (" ".join(["word"] * 31) + ".\n", ["31 words"]),
        (" ".join(["word"] * 30) + ".\n", []),
        ("- " + " ".join(["word"] * 20) + "\n- " + " ".join(["word"] * 20) + "\n", []),
        ("The vehicle comes to a stop.\n", []),
        ("That comes\nto 5 m.\n", ["comes\nto"]),
    ],
)
def test_guide_pages_have_short_sentences_without_semicolons(tmp_path, text, found):
    page = tmp_path / "page.md"
    page.write_text(text)
    assert [what.replace(" to", "\nto") for _, what, _ in words.findings_in(page)] == found


def test_long_sentence_of_a_docstring_is_found_at_its_line(tmp_path):
    module = tmp_path / "m.py"
    module.write_text('def f():\n    """Return 1.\n\n    ' + "word " * 31 + 'end.\n    """\n')
    assert [(line, what) for line, what, _ in words.findings_in(module)] == [(4, "32 words")]


def test_names_of_tests_are_checked_and_their_texts_are_not(tmp_path):
    module = tmp_path / "test_m.py"
    module.write_text("def test_nobody_drives():\n    # told\n    pass\n")
    assert [what for _, what, _ in words.findings_in(module)] == ["test_nobody_drives"]
