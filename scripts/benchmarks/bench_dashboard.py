"""What the dashboard costs, as counts and ratios within one run; for ``scripts/bench dashboard``."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
import urllib.error
import urllib.request
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Iterator

CRASHHUNT = str(Path(sys.executable).parent / "crashhunt")
_TOY = """
schema = 1
simulator = "toy"
[agents.ego]
agent = "crashhunt.agents:KeepLaneWithSpeed"
[agents.ego.arguments.speed]
default = 1.0
range = "1:2"
"""
_CRASH_EVERY = 2_003  # trials of the made-up rows
TRIALS_OF_PAIRS = 300


def toy(place: Path) -> Path:
    """Return a scenario whose trials cost next to nothing."""
    scenario = place / "toy"
    scenario.mkdir(exist_ok=True)
    (scenario / "scenario.toml").write_text(_TOY)
    return scenario


def make_hunt(place: Path, name: str, trials: int) -> Path:
    """Make a real hunt of 100 trials, and grow its ledger with rows like its own.

    Args:
        place: folder to make it in.
        name: of its folder.
        trials: that its ledger has in the end.
    """
    from crashhunt.ledger import Ledger

    hunt = place / name
    words = ["run", str(hunt), "2", "100", "20", "--scenario", str(toy(place)), "--seed", "1", "--keep-going"]
    subprocess.run([CRASHHUNT, *words], check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    with closing(Ledger(hunt / "ledger.sqlite", writable=True)) as ledger:
        rows = [row for _, row in ledger.intact_rows(range(100)) if row is not None]
        made = [(row, json.loads(row[10])) for row in rows if row[2] == "survived"]
        ledger._database.execute("BEGIN")
        for number in range(100, trials):
            row, data = made[number % len(made)]
            danger = number * 0.6180339887 % 1.0
            outcome = "survived" if number % _CRASH_EVERY else "collision"
            data["spec"]["number"], data["outcome"], data["danger"] = number, outcome, danger
            data["spec"]["arguments"]["ego"]["speed"] = 1.0 + number * 0.754877666 % 1.0
            cells = (number, row[1], outcome, row[3], danger * 10, *row[5:10], json.dumps(data), danger, row[12])
            ledger.copy(cells)
        ledger._database.execute("COMMIT")
        ledger.note(planned=max(trials, 100))
    return hunt


@contextmanager
def dashboard(*paths: Path) -> Iterator[tuple[str, int]]:
    """Run the command; yield its address and the number of its process."""
    words = [CRASHHUNT, "dashboard", *map(str, paths), "--port", "0", "--json", "--no-browser"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as process:
        assert process.stdout is not None
        try:
            yield str(json.loads(process.stdout.readline())["url"]).rstrip("/"), process.pid
        finally:
            process.terminate()


def get(url: str, tag: str = "") -> tuple[int, Any, str]:
    """Return status, data and tag of an answer; nothing for data that is known already."""
    request = urllib.request.Request(url, headers={"If-None-Match": tag} if tag else {})
    try:
        with urllib.request.urlopen(request) as answer:
            return answer.status, json.loads(answer.read()), str(answer.headers["ETag"])
    except urllib.error.HTTPError as error:
        if error.code != 304:
            raise
        return 304, None, tag


def memory_mib(pid: int) -> float:
    """Return the memory that a process has for itself, in MiB; without pages of files."""
    status = Path(f"/proc/{pid}/status").read_text()
    return int(status.partition("RssAnon:")[2].split()[0]) / 1024


def cpu_s(pid: int) -> float:
    """Return the processor time of a process, in s."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


@contextmanager
def browser(place: Path, *words: str) -> Iterator[Any]:
    """Open Chromium without a window and without a GPU."""
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    options = webdriver.ChromeOptions()
    options.binary_location = str(shutil.which("chromium"))
    for word in ("headless=new", "no-sandbox", "disable-gpu", "disable-dev-shm-usage", "window-size=1280,1000", *words):
        options.add_argument(f"--{word}")
    options.add_argument(f"--user-data-dir={place / 'chromium'}")
    opened = webdriver.Chrome(options=options, service=Service(shutil.which("chromedriver")))
    try:
        yield opened
    finally:
        opened.quit()


def page_complete_s(opened: Any, url: str) -> float:
    """Return the time from the request of a page until it has drawn everything, in s."""
    began = time.perf_counter()
    opened.get(url)
    while not opened.execute_script("return document.body.dataset.complete === 'true'"):
        if time.perf_counter() - began > 120:
            raise RuntimeError(f"{url} was not complete after 120 s")
        time.sleep(0.01)
    return time.perf_counter() - began


def idle_refresh(pid: int, url: str, times: int = 400) -> float:
    """Return the processor time of the server for one refresh of the page of an idle hunt, in ms."""
    tags = {path: get(url + path)[2] for path in ("",)}
    began = cpu_s(pid)
    for _ in range(times):
        for path, tag in tags.items():
            assert get(url + path, tag)[0] == 304
    return (cpu_s(pid) - began) / times * 1000


def with_and_without_page(place: Path, pairs: int) -> list[float]:
    """Return the ratio of trials/s with the page open to that without it, in pairs that take turns.

    Args:
        place: folder to hunt in.
        pairs: how many.
    """
    ratios = []
    root = place / "pairs"
    root.mkdir()
    with dashboard(root) as (url, _), browser(place) as opened:
        for pair in range(pairs):
            found = {}
            for shown in (pair % 2 == 0, pair % 2 == 1):
                hunt = root / f"{pair}-{'shown' if shown else 'alone'}"
                words = ["run", str(hunt), "1", str(TRIALS_OF_PAIRS), "300", "--scenario", str(toy(place)), "--seed"]
                words += ["1", "--keep-going", "--json"]
                opened.get("about:blank")
                command = [CRASHHUNT, *words]
                with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as process:
                    while shown:
                        rows = [row for row in get(f"{url}/api/hunts")[1]["hunts"] if row["name"] == hunt.name]
                        if rows and rows[0]["state"] == "running":
                            opened.get(f"{url}/hunts/{rows[0]['id']}")
                            break
                        if process.poll() is not None:
                            raise RuntimeError("the hunt ended before the page was open")
                        time.sleep(0.05)
                    assert process.stdout is not None
                    said = json.loads(process.stdout.read())
                found[shown] = said["trials_run"] / said["wall_s"]
            ratios.append(found[True] / found[False])
    return ratios


def identifier_of(hunt: Path) -> str:
    """Return the identifier of a hunt in links, without asking the dashboard, which would read the hunt."""
    from crashhunt.dashboard._catalog import Catalog

    (identifier,) = Catalog([hunt]).hunts()
    return identifier


def draw_ms(opened: Any) -> float:
    """Return how long the player takes to draw a step, in ms."""
    return float(
        opened.execute_script(
            "const began = performance.now();"
            "for (let n = 0; n < 300; n++) { go(n * 7);"
            "document.getElementById('scene').getContext('2d').getImageData(0, 0, 1, 1); }"
            "return (performance.now() - began) / 300;"
        )
    )


def frames_per_second(opened: Any, url: str, seconds: float = 5.0) -> float:
    """Return the frames that a playing crash draws each second."""
    page_complete_s(opened, url)
    # At 10 steps a second of the simulation, 10 times as fast is a new step in each frame of a screen and more.
    opened.execute_script("go(0); document.getElementById('rate').value = '20'; crashhuntView.frames = 0; play();")
    time.sleep(1.0)
    # From one frame to another: the parts of a frame before and after would count as time without one.
    at_frame = "const done = arguments[0]; requestAnimationFrame(at => done([crashhuntView.frames, at]))"
    first, began = opened.execute_async_script(at_frame)
    time.sleep(seconds)
    last, ended = opened.execute_async_script(at_frame)
    return float((last - first) / (ended - began) * 1000)
