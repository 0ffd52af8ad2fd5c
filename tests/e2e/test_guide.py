"""``crashhunt guide``: the pages in the terminal, and what of them is made from the code."""

from __future__ import annotations

import importlib
import inspect
import os
import pty
import re
import subprocess
import tomllib
import traceback
from functools import cache
from itertools import pairwise
from pathlib import Path

import pytest
from conftest import CRASHHUNT
from pages import GUIDE

import crashhunt
from crashhunt.cli import make_parser
from crashhunt.errors import UsageError
from crashhunt.guide import (
    describe_commands,
    describe_json,
    describe_keys,
    describe_modules,
    find_page,
    for_terminal,
    list_pages,
    search_pages,
)

TOPICS = [page.topic for page in list_pages()]


@cache
def text_of(topic: str) -> str:
    """A page as it is shown; some take half a second."""
    return find_page(topic).text(make_parser())


def test_topics_are_listed(shell):
    out = shell.crashhunt("guide").out
    assert all(re.search(rf"^  {topic} +\S", out, re.MULTILINE) for topic in TOPICS)
    assert out.index("find-a-crash") < out.index("your-town") < out.index("troubleshooting")
    found = shell.crashhunt("guide", "--json").json["topics"]
    assert [entry["topic"] for entry in found] == TOPICS
    assert found[0] == {"topic": "find-a-crash", "section": "start", "title": "Find a crash in your agent in 5 minutes"}


def test_every_page_has_a_topic_of_its_own():
    files = {file.stem for file in GUIDE.rglob("*.md")} - {"index"}
    assert set(TOPICS) == files
    assert len(set(TOPICS)) == len(TOPICS)


def test_a_page_in_a_pipe_is_plain_text(shell):
    out = shell.crashhunt("guide", "files").out
    assert out.endswith("\n")
    assert not out.endswith("\n\n")
    assert out.startswith("# Files on disk\n")
    assert "<!--" not in out
    assert "\x1b" not in out
    (said,) = [shell.crashhunt("guide", "files", "--json").json]
    assert said["topic"] == "files"
    assert said["text"].startswith("# Files on disk\n")


def test_a_page_on_a_terminal_is_drawn(shell):
    screen, terminal = pty.openpty()
    done = subprocess.Popen(
        [CRASHHUNT, "guide", "glossary"], cwd=shell.folder, stdout=terminal, stderr=terminal,
        env={**shell.environment, "TERM": "xterm-256color", "COLUMNS": "90"},
    )  # fmt: skip
    os.close(terminal)
    drawn = b""
    with open(screen, "rb", buffering=0) as reader:
        while True:
            try:
                drawn += reader.read(4096) or b""
            except OSError:  # the other end is closed
                break
    assert done.wait(300) == 0
    text = drawn.decode()
    assert "\x1b[" in text
    assert "| --- |" not in text  # the table is one
    assert re.search(r"nearest miss .*the trial with the", re.sub(r"\x1b\[[\d;]*m", "", text))  # in one row


def test_an_unknown_topic_is_one_line(shell):
    done = shell.crashhunt("guide", "determinsm", expect=2)
    assert done.err.startswith("crashhunt: the guide has no topic 'determinsm'; did you mean 'determinism'?")
    assert len(done.err.splitlines()) == 1
    assert shell.crashhunt("guide", "xyzzy", "--json", expect=2).json["error"]["fix"]


def test_a_word_that_is_no_topic_lists_the_pages_with_this_word():
    found = {one.page.topic for one in search_pages("openstreetmap")}
    assert {"map"} <= found < {page.topic for page in list_pages()}
    assert search_pages("xyzzy") == search_pages("crash xyzzy") == search_pages("") == search_pages("!?") == []


@pytest.mark.parametrize(
    ("words", "topic", "heading"),
    [
        ("which version is better", "which-version-is-better", ""),
        ("install the dashboard", "dashboard", ""),
        ("vehicle at fault", "fault", ""),
        ("notes and tags", "notes", ""),
        ("too many trials slow", "troubleshooting", "My hunt is slow"),
        ("is the seed reproducible", "troubleshooting", "My crash does not reproduce"),
        ("crash does not reproduce on another computer", "troubleshooting", "My crash does not reproduce"),
    ],
)
def test_question_of_a_new_user_is_answered_by_one_of_the_first_pages(words, topic, heading):
    best = search_pages(words)[:2]
    assert topic in [one.page.topic for one in best]
    assert any(one.page.topic == topic and one.heading.startswith(heading) for one in best)


def test_former_topic_shows_the_page_that_replaced_it():
    assert find_page("first-hunt").topic == "find-a-crash"


@pytest.mark.parametrize(
    ("markdown", "shown"),
    [
        ("see [files](../reference/files.md).", "see files (`crashhunt guide files`)."),
        ("see [files](files.md#the-log).", "see files (`crashhunt guide files`)."),
        ("see [below](#here)", "see below"),
        ("[SUMO](https://eclipse.dev/sumo/)", "[SUMO](https://eclipse.dev/sumo/)"),
        ("[code](../../scenarios/x.py)", "code"),
        ("a ![two\nwords](x.png)", "a (picture: two words)"),
        ("<!-- not run: why -->\n```toml\n<!-- [a](b.md) -->\n```\n", "```toml\n<!-- [a](b.md) -->\n```\n"),
    ],
)
def test_what_a_terminal_cannot_show_is_said_in_words(markdown, shown):
    assert for_terminal(markdown) == shown


def test_the_commands_are_those_of_the_parser():
    text = describe_commands(make_parser())
    for command in ("run", "replay", "suite run", "suite defaults", "guide", "completion"):
        assert f"## crashhunt {command}\n" in text
    assert "- `--scenario NAME|PATH`: " in text
    assert "`crashhunt status DIR [DIR ...]`" in text
    assert "`crashhunt suite run FILE DIR [PARALLEL]`" in text
    assert text in text_of("commands")


def test_the_python_reference_has_what_users_import():
    text = text_of("api")
    described = re.findall(r"^### (\S+)\.(\w+)$", text, re.MULTILINE)
    for name, public in described:
        assert getattr(importlib.import_module(name), public).__doc__, f"{name}.{public}"
    for name in ("crashhunt", "crashhunt.agents", "crashhunt.errors", "crashhunt.testing"):
        offered = {one for one in dir(importlib.import_module(name)) if one[0].isalpha() and not one.isupper()}
        assert {public for module, public in described if module == name} == offered
    assert ("crashhunt.results", "HuntResults") in described
    assert "run(\n    directory: Path | str," in text
    assert "    snapshot_limit_mb: float = 500.0,\n" in text
    assert "'process_died', 'hang')" in text
    assert "- `parallel`: number of trials at a time; 0 for one per core." in text
    assert "**`act(observation: Any) -> Any`**" in text
    assert "(observation: Any, self" not in text


def test_the_keys_are_those_of_the_files():
    text = describe_keys()
    scenario, _, suite = text.partition("## suite.toml")
    for key in ("step_length_s", "warmup_s", "depart_lane", "net", "off_road", "reward_below", "features", "unit"):
        assert f"- `{key}`: " in scenario
    assert "not part of" not in scenario
    assert "- `tables`" not in scenario
    assert "- `folder`" not in scenario
    for key in ("id", "runs", "trials", "arguments", "keep_going", "oracles"):
        assert suite.count(f"- `{key}`: ") == 1


def test_keys_of_outputs_are_those_of_the_schemas():
    text = describe_json()
    assert '{"commit": string|null, "subject", "candidates": [], "tried": {…:\n' in text  # of bisect
    assert '"warnings": [], "kept?"}]}' in text  # of corpus run: a key that may be missing
    assert '"training": [{"id", "hunt", "path", "seed"}], "held_out": [{as "training"}]' in text
    assert '"certain": {"low": number|null, "high": number|null}|null, "estimated": {"low"' in " ".join(text.split())


def test_names_in_the_texts_of_parts_are_code():
    text = text_of("observation-parts")
    assert "| `left` |  | 0:1 | with relation=true only: 1 if `same_lane` is 0, " in text
    assert "followed as far as `radius` |" in text


def test_every_module_is_listed_with_what_it_is_about():
    text = describe_modules()
    package = Path(crashhunt.__file__).parent
    files = [file for kind in ("py", "cpp", "hpp", "html", "css", "js") for file in package.rglob(f"*.{kind}")]
    modules = [file for file in files if file.name != "__init__.py"]
    assert sum(line.startswith("- `") for line in text.splitlines()) == len(modules)
    assert "## crashhunt/base\n" in text
    assert "\n- `files.py`: Files that are complete or absent, even after a power failure.\n" in text
    assert "\n    - `_STOP_M` = 5.0 in `sumo/_traffic_events.py`: a vehicle that stands within this distance" in text
    assert "\n    - `_LOOK_S, _MIN_LOOK_M` = 0.5, 4.0 in `sumo/_free_motion.py`: how far ahead" in text


def test_every_file_that_the_architecture_names_is_there():
    text = find_page("architecture").file.read_text()
    top = Path(crashhunt.__file__).parent
    for name in re.findall(r"`((?:\w+/)+\w+\.(?:py|cpp|hpp|html|js))`", text):
        if "NAME" not in name:
            assert (top / name).is_file() or (top.parent / name).is_file(), name


SPY = """
import traceback
from contextlib import suppress

class Spy:
    def reset(self, seed): ...

    def act(self, observation):
        with suppress(FileExistsError), open({file!r}, "x") as file:  # not in the confirmation
            file.write("\\n".join(frame.filename for frame in traceback.extract_stack()))
        raise ValueError
"""


def test_files_of_one_trial_are_those_of_the_stacks_of_its_processes(toy, monkeypatch):
    text = find_page("architecture").file.read_text().partition("## The way of one trial")[2].partition("1. **Req")[0]
    listed = set(re.findall(r"`([\w/]+\.py)`", text))
    (toy.folder / "spy.py").write_text(SPY.format(file=str(toy.folder / "stack")))
    monkeypatch.chdir(toy.folder)
    stacks = []

    def record(place, name):
        original = getattr(place, name)

        def call(*given, **more):
            monkeypatch.setattr(place, name, original)  # the confirmation calls it as well
            stacks.extend([*(frame.filename for frame in traceback.extract_stack()), inspect.getfile(original)])
            return original(*given, **more)

        monkeypatch.setattr(place, name, call)

    record(importlib.import_module("crashhunt.plans._plan"), "sampler_of")
    record(importlib.import_module("crashhunt.executors._pool").PoolExecutor, "submit")
    record(importlib.import_module("crashhunt.recording"), "write_log")
    words = ["run", "h", "1", "1", "9", "--scenario", "toy", "--agent", "spy:Spy"]
    options = make_parser().parse_args(words)
    assert options.command(options, words) == 0
    top = f"{Path(crashhunt.__file__).parent}/"
    found = {file.removeprefix(top) for file in (*stacks, *(toy.folder / "stack").read_text().splitlines())}
    found = {file for file in found if file.endswith(".py") and not file.startswith(("/", "base/", "<", "cli/__"))}
    assert found <= listed
    # The supervisor runs no code of a test, the records are written between two calls of agents, and this is the toy.
    assert listed - found == {"executors/_supervisor.py", "recording/_blackbox.py", "sumo/_simulator.py"}
    assert len(listed) <= 13
    assert sum(len((Path(top) / file).read_text().splitlines()) for file in listed) <= 5_000


def test_table_of_packages_has_all_of_them_in_the_order_of_their_imports():
    top = Path(crashhunt.__file__).parent
    text = find_page("architecture").file.read_text()
    table = text.partition("## The packages")[2].partition("\n\n`crashhunt`, ")[0]
    rows = [re.findall(r"`(\w+)`", line.split("|")[2]) for line in table.splitlines() if line.startswith("|")]
    contracts = tomllib.loads((top.parent / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    (layers,) = (one["layers"] for one in contracts if one["type"] == "layers" and "crashhunt.cli" in one["layers"])
    place = {name.split(".")[1]: at for at, layer in enumerate(layers) for name in layer.split(" | ")}
    assert {name for row in rows for name in row} == place.keys()
    places = [[place[name] for name in row] for row in rows if row]
    assert all(max(row) < min(below) for row, below in pairwise(places))


def test_a_topic_that_is_none_is_refused_from_python_too():
    with pytest.raises(UsageError, match="no topic 'x'"):
        find_page("x")


def test_what_represents_the_reference_in_the_file_is_not_shown():
    for topic in ("commands", "api", "json", "toml", "modules"):
        assert "shows them" in find_page(topic).file.read_text()
        assert "shows them" not in text_of(topic)
