"""Makes a scenario of each map that is given, hunts in it with the starting agent, and prints a row of Markdown each.

Times are processor times of all processes, as the machine may be busy. The maps themselves stay where they are.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path

from crashhunt.errors import CrashhuntError
from crashhunt.sumo.maps import MapSource, check_source
from crashhunt.sumo.maps._convert import ConvertOptions, convert
from crashhunt.sumo.maps._source import kind_of_file
from crashhunt.sumo.maps._tools import find_tools

PROGRAM = Path(sys.executable).with_name("crashhunt")
OPTIONS = {".xodr": "--opendrive", ".osm": "--osm", ".pbf": "--osm", ".xml": "--net", ".gz": "--osm"}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("maps", metavar="FILE", nargs="+", type=Path)
    parser.add_argument("--trials", type=int, default=20, help="of the hunt in each scenario (default: %(default)s)")
    parser.add_argument("--steps", type=int, default=600, help="of a trial at most (default: %(default)s)")
    parser.add_argument("--only-convert", action="store_true", help="only make the networks, and count refusals")
    parser.add_argument("--json", type=Path, help="write all figures here")
    asked = parser.parse_args()
    if asked.only_convert:
        count_refusals(asked.maps)
        return
    print(
        "| map | lanes km | junctions (lights) | init s | jams | vehicles/h | trials | valid | crashes | trials/min |"
    )
    print("| --- | ---: | ---: | ---: | --- | ---: | ---: | ---: | ---: | ---: |")
    found = []
    for path in asked.maps:
        with tempfile.TemporaryDirectory(prefix="maps-") as folder:
            row = measure(path, Path(folder), asked.trials, asked.steps)
        found.append({"map": path.name, **row})
        print(f"| {path.name} | {in_words(row)} |", flush=True)
        if asked.json is not None:
            asked.json.write_text(json.dumps(found, indent=1), encoding="utf-8")


def count_refusals(paths: list[Path]) -> None:
    """Make the network of each map, and print why maps are refused."""
    reasons: Counter[str] = Counter()
    for path in paths:
        kind = kind_of_file(path)
        assert kind is not None
        source = MapSource(kind=kind, path=path)
        try:
            check_source(source)
            with tempfile.TemporaryDirectory(prefix="maps-") as folder:
                made = convert(source, ConvertOptions(), find_tools(), Path(folder))
            reasons["made, with parts omitted" if made.notes else "made"] += 1
        except CrashhuntError as error:
            reasons[error.message.partition(": ")[0]] += 1
            print(f"{path.name}: {error.message}", file=sys.stderr)
    for reason, count in reasons.most_common():
        print(f"| {reason} | {count} |")


def measure(path: Path, folder: Path, trials: int, steps: int) -> dict[str, object]:
    """Return the figures of one map, or why it was refused."""
    made, init_s = run("init", str(folder / "place"), OPTIONS[path.suffix], str(path.resolve()))
    if "error" in made:
        return {"refused": made["error"], "init_s": init_s}
    hunt, hunt_s = run(
        "run", "hunt", "1", str(trials), str(steps), "--scenario", ".", "--agent", "agent:Driver",
        "--seed", "1", "--keep-going", cwd=folder / "place",
    )  # fmt: skip
    return {"init": made, "init_s": init_s, "hunt": hunt, "hunt_s": hunt_s}


def run(*words: str, cwd: Path | None = None) -> tuple[dict[str, object], float]:
    """Return what a command prints as JSON, and its processor time in s."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    environment = {**os.environ, "PYTHONPATH": "."}
    done = subprocess.run(
        [str(PROGRAM), *words, "--json"], capture_output=True, text=True, check=False, cwd=cwd, env=environment
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    try:
        found: dict[str, object] = json.loads(done.stdout)
    except ValueError:
        found = {"error": {"message": done.stderr.strip()[-300:], "fix": "", "where": ""}}
    return found, spent


def in_words(row: dict[str, object]) -> str:
    """Return the cells of a row after the first."""
    if "refused" in row:
        refused = row["refused"]
        assert isinstance(refused, dict)
        return f"refused after {row['init_s']:.1f} s: {refused['message']} |||||||||"
    made, hunt = row["init"], row["hunt"]
    assert isinstance(made, dict)
    assert isinstance(hunt, dict)
    busy = made["plain"][-1]
    jams = "no" if not busy["teleports"] else f"{busy['teleports']} of {busy['entered']}"
    cells = [
        f"{made['lanes_km']:.1f}", f"{made['junctions']} ({made['traffic_lights']})", f"{row['init_s']:.1f}", jams,
        f"{made['vehicles_per_hour']:.0f}",
    ]  # fmt: skip
    if "error" in hunt:
        return " | ".join([*cells, f"{hunt['error']['message']} |||"])
    outcomes = hunt["outcomes"]
    trials = int(hunt["trials_run"])
    rate = trials / (float(str(row["hunt_s"])) / 60)
    cells += [str(trials), str(trials - outcomes.get("invalid", 0)), str(len(hunt["crashes"])), f"{rate:.0f}"]
    return " | ".join(cells)


if __name__ == "__main__":
    main()
