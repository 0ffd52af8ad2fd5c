"""Draw sentences by chance from guide, help, errors and docstrings, for readers who judge their clarity.

usage: scripts/tools/sentences.py SEED   (the same seed draws the same sentences of the same texts)
"""

from __future__ import annotations

import argparse
import ast
import inspect
import random
import re
import sys
from typing import TYPE_CHECKING

from words import GENERATED, ROOT, paragraphs

from crashhunt.cli import make_parser

if TYPE_CHECKING:
    from collections.abc import Iterator

DRAWN = {"guide": 25, "help": 10, "errors": 10, "docstrings": 15}
MIN_WORDS = 4
NOT_READ = (*GENERATED, "changelog.md")

Sentence = tuple[str, str]  # place, text


def sentences(text: str, *, python: bool = False) -> Iterator[str]:
    """Yield the sentences of prose, each in one line, from `MIN_WORDS` words on."""
    for _, paragraph in paragraphs(text, 1, python=python):
        flat = " ".join(re.sub(r"\]\([^)]*\)", "]", paragraph).split())
        for sentence in re.split(r"(?<=[.!?])\s+(?=[^a-z]|crashhunt\b|highway-env\b)", flat):
            if len(sentence.split()) >= MIN_WORDS:
                yield sentence


def in_guide() -> Iterator[Sentence]:
    """Yield the sentences of all pages and of the README, with the titles of their page and section."""
    for page in sorted([*ROOT.glob("crashhunt/guide/**/*.md"), ROOT / "README.md"]):
        if page.as_posix().endswith(NOT_READ):
            continue
        text = re.sub(r"<!--.*?-->", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
        code = re.compile(r"^```.*?^```$", re.DOTALL | re.MULTILINE)
        parts = re.split(r"^#+ (.*)$", code.sub("", text), flags=re.MULTILINE)
        titles = parts[1::2]
        for title, section in zip(titles, parts[2::2], strict=True):
            place = titles[0] if title == titles[0] else f"{titles[0]} > {title}"
            yield from ((f"{page.relative_to(ROOT).as_posix()} ({place})", sentence) for sentence in sentences(section))


def in_help(parser: argparse.ArgumentParser) -> Iterator[Sentence]:
    """Yield the help of all options, and the sentences of the descriptions of all commands."""
    yield from ((parser.prog, sentence) for sentence in sentences(parser.description or ""))
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for command in action.choices.values():
                yield from in_help(command)
        elif action.help and action.dest != "help":
            name = action.option_strings[-1] if action.option_strings else action.metavar
            shown = parser._get_formatter()._expand_help(action)
            yield f"{parser.prog} {name}", shown


def in_errors() -> Iterator[Sentence]:
    """Yield the messages of raised errors with their fixes; values are in braces."""
    for file in sorted(ROOT.glob("crashhunt/**/*.py")):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if not (isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call) and node.exc.args):
                continue
            keywords = {item.arg: item.value for item in node.exc.keywords}
            message = literal(node.exc.args[0])
            if len(message.split()) >= MIN_WORDS:
                where = f"{shown_value(keywords['where'])}: " if "where" in keywords else ""
                shown = where + message + (f"; {shown_value(keywords['fix'])}" if "fix" in keywords else "")
                yield f"{file.relative_to(ROOT).as_posix()}:{node.lineno}", shown


def literal(node: ast.expr | None) -> str:
    """Return the text of a string as the source has it; empty for another expression."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        return "".join(
            f"{{{ast.unparse(part.value)}}}" if isinstance(part, ast.FormattedValue) else literal(part)
            for part in node.values
        )
    return ""


def shown_value(node: ast.expr) -> str:
    """Return a string as the source has it, and any other expression in braces."""
    return literal(node) or f"{{{ast.unparse(node)}}}"


def in_docstrings() -> Iterator[Sentence]:
    """Yield the sentences of all docstrings, with the signature of their function."""
    for file in sorted(ROOT.glob("crashhunt/**/*.py")):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
                found = inspect.cleandoc(ast.get_docstring(node) or "")
                place = f"{file.relative_to(ROOT).as_posix()} {signature(node)}"
                yield from ((place, sentence) for sentence in sentences(found, python=True))


def signature(node: ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef) -> str:
    """Return the first line of a definition; empty for a module."""
    if isinstance(node, ast.Module):
        return ""
    if isinstance(node, ast.ClassDef):
        return f"class {node.name}"
    return f"def {node.name}({ast.unparse(node.args)})"


def draw(seed: int) -> Iterator[tuple[str, Sentence]]:
    """Yield the drawn sentences, each with its kind of text."""
    texts = {
        "guide": in_guide(), "help": in_help(make_parser()), "errors": in_errors(), "docstrings": in_docstrings(),
    }  # fmt: skip
    chance = random.Random(seed)
    for kind, number in DRAWN.items():
        yield from ((kind, found) for found in chance.sample(sorted(set(texts[kind])), number))


def main(arguments: list[str]) -> int:
    """Print the drawn sentences, a line each."""
    if len(arguments) != 1 or not arguments[0].isdecimal():
        sys.exit(str(__doc__).partition("usage: ")[2].strip())
    for number, (kind, (place, text)) in enumerate(draw(int(arguments[0])), 1):
        print(f"{number:2} {kind:<10} {place}\n   {text}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
