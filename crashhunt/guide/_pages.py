"""Pages of the guide: their files, their names, and their display in a terminal."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base.errors import UsageError
from crashhunt.base.text import one_of
from crashhunt.guide._reference import (
    describe_actions,
    describe_api,
    describe_commands,
    describe_json,
    describe_keys,
    describe_modules,
    describe_observations,
    describe_signals,
)

if TYPE_CHECKING:
    import argparse

SECTIONS = {
    "start": "Start",
    "tutorials": "Tutorials",
    "howto": "How to",
    "concepts": "Concepts",
    "reference": "Reference",
    "reference/evaluation": "Evaluation",
    "": "More",
}
"""The folders of the guide with their titles, in reading order."""

_PAGE_ORDER = [
    "find-a-crash", "watch-and-see-why", "prove-that-it-is-fixed", "how-often-does-it-crash",
    "which-version-is-better", "as-good-as-a-competent-driver", "cluster",
    "connect-your-planner", "your-town", "highway-env", "gymnasium",
    "planner-in-cpp", "ci",
    "agent", "exec", "lib", "fmu", "scenario", "map", "searching", "requirements", "disturbances",
    "probes", "branches", "look-into-a-crash",
    "kinds-of-crashes", "notes", "fault", "judge", "shrink", "film", "near-misses",
    "hand-over", "corpus", "suites", "warm-up", "dashboard", "rate", "rare", "compare", "scorecard", "gate", "train",
    "criticality", "determinism", "search", "counterfactuals", "crash-rates",
    "commands", "api", "toml", "actions", "outcomes", "files", "json", "dashboard-api", "security",
    "exec-protocol", "disturbance-kinds", "requirement-language", "forks", "minimization", "export", "clusters",
    "gallery", "troubleshooting", "glossary", "architecture", "modules", "contributing", "changelog",
]  # fmt: skip
"""Topics in reading order; all other topics follow them."""

_FORMER_PAGES = {
    "first-hunt": "find-a-crash", "causes": "judge", "omissions": "judge", "what-if": "judge", "from-a-map": "map",
    "train-on-crashes": "train", "learn-from-crashes": "train", "at-fault": "fault", "fault-rules": "fault",
}  # fmt: skip
"""Topics that were renamed, and their present names: `crashhunt guide` still takes them."""

_GENERATED_MARK = re.compile(r"^<!-- made from the code: (\w+) -->\n", re.MULTILINE)
_COMMENT = re.compile(r"<!--.*?-->\n*", re.DOTALL)
_PICTURE = re.compile(r"!\[([^\]]*)\]\([^)]*\)")
_LINK = re.compile(r"\[([^\]]+)\]\((?!\w+:)([^)#]*)(?:#[^)]*)?\)")
_FENCED = re.compile(r"(^```.*?^```$)", re.MULTILINE | re.DOTALL)


@dataclass(frozen=True, slots=True)
class Page:
    """A page of the guide."""

    topic: str  # unique name of the page on the command line
    section: str  # folder that contains the page; empty for the top folder
    title: str  # heading of the page
    file: Path  # the Markdown file, in which some comments are placeholders for generated parts

    def text(self, parser: argparse.ArgumentParser) -> str:
        """Return the whole page as Markdown."""
        return completed(self.file.read_text(encoding="utf-8"), parser)


def pages_folder() -> Path:
    """Return the folder of the pages."""
    return Path(__file__).parent


def list_pages() -> list[Page]:
    """Return all pages, section by section, except the index, which is a list of them."""
    found = []
    for section in SECTIONS:
        files = [file for file in (pages_folder() / section).glob("*.md") if file.stem != "index"]
        found += [
            Page(topic=file.stem, section=section, title=_title(file), file=file)
            for file in sorted(files, key=_section_of)
        ]
    return found


def find_page(topic: str) -> Page:
    """Return the page of a topic, which may be a former name of the topic.

    Raises:
        UsageError: the topic does not exist.
    """
    pages = {page.topic: page for page in list_pages()}
    topic = _FORMER_PAGES.get(topic, topic)
    if topic not in pages:
        raise UsageError(f"the guide has no topic {topic!r}", fix=one_of(topic, pages))
    return pages[topic]


def completed(text: str, parser: argparse.ArgumentParser) -> str:
    """Return the text of a page, with its generated parts inserted.

    Args:
        text: Markdown text, in which ``<!-- made from the code: commands -->`` is a placeholder; ``actions``, ``api``,
            ``json``, ``keys``, ``modules``, ``observations`` and ``signals`` are further placeholders.
        parser: parser of the command line.
    """
    makers = {
        "commands": lambda: describe_commands(parser),
        "actions": describe_actions,
        "api": describe_api,
        "json": describe_json,
        "keys": describe_keys,
        "modules": describe_modules,
        "observations": describe_observations,
        "signals": describe_signals,
    }
    # Remove the text that follows a placeholder for readers of the raw file, up to the next blank line.
    return re.sub(_GENERATED_MARK.pattern + r"(?:.+\n)*", lambda found: makers[found[1]](), text, flags=re.MULTILINE)


def for_terminal(text: str) -> str:
    """Return Markdown without elements that a terminal cannot show: a link becomes the command that shows the page."""
    parts = _FENCED.split(text)
    for number in range(0, len(parts), 2):  # what is between the fences is shown as it is
        prose = _PICTURE.sub(lambda found: f"(picture: {' '.join(found[1].split())})", parts[number])
        parts[number] = _LINK.sub(_description_of, _COMMENT.sub("", prose))
    return "".join(parts)


def _description_of(found: re.Match[str]) -> str:
    file = Path(found[2])
    return f"{found[1]} (`crashhunt guide {file.stem}`)" if file.suffix == ".md" else found[1]


def _section_of(file: Path) -> tuple[int, str]:
    return (_PAGE_ORDER.index(file.stem) if file.stem in _PAGE_ORDER else len(_PAGE_ORDER)), file.stem


def _title(file: Path) -> str:
    with file.open(encoding="utf-8") as lines:
        return next(line.removeprefix("# ").strip() for line in lines if line.startswith("# "))
