"""Check the pages of the guide and the README: their length, their terms and their spelling.

A word counts if a reader reads it as prose: outside code blocks, their output, and comments of the Markdown. Tables and
lists count. `OVER` lists the pages that are still too long, each with its present number; it may only shrink.
usage: scripts/tools/pages.py [--list]   (--list prints the length of every page)
"""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

ROOT = Path(__file__).resolve().parents[2]
GUIDE = Path("crashhunt/guide")
MAX_WORDS = {"start": 900, "tutorials": 900, "howto": 600, "concepts": 600}  # by folder: a page answers one question
MAX_README_LINES = 150
OVER: dict[str, int] = {}
SPELLED = ("README.md", "CITATION.cff", "crashhunt", "scenarios", "scripts", ".github")

OUTDATED = {
    r"kinds? of (?:a )?crash(?:es)?": "crash type",
    r"mended": "fixed",
    r"shrunk|shrink(?:s|ing)?": "minimize",
    r"warm cop(?:y|ies)": "suspended fork",
    r"(?:takes?|took) over (?:a|another|the) vehicle": "ego replacement",
}
"""Terms that the glossary replaced, and the entry of the glossary that has the standard term."""


def prose(text: str) -> str:
    """Return what a reader reads of Markdown as prose: no code blocks, no comments, no targets of links."""
    text = re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL)
    text = re.sub(r"^( *)(```|:::).*?^\1\2$", "", text, flags=re.MULTILINE | re.DOTALL)
    return re.sub(r"\]\([^)]*\)", "]", text)


def length(text: str) -> int:
    """Return the number of words of a page's prose."""
    return sum(bool(re.search(r"\w", word)) for word in prose(text).split())


def glossary_terms(text: str) -> set[str]:
    """Return the terms in the first column of the glossary."""
    return {row.strip() for row in re.findall(r"^\| ([^|]+) \|", text, re.MULTILINE)} - {"term", "---"}


def too_long(root: Path) -> Iterator[str]:
    """Yield a line for each page beyond its limit, and for each entry of `OVER` that could be lower."""
    readme = len((root / "README.md").read_text(encoding="utf-8").splitlines())
    if readme > MAX_README_LINES:
        yield f"README.md: {readme} lines (at most {MAX_README_LINES})"
    for folder, limit in MAX_WORDS.items():
        for page in sorted((root / GUIDE / folder).glob("*.md")):
            name = page.relative_to(root / GUIDE).as_posix()
            words, allowed = length(page.read_text(encoding="utf-8")), OVER.get(name, limit)
            if words > allowed:
                yield f"{GUIDE / name}: {words} words of prose (at most {allowed}). Move details to reference/"
            elif name in OVER and words < allowed:
                yield f"{GUIDE / name}: {words} words of prose. Lower its number in OVER of scripts/tools/pages.py"


def outdated_terms(root: Path) -> Iterator[str]:
    """Yield a line for each term that the glossary has replaced, and for each replacement that it lacks."""
    known = glossary_terms((root / GUIDE / "glossary.md").read_text(encoding="utf-8"))
    yield from (f"glossary.md: no entry {term!r}" for term in sorted({*OUTDATED.values()} - known))
    for page in [root / "README.md", *sorted((root / GUIDE).rglob("*.md"))]:
        text = re.sub(r"`[^`]*`", "`", prose(page.read_text(encoding="utf-8")))
        for pattern, term in OUTDATED.items():
            for found in re.findall(rf"\b(?:{pattern})\b", text, re.IGNORECASE):
                yield f"{page.relative_to(root)}: {found!r}; write: {term}"


def misspelled(root: Path) -> Iterator[str]:
    """Yield the findings of codespell, whose settings are in pyproject.toml."""
    program = Path(sys.executable).with_name("codespell")
    found = subprocess.run([program, *SPELLED], cwd=root, capture_output=True, text=True, check=False)
    if found.returncode not in (0, 65):  # 65: there are findings
        yield f"codespell: exit code {found.returncode}: {found.stderr.strip()}"
    yield from found.stdout.splitlines()


def main(arguments: list[str]) -> int:
    """Print what is wrong; return 1 if anything is."""
    if "--list" in arguments:
        for page in sorted((ROOT / GUIDE).rglob("*.md")):
            print(f"{length(page.read_text(encoding='utf-8')):5} {page.relative_to(ROOT / GUIDE)}")
        return 0
    found = [*too_long(ROOT), *outdated_terms(ROOT), *misspelled(ROOT)]
    print("".join(f"{line}\n" for line in found), end="")
    return int(bool(found))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
