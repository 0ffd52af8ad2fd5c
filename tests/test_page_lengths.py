"""The check of pages, `scripts/tools/pages.py`."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[1] / "scripts" / "tools" / "pages.py"
spec = importlib.util.spec_from_file_location("pages_check", SCRIPT)
assert spec is not None
assert spec.loader is not None
pages = importlib.util.module_from_spec(spec)
spec.loader.exec_module(pages)

TERMS = "".join(f"| {term} | x |\n" for term in set(pages.OUTDATED.values()))


@pytest.fixture
def project(tmp_path, monkeypatch):
    """A project with a README, a glossary and one how-to page."""
    monkeypatch.setattr(pages, "ROOT", tmp_path)
    monkeypatch.setattr(pages, "OVER", {})
    (tmp_path / "README.md").write_text("Clear.\n")
    for name in ("CITATION.cff", "crashhunt/guide/howto/a.md", "scenarios/a", "scripts/a", ".github/a"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("Clear.\n")
    (tmp_path / "crashhunt/guide/glossary.md").write_text(f"| term | meaning |\n| --- | --- |\n{TERMS}")
    return tmp_path


@pytest.fixture
def _no_spelling(monkeypatch):
    """Leaves out the check of spelling, a process that takes longer than all other rules together."""
    monkeypatch.setattr(pages, "misspelled", lambda root: ())


def test_project_without_findings_passes(project, capsys):
    assert pages.main([]) == 0
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("One two.\n", 2),
        ("One.\n\n```console\n$ crashhunt run a\nmany words\n```\n\nTwo.\n", 2),
        ("<!-- not run: it takes\nlong -->\nOne.\n", 1),
        ("See [one two](../a/very-long.md#place) - three.\n", 4),
        ("| a | b |\n| --- | --- |\n| c | d |\n", 4),
        ("1. Item:\n\n   ```text\n   a b c\n   ```\n\n   end\n", 3),
    ],
)
def test_length_counts_what_is_read_as_prose(text, words):
    assert pages.length(text) == words


@pytest.mark.parametrize(
    ("file", "text", "says"),
    [
        ("crashhunt/guide/howto/a.md", "word " * 601, "howto/a.md: 601 words of prose (at most 600)"),
        ("crashhunt/guide/howto/a.md", "word " * 600, ""),
        ("README.md", "a\n" * 151, "README.md: 151 lines"),
        ("crashhunt/guide/howto/a.md", "The crash is shrunk.\n", "howto/a.md: 'shrunk'; write: minimize"),
        ("crashhunt/guide/howto/a.md", "Use `crashhunt shrink`.\n", ""),
        ("crashhunt/guide/glossary.md", "| fixed | x |\n", "glossary.md: no entry 'minimize'"),
    ],
)
@pytest.mark.usefixtures("_no_spelling")
def test_what_is_too_long_or_outdated_fails_with_its_place(project, capsys, file, text, says):
    (project / file).write_text(text)
    assert pages.main([]) == bool(says)
    assert says in capsys.readouterr().out


def test_what_is_misspelled_fails_with_its_place(project, capsys):
    (project / "README.md").write_text("A colision.\n")
    assert pages.main([]) == 1
    assert "README.md:1: colision ==> collision" in capsys.readouterr().out


@pytest.mark.usefixtures("_no_spelling")
def test_listed_page_may_only_shrink(project, monkeypatch, capsys):
    page = project / "crashhunt/guide/howto/a.md"
    monkeypatch.setattr(pages, "OVER", {"howto/a.md": 700})
    page.write_text("word " * 701)
    assert pages.main([]) == 1
    page.write_text("word " * 700)
    assert pages.main([]) == 0
    page.write_text("word " * 690)
    assert pages.main([]) == 1
    assert "690 words of prose. Lower its number" in capsys.readouterr().out


def test_failure_of_the_spelling_check_is_reported(project, monkeypatch, capsys):
    monkeypatch.setattr(pages, "SPELLED", ("--no-such-option",))
    assert pages.main([]) == 1
    assert "codespell: exit code" in capsys.readouterr().out
