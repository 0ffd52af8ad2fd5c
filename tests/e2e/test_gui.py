"""The simulator's own window, on a virtual screen."""

from __future__ import annotations

import subprocess
import time

import numpy as np
import pytest
from browsers import needed
from PIL import ImageGrab

from crashhunt.replays import _debugger
from crashhunt.trial import Outcome, TrialResult, TrialSpec

ORANGE, RED = (224, 138, 0), (198, 40, 40)


@pytest.fixture
def screen():
    command = [needed("Xvfb"), "-displayfd", "1", "-screen", "0", "1280x1024x24", "-nolisten", "tcp"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as server:
        assert server.stdout is not None
        yield f":{server.stdout.readline().strip()}"
        server.terminate()


def hunted(shell):
    words = ("--arg", "speed=20", "--seed", "1", "--crash-on", "collision")
    shell.crashhunt("run", "h", "1", "9", "800", *words)


@pytest.fixture
def crash(shell, made_once):
    return made_once(hunted, shell)


def seen(screen: str) -> dict[str, int]:
    """How many pixels of the two vehicles are on the screen."""
    picture = np.asarray(ImageGrab.grab(xdisplay=screen).convert("RGB"))
    return {name: int((picture == color).all(axis=2).sum()) for name, color in (("ego", ORANGE), ("other", RED))}


def read_until(stream, text: str) -> str:
    """What a process has printed, up to some text without a line end."""
    found = ""
    while text not in found:
        letter = stream.read(1)
        assert letter, found
        found += letter
    return found


@pytest.mark.nightly
@pytest.mark.long
def test_the_window_follows_the_ego_and_pauses_before_the_crash(crash, screen):
    crash.environment["DISPLAY"] = screen
    process = crash.start("replay", "h", "--gui", "--sleep", "0", stdin=subprocess.PIPE)
    assert process.stdin is not None
    assert process.stdout is not None
    read_until(process.stdout, "Press Enter to see what happens: ")
    deadline = time.monotonic() + 300
    while min(seen(screen).values()) <= 20:  # it paints on a thread of its own
        assert time.monotonic() < deadline, seen(screen)
        time.sleep(0.1)
    process.stdin.write("\n")
    process.stdin.flush()
    read_until(process.stdout, "Press Enter to close the window: ")
    out, _ = process.communicate("\n", timeout=150)
    assert process.returncode == 0
    assert "reproduced" in out  # the window changes nothing, to the bit


@pytest.mark.nightly
def test_no_one_at_the_terminal_is_not_waited_for_and_sleep_slows_it_down(crash, screen):
    crash.environment["DISPLAY"] = screen
    began = time.monotonic()
    process = crash.start("replay", "h", "--gui", "--sleep", "0.5", "--until", "5", "--json", stdin=subprocess.DEVNULL)
    out, err = process.communicate(timeout=300)
    assert time.monotonic() - began > 2.5
    assert process.returncode == 0, err
    assert '"steps_replayed": 5' in out


class Closed:
    """A simulator whose window the user has closed."""

    window_open = False

    def open_window(self):
        pass

    def follow(self, agent, other):
        raise RuntimeError("connection closed by SUMO")


def test_a_simulator_without_its_window_ends_as_closed(monkeypatch, capfd):
    def leave(code):
        raise SystemExit(code)

    monkeypatch.setattr("os._exit", leave)
    window = _debugger._Window(Closed(), {"agent": "ego", "other": "other"})
    ended = TrialResult(TrialSpec(0, 1, {}, {}, 9), Outcome.SIMULATOR_ERROR)
    for call in (lambda: window.begin(None), lambda: window.end(ended)):
        with pytest.raises(SystemExit) as left:
            call()
        assert left.value.code == _debugger._LEFT_EXIT_CODE
        assert capfd.readouterr().err == "the window was closed\n"


@pytest.mark.nightly
@pytest.mark.long
def test_a_closed_window_is_no_divergence(crash, screen):
    crash.environment["DISPLAY"] = screen
    process = crash.start("replay", "h", "--gui", "--sleep", "0.3", stdin=subprocess.DEVNULL)
    keys = needed("xdotool")
    deadline = time.monotonic() + 300
    while time.monotonic() < deadline:
        time.sleep(0.1)
        found = subprocess.run([keys, "search", "--name", "SUMO"], env=crash.environment, capture_output=True,
                               text=True, check=False).stdout.split()  # fmt: skip
        if len(found) and seen(screen)["ego"]:
            break
    subprocess.run([keys, "windowfocus", found[-1], "key", "ctrl+q"], env=crash.environment, check=True)
    out, err = process.communicate(timeout=300)
    assert process.returncode == 130, err
    assert "the window was closed" in err
    assert "diverged" not in out
