"""Films through the command line: what is in them, with and without the agent's code."""

from __future__ import annotations

import pytest
from PIL import Image
from test_debugger import hunted


@pytest.fixture
def crash(toy, made_once):
    """An agent that prints, and then raises at step 30."""
    return made_once(hunted, toy)


def test_a_film_from_the_log_runs_no_code_at_all(crash):
    (crash.folder / "faulty.py").unlink()
    (code,) = crash.folder.glob("h/snapshots/*/code/faulty.py")
    code.write_text("raise SystemExit('run')", encoding="utf-8")
    done = crash.crashhunt("replay", "h", "--from-log", "--video", "log.mp4", "--size", "320x200", "--json")
    assert done.json["written"] == {"log.mp4": 29 + 1 + 10}
    assert "run" not in done.err.replace("crashhunt", "")


def test_what_the_agent_prints_is_not_shown_while_a_film_is_made(crash):
    done = crash.crashhunt("replay", "h", "--frames", "f", "--last-seconds", "0.2", "--size", "128x128")
    assert "f has" in done.out
    assert "about to go wrong" not in done.out + done.err


def size(path) -> tuple[int, int]:
    with Image.open(path) as image:
        return image.size


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("agent", "where"),
    [
        ("Segfaults", ("--set", "vehicles=10")),
        ("HangsHoldingTheInterpreter", ("--scenario", "toy", "--timeout", "1")),
    ],
)
def test_a_crash_that_kills_the_process_is_filmed_up_to_it(toy, agent, where):
    words = ("--agent", f"faulty:{agent}", "--arg", "at=15", "--seed", "1", *where)
    toy.crashhunt("run", "h", "1", "1", "40", *words)
    done = toy.crashhunt("replay", "h", "--frames", "f", "--size", "128x128", "--json").json
    assert (done["verdict"], done["steps_replayed"]) == ("reproduced", 14)
    assert done["written"] == {"f": 14 + 1 + 10}


def test_bad_options_are_reported_before_anything_is_run(crash):
    for words, message in (  # others in tests/render/test_film.py and tests/cli/test_answers_on_crashes.py
        (("--video", "out.avi"), "--video 'out.avi' does not end in .mp4"),
        (("--video", "a.mp4", "--last-seconds", "nan"), "--last-seconds is nan"),
        (("--gif", "a.gif", "--from-log", "--set", "speed=3"), "--set cannot be used with --from-log, which simulates"),
    ):
        done = crash.crashhunt("replay", "h", *words, expect=2)
        assert message in done.err
        assert "reproduced" not in done.out
    assert not [*crash.folder.glob("*.mp4"), *crash.folder.glob("*.gif")]


@pytest.mark.parametrize(
    ("missing", "word"), [("PIL", "Pillow"), pytest.param("av", "PyAV", marks=pytest.mark.nightly)]
)
def test_what_is_not_installed_is_named(crash, missing, word):
    folder = crash.folder / "hidden"
    folder.mkdir()
    (folder / "sitecustomize.py").write_text(
        f"""
import sys
class Hide:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] == {missing!r}:
            raise ImportError("No module named " + repr(name), name=name)
sys.meta_path.insert(0, Hide())
""",
        encoding="utf-8",
    )
    crash.environment["PYTHONPATH"] = str(folder)
    done = crash.crashhunt("replay", "h", "--from-log", "--video", "a.mp4", expect=2)
    assert word in done.err
    assert "[video]" in done.err
