"""What the README and the guide show is run: files are written as they stand there, commands are called."""

from __future__ import annotations

import os
import re
import subprocess
import sys

import pytest
from conftest import mostly_nightly
from pages import PAGES, ROOT, Page, prepare, tree

ROOTS = [topic for topic in PAGES if not Page(topic).before and Page(topic).commands]
# The dearest pages; what they show is asked by day elsewhere, without their words.
AT_NIGHT = (
    "actions", "agent", "api", "ci", "compare", "connect-your-planner", "disturbances", "exec", "executor", "film",
    "files", "find-a-crash", "gymnasium", "hand-over", "highway-env", "how-often-does-it-crash", "lib",
    "look-into-a-crash", "observations", "oracle", "planner-in-cpp", "prove-that-it-is-fixed", "requirements",
    "sampler", "scenario", "simulator", "suites", "train", "watch-and-see-why", "which-version-is-better",
    "your-town",
)  # fmt: skip
BY_DAY = [root for root in ROOTS if root not in AT_NIGHT]
# By day, the first hunt of the README and its replay; "README-all" runs the others at night. By day, tests of
# scenarios hunt with a user's agent, on highway-env and on Gymnasium.
FIRST_COMMANDS = {"README": 2}
WITH_MORE = [root for root in BY_DAY if root in FIRST_COMMANDS or any(page.topic in AT_NIGHT for page in tree(root))]
# Times, rates, digests and the numbers of what is drawn differ, and so do lines that come now and then.
# How many trials have ended beside the one that crashed depends on time; which one crashed does not.
VARIES = re.compile(
    r"(collision|finished|survived) \d+(, [a-z_]+ \d+)*|[\da-f]{16,}|/(tmp|dev/shm)/\S+|[─ ]+"
    r"|\d+(\.\d+)?(/s\b| s/trial\b)?"  # a loaded machine runs less than one trial per second
)
NOW_AND_THEN = re.compile(
    r"the compiled core is |running:|done:|saving:|confirming:|.*: (running|finished|crashed)$|\.+ +\[|(.* )?\d+ passed"
)


def lines(text: str) -> list[str]:
    return [VARIES.sub("#", line.strip()) for line in text.splitlines() if not NOW_AND_THEN.match(line)]


class Reader:
    """Does what pages say, in one folder; what is shown on several is run once."""

    def __init__(self, shell) -> None:
        self.shell = shell
        self.said = {}

    def run(self, command) -> str:
        if command.key not in self.said:
            self.said[command.key] = self._run(command)
        return self.said[command.key]

    def _run(self, command) -> str:
        program, *words = command.words
        if words[-2:-1] == [">"]:
            text = self.shell.crashhunt(*words[:-2], expect=command.code).out
            (self.shell.folder / words[-1]).write_text(text, encoding="utf-8")
            return ""
        if program in ("crashhunt", "scripts/crashhunt"):
            done = self.shell.crashhunt(*words, *self._same_again(command), expect=command.code)
            return f"{done.err}\n{done.out}"
        program = sys.executable if program in ("python", ".venv/bin/python") else program
        environment = {**self.shell.environment, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
        environment |= {"PYTEST_DEBUG_TEMPROOT": str(self.shell.folder)}  # and not where it would clear up after others
        environment |= {"PATH": f"{os.path.dirname(sys.executable)}:{environment['PATH']}"}  # noqa: PTH120
        done = subprocess.run(
            [program, *words], cwd=self.shell.folder, env=environment, capture_output=True, text=True, check=False
        )
        assert done.returncode == command.code, f"{command.line}\n{done.stdout}\n{done.stderr}"
        return f"{done.stderr}\n{done.stdout}"

    def _same_again(self, command) -> list[str]:
        """A hunt draws a new seed where nobody gives one: it is given the one that it drew for the page."""
        drawn = re.search(r"hunt seed (\d+)", command.shown)
        if command.words[1] != "run" or "--seed" in command.words or drawn is None:
            return []
        return ["--seed", drawn[1], "--deterministic"]


@pytest.mark.long
@pytest.mark.timeout(600)  # half a minute of hunts, and more on a machine with something else to do
@pytest.mark.parametrize(
    ("root", "left_out"),
    mostly_nightly(
        [*((root, AT_NIGHT if root in WITH_MORE else ()) for root in ROOTS), *((root, ()) for root in WITH_MORE)],
        [(root, AT_NIGHT if root in WITH_MORE else ()) for root in BY_DAY],
    ),
    ids=lambda value: value if isinstance(value, str) else "some pages" if value else "all",
)
def test_every_command_does_what_it_states(root, left_out, shell):
    pages = [page for page in tree(root) if page.topic not in left_out]
    assert {page.before for page in pages} <= {page.topic for page in pages} | {""}
    prepare(shell.folder, pages)
    reader = Reader(shell)
    for page in pages:
        for command in page.commands[: FIRST_COMMANDS.get(page.topic) if left_out else None]:
            said = lines(reader.run(command))
            if not command.shortened:
                missing = [line for line in lines(command.shown) if line not in ("…", *said)]
                assert not missing, f"{page.topic}: {command.line}\n" + "\n".join(said)


def test_all_pages_are_read_and_state_what_is_neither_run_nor_written():
    assert {topic: unclear for topic in PAGES if (unclear := Page(topic).unclear)} == {}
    assert FIRST_COMMANDS.keys() <= set(WITH_MORE)
    assert all(len(Page(topic).commands) > number for topic, number in FIRST_COMMANDS.items())
    assert {page.topic for root in ROOTS for page in tree(root)} >= {t for t in PAGES if Page(t).commands}
    assert len(Page("README").text.splitlines()) <= 150


@pytest.mark.parametrize("file", ["README.md", ".github/SECURITY.md"])
def test_links_lead_somewhere(file):  # those of the guide are checked where it is built
    links = re.findall(r"\]\((?!\w+:)([^)#]+)", (ROOT / file).read_text(encoding="utf-8"))
    assert links
    assert [link for link in links if not (ROOT / file).parent.joinpath(link).exists()] == []


def test_every_option_that_is_mentioned_exists(shell):
    option = re.compile(r"(?<![\w-])--[a-z][a-z-]*(?!\w)")  # those of other programs have underscores
    files = [file for file in (ROOT / "scripts").rglob("*") if file.suffix in ("", ".py") and file.is_file()]
    scripts = [file.read_text(encoding="utf-8") for file in files]
    known = {"--help", "--help-all", "--upgrade"}
    known = known.union(*map(option.findall, [shell.crashhunt("guide", "commands").out, *scripts]))
    others = re.compile(
        r"^#SBATCH|\bsrun\b|\bray start\b|\bpytest-xdist\b|\bnetconvert\b|\bpkg-config\b|\brandomTrips\b|"
        r"\btesting\.r157\b"
    )  # programs
    for topic in PAGES:
        ours = [line for line in Page(topic).text.splitlines() if not others.search(line)]
        assert set(option.findall("\n".join(ours))) <= known, topic
