"""Hunt in ten scenarios, film the first crash of each, and write the page of the guide that shows them.

usage: scripts/tools/gallery [SCENARIO…]   (all ten unless some are named; the films of the others stay as they are)
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
FILMS = ROOT / ".github" / "images" / "gallery"
PAGE = ROOT / "crashhunt" / "guide" / "gallery.md"
PROGRAM = Path(sys.executable).with_name("crashhunt")
MAX_BYTES = 3_000_000  # of all films: they are part of every clone

CRASHES = {
    "loop": (300, 1500, "A vehicle that never brakes, on SUMO"),
    "loop-two-agents": (300, 1500, "An overtaker that does not see its blind spot, on SUMO"),
    "merge": (300, 600, "A following vehicle at an on-ramp, on SUMO"),
    "intersection": (300, 600, "A following vehicle at an unsignalised crossing, on SUMO"),
    "motorway": (200, 400, "A learned highway-env policy, on SUMO"),
    "highway": (300, 80, "The intelligent driver model on a motorway, on highway-env"),
    "highway-policy": (200, 40, "A learned policy where it was trained, on highway-env"),
    "merge-highway-env": (300, 200, "A following vehicle past an on-ramp, on highway-env"),
    "roundabout": (300, 200, "A following vehicle in a roundabout, on highway-env"),
    "intersection-highway-env": (300, 200, "A left turn across traffic, on highway-env"),
}
"""Scenarios in the order of the page: at most so many trials, of so many steps, and a heading."""

INTRODUCTION = """\
# Crash gallery

Ten scenarios that crashhunt includes: each command finds the crash of its film. The sentences are from `crashhunt
show`. `scripts/tools/gallery` runs the commands and writes this page.
"""


@dataclass(frozen=True, kw_only=True)
class Exhibit:
    """A crash of the gallery.

    Args:
        scenario: its name.
        title: the heading.
        command: that finds the crash.
        verdict: one sentence: what happened, who is at fault, and until when braking would have helped.
    """

    scenario: str
    title: str
    command: str
    verdict: str


def command_line(*words: str, folder: Path, codes: tuple[int, ...] = (0,)) -> Any:
    """Run a command of crashhunt with ``--json``, and return its object."""
    done = subprocess.run([PROGRAM, *words, "--json"], cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode not in codes:
        sys.exit(f"crashhunt {' '.join(words)}: exit code {done.returncode}\n{done.stderr}")
    return json.loads(done.stdout)


def describe(shown: dict[str, Any]) -> str:
    """Return one sentence on a crash, of what ``crashhunt show --json`` reports."""
    verdict = shown["fault"]["verdict"]
    rules = sorted({finding["rule"] for finding in shown["fault"]["findings"]})
    if verdict == "nobody can tell":
        fault = "fault not decided"
    else:
        who = {"ego": shown["agent"], "the other": shown["other"], "both": "both"}[verdict]
        fault = f"the fault of {who} ({', '.join(rules)})"
    last = shown["last_escape_step"]
    escape = f", avoidable by full braking until step {last}" if last is not None else ""
    return f"{shown['summary']}: {fault}{escape}."


def exhibit(scenario: str, folder: Path) -> Exhibit:
    """Hunt in a scenario and write the film of its crash."""
    trials, steps, title = CRASHES[scenario]
    words = ["run", "out", "2", str(trials), str(steps), "--scenario", scenario, "--seed", "1", "--deterministic"]
    command_line(*words, folder=folder)
    shown = command_line("show", "out", folder=folder)
    film = FILMS / f"{scenario}.gif"
    look = ["--gif", str(film), "--last-seconds", "6", "--size", "400x225", "--no-panels", "--fps", "10"]
    command_line("replay", "out", "--from-log", *look, folder=folder)
    return Exhibit(scenario=scenario, title=title, command=f"crashhunt {' '.join(words)}", verdict=describe(shown))


def page(exhibits: list[Exhibit]) -> str:
    """Return the page of the guide."""
    parts = [
        f"## {shown.title}\n\n![{shown.scenario}](../../.github/images/gallery/{shown.scenario}.gif)\n\n"
        f"{shown.verdict} `{shown.command}`\n"
        for shown in exhibits
    ]
    return "\n".join([INTRODUCTION, *parts])


def main(names: list[str]) -> None:
    """Write the films, what is known of them, and the page."""
    if unknown := [name for name in names if name not in CRASHES]:
        sys.exit(f"no exhibit {unknown[0]!r} (there are {', '.join(CRASHES)})")
    FILMS.mkdir(parents=True, exist_ok=True)
    index = FILMS / "gallery.json"
    known = {entry["scenario"]: Exhibit(**entry) for entry in json.loads(index.read_text())} if index.exists() else {}
    for name in names or CRASHES:
        with tempfile.TemporaryDirectory(prefix="gallery-") as folder:
            known[name] = exhibit(name, Path(folder))
        print(f"{name}: {known[name].verdict}", flush=True)
        exhibits = [known[name] for name in CRASHES if name in known]
        index.write_text(json.dumps([asdict(shown) for shown in exhibits], indent=1) + "\n")
        PAGE.write_text(page(exhibits), encoding="utf-8")
    if (size := sum(film.stat().st_size for film in FILMS.glob("*.gif"))) > MAX_BYTES:
        sys.exit(f"the films have {size} bytes; at most {MAX_BYTES}. Shorten one, or make it smaller")


if __name__ == "__main__":
    main(sys.argv[1:])
