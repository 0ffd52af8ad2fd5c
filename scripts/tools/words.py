"""Find words and sentences that LANGUAGE.md bans: in docstrings, comments, messages, names and guide pages.

`words.json` holds the number of findings that each file may still have. A file that it does not list has none.
usage: scripts/tools/words.py [--write | --list] [FILE...]   (--write lowers the numbers to those of today only)
"""

from __future__ import annotations

import ast
import inspect
import io
import json
import re
import sys
import tokenize
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

ROOT = Path(__file__).resolve().parents[2]
LIMITS = ROOT / "scripts" / "tools" / "words.json"
MAX_WORDS = 30  # per sentence: readers need a second reading beyond that
GENERATED = ("modules.md", "reference/api.md", "reference/commands.md", "reference/toml.md")
"""Pages that the code generates: their texts are checked where they are written."""

PHRASES = {
    r"somebody(?: else)?|someone": "the user, the caller, another actor",
    r"nobody(?! can tell)": "no user, no caller, no vehicle",
    r"whoever|whomever|whom": "the noun: the vehicle, the user, the trial",
    r"anew": "again",
    r"asleep": "suspended",
    r"errs": "deviates, makes a mistake",
    r"told|tells": "reported, reports, receives, configured",
    r"(?:left|leaves|leave) out": "excluded, omits, skips",
    r"go(?:es)? on": "resumes, continues",
    r"comes? to(?! (?:an? )?(?:rest|stop|halt|standstill))": "results in, reaches",
    r"stands? for(?! \d)": "represents, means",
    r"(?:is|are|was) given up|gives? up": "is abandoned, stops",
    r"beside": "in addition to, next to",
    r"to the bit": "bit-identical, bit for bit",
    r"as it were|all the same|and be done|of (?:its|their) own accord": "say the fact, or nothing",
}
BANNED = {re.compile(rf"\b(?:{phrase})\b", re.IGNORECASE): words for phrase, words in PHRASES.items()}
NAMES = re.compile(
    r"(?:^|_)(?:somebody|nobody|whoever|whom|anew|asleep|errs|told|tells|says|whereabouts|surplus|beside|left_out"
    r"|goes_on|go_on|comes_to|stands_for|to_the_bit|so_far)(?:_|$)|^_what$"
)

MARKDOWN_ITEM = r"\s*(?:[-*#>|]\s|[#>|]|\d+\.\s)"
ITEM = MARKDOWN_ITEM + r"|\s*\w[\w*, .]*:(?:\s|$)"

Finding = tuple[int, str, str]  # line, text found, what to write in its place


def banned_phrases(text: str, line: int) -> Iterator[Finding]:
    """Yield the banned words of a text that begins on a line."""
    flat = text.replace("\n", " ")  # a phrase may be split between two lines
    for pattern, words in BANNED.items():
        for match in pattern.finditer(flat):
            yield line + text.count("\n", 0, match.start()), match[0], words


def paragraphs(text: str, line: int, *, python: bool = False) -> Iterator[tuple[int, str]]:
    """Yield the paragraphs of prose with their lines: no code, no tables, no headings; an item of a list is one.

    In docstrings of Python, a line such as ``name: meaning`` is an item as well.
    """
    lines: list[str] = []
    fenced = literal = False
    for number, row in enumerate([*text.split("\n"), ""], line):
        fence = row.lstrip().startswith(("```", ":::"))
        item = re.match(ITEM if python else MARKDOWN_ITEM, row)
        if (fence or fenced or not row.strip() or item) and lines:
            yield number - len(lines), "\n".join(lines)
            lines = []
        fenced ^= fence
        literal = row.endswith("::") or (literal and (not row or row.startswith("    ")))
        if row.strip() and not (fence or fenced or literal or row.lstrip().startswith(("|", "#", ">>>"))):
            lines.append(row)


def heavy_sentences(text: str, line: int, semicolons: bool) -> Iterator[Finding]:
    """Yield sentences of more than `MAX_WORDS` words, and semicolons between sentences where those are banned."""
    for start, paragraph in paragraphs(text, line, python=not semicolons):
        prose = re.sub(r"`[^`]*`", lambda code: "C" + "\n" * code[0].count("\n"), paragraph)
        prose = re.sub(r"\]\([^)]*\)", "]", prose)
        position = 0
        for sentence in re.split(r"(?<=[.!?])\s+(?=[^a-z]|crashhunt\b|highway-env\b)", prose):
            if (length := len(sentence.split())) > MAX_WORDS:
                yield start + prose.count("\n", 0, position), f"{length} words", f"sentences of at most {MAX_WORDS}"
            position += len(sentence) + 1
        for match in re.finditer(r";\s", prose) if semicolons else ():
            yield start + prose.count("\n", 0, match.start()), "';'", "two sentences, or a list"


def findings_in_python(source: str) -> Iterator[Finding]:
    """Yield what is banned in the docstrings, comments, messages and names of a module."""
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            yield from banned_phrases(token.string, token.start[0])
    tree = ast.parse(source)
    docstrings = {
        id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and " " in node.value:
            yield from banned_phrases(node.value, node.lineno)
            if id(node) in docstrings:
                yield from heavy_sentences(inspect.cleandoc(node.value), node.lineno, semicolons=False)
        name = getattr(node, "name", None) or getattr(node, "arg", None)
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            name = node.id
        if isinstance(name, str) and NAMES.search(name) and not isinstance(node, ast.alias | ast.keyword):
            yield getattr(node, "lineno", 1), name, "the field's term: verb and object, or a noun"


def findings_in(file: Path) -> list[Finding]:
    """Return what is banned in a file; of tests only the names are checked."""
    text = file.read_text(encoding="utf-8")
    if file.suffix == ".md":
        return sorted({*banned_phrases(text, 1), *heavy_sentences(text, 1, semicolons=True)})
    found = [(1, file.name, "a noun in the plural, or a process")] if NAMES.search(file.stem) else []
    if file.name.startswith("test_"):
        names = re.finditer(r"^ *def (test_\w+)", text, re.MULTILINE)
        rows = ((text.count("\n", 0, name.start()) + 1, name[1]) for name in names)
        return found + [(line, name, "a sentence about behaviour") for line, name in rows if NAMES.search(name)]
    return sorted([*found, *findings_in_python(text)])


def checked_files() -> list[Path]:
    """Return the files that `scripts/check` reads."""
    pages = [page for page in ROOT.glob("crashhunt/guide/**/*.md") if not page.as_posix().endswith(GENERATED)]
    return sorted([*ROOT.glob("crashhunt/**/*.py"), *pages, ROOT / "README.md", *ROOT.glob("tests/**/test_*.py")])


def main(arguments: list[str]) -> int:
    """Print the findings of files that have more than they may; return 1 if there are any."""
    limits: dict[str, int] = json.loads(LIMITS.read_text()) if LIMITS.exists() else {}
    named = [Path(name).resolve() for name in arguments if not name.startswith("--")]
    found = {file.relative_to(ROOT).as_posix(): findings_in(file) for file in named or checked_files()}
    if "--write" in arguments:
        counts = {
            name: min(len(rows), limits.get(name, 0) if LIMITS.exists() else len(rows)) for name, rows in found.items()
        }
        LIMITS.write_text(json.dumps({name: count for name, count in counts.items() if count}, indent=1) + "\n")
    failed = {name: rows for name, rows in found.items() if len(rows) > limits.get(name, 0) or "--list" in arguments}
    for name, rows in failed.items() if "--write" not in arguments else ():
        print(f"{name}: {len(rows)} findings (allowed: {limits.get(name, 0)})")
        print(*(f"  {name}:{line}: {what!r}; write: {words}" for line, what, words in rows), sep="\n")
    return int(bool(failed) and not {"--write", "--list"} & {*arguments})


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
