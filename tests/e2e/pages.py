"""Pages of Markdown, and what they show: files to be written, and commands to be run, with their output.

What is not run says so, in a comment above its block:

    <!-- not run: WHY -->              nothing of this block is written or run
    <!-- tests run: 150 -> 20 -->      the commands are run with another number, to save time; see what else they print
    <!-- exit code: 1 -->              of the last command of the block

A page may begin where another one ends: ``<!-- continues from: your-town -->``.
"""

from __future__ import annotations

import re
import shlex
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
GUIDE = ROOT / "crashhunt" / "guide"
PAGES = {"README": ROOT / "README.md", **{file.stem: file for file in sorted(GUIDE.rglob("*.md"))}}
BLOCK = re.compile(r"(?:^<!-- ([\w ]+): ([^\n]*) -->\n)?^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
NAMED = re.compile(r"(?:# |// |<!-- )([\w/-]+\.[\w.]+)(?: -->)?$", re.MULTILINE)
PROMPT = re.compile(r"^\$ ((?:.*\\\n)*.*)\n((?:(?!\$ ).*\n)*)", re.MULTILINE)


@dataclass(frozen=True)
class Command:
    """A command, and what a page says of it."""

    page: str
    line: str
    shown: str
    code: int = 0
    shortened: bool = False

    @property
    def key(self) -> tuple[str, ...]:
        """What is the same on several pages; it is run once."""
        return ("crashhunt", *self.words[1:]) if self.words[0].endswith("crashhunt") else tuple(self.words)

    @property
    def words(self) -> list[str]:
        """The command as a list."""
        return shlex.split(self.line)


class Page:
    """What a page shows."""

    def __init__(self, topic: str) -> None:
        self.topic = topic
        self.text = PAGES[topic].read_text(encoding="utf-8")
        continues = re.search(r"<!-- continues from: (\S+) -->", self.text)
        self.before = continues[1] if continues else ""
        self.files: dict[str, str] = {}
        self.commands: list[Command] = []
        self.unclear: list[str] = []
        for note, said, kind, body in BLOCK.findall(self.text):
            if note == "not run" or kind == "text":
                continue
            if kind == "console":
                self.commands += self._commands(body, note, said)
            elif named := NAMED.match(body):
                self.files[named[1]] = body
            else:
                self.unclear.append(body)

    def _commands(self, body: str, note: str, said: str) -> list[Command]:
        found = []
        for line, shown in PROMPT.findall(body):
            line = line.replace("\\\n", " ")
            shortened = note == "tests run"
            if shortened:
                shown_number, number = said.split(" -> ")
                line = re.sub(rf"\b{shown_number}\b", number, line)
            found.append(Command(self.topic, line, shown, shortened=shortened))
        if note == "exit code":
            found[-1] = Command(self.topic, found[-1].line, found[-1].shown, code=int(said))
        return found


def tree(root: str) -> list[Page]:
    """A page, and all that go on where it ends, each after the one that it continues from."""
    pages = [Page(topic) for topic in PAGES]
    found = [page for page in pages if page.topic == root]
    for page in found:
        found += [other for other in pages if other.before == page.topic]
    return found


def prepare(folder: Path, pages: list[Page]) -> None:
    """Write the files that pages show, beside the scenarios that their readers have."""
    (folder / "scenarios").symlink_to(ROOT / "scenarios")
    for page in pages:
        for name, text in page.files.items():
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / name).write_text(text, encoding="utf-8")
