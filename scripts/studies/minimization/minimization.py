"""How small crashes become: of all shipped scenarios, and of towns. Run it as ``scripts/studies/run minimization``.

Each is hunted until there are enough crashes, always with the same seed; the first ones are shrunk, each by a
``crashhunt shrink`` of its own, and what is left is replayed by a process of its own. What is told of each scenario:
how many were reproduced to the bit, how many took part before and after, how many trials and steps that took, and how
much processor time, with that of the workers. Towns are made by netgenerate, or are examples of eclipse-sumo.

    scripts/studies/run minimization --crashes 4 --folder DIR       resumes; skips crashes that are minimized
    scripts/studies/run minimization --table                        of the stored results
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

STORED = Path(__file__).with_suffix(".jsonl")
SEED = 1
MOST_TRIALS = 640
SHIPPED = {
    "loop": 600, "loop-two-agents": 600, "intersection": 600, "merge": 600, "motorway": 600, "highway": 200,
    "highway-policy": 60, "roundabout": 200, "merge-highway-env": 200, "intersection-highway-env": 200,
    "intersection-two-agents": 200,
}  # fmt: skip
"""Scenario to the bound on its trials, in steps."""
_BIG = 2  # of a town there are half as many


@dataclass(frozen=True, slots=True)
class Town:
    """A town that is not shipped.

    Args:
        network: what netgenerate is to make; without, it is one of eclipse-sumo's examples, by its name.
        period: how often a vehicle sets out, in s.
        words: of the hunt.
    """

    network: tuple[str, ...] = ()
    period: float = 1.0
    words: tuple[str, ...] = ("--agent", "car-following", "--arg", "delay_s=0:1", "--arg", "headway_s=0.3:2")


_LIT = ("--tls.guess", "true", "--default.lanenumber", "2", "--no-turnarounds.except-deadend", "true")
TOWNS = {
    "grid with lights": Town(("--grid", "--grid.number", "5", "--grid.length", "150", *_LIT), 0.6),
    "spider": Town(("--spider", "--spider.arm-number", "7", "--spider.circle-number", "4"), 0.6),
    "A10KW": Town(words=("--arg", "speed=5:20")),
    "corridor": Town(words=("--arg", "speed=5:20")),
}


def made(name: str, folder: Path) -> Path:
    """Return the configuration of a town, made where it is not there."""
    home = _sumo_home()
    town = TOWNS[name]
    if not town.network:
        return home / "tools" / "game" / f"{name}.sumocfg"
    folder.mkdir(parents=True, exist_ok=True)
    files = [folder / f"town.{end}" for end in ("net.xml", "rou.xml", "sumocfg")]
    if files[2].exists():  # its hunt goes on only with the same files, which say when they were made
        return files[2]
    subprocess.run([home / "bin" / "netgenerate", *town.network, "-o", files[0]], check=True, capture_output=True)
    tool = [sys.executable, str(home / "tools" / "randomTrips.py"), "-n", str(files[0]), "-r", str(files[1])]
    words = ["--period", str(town.period), "--end", "600", "--seed", str(SEED), "--fringe-factor", "5", "--validate"]
    environment = {**os.environ, "SUMO_HOME": str(home)}
    subprocess.run([*tool, *words], check=True, capture_output=True, cwd=folder, env=environment)
    files[2].write_text(
        '<configuration><input><net-file value="town.net.xml"/><route-files value="town.rou.xml"/></input>'
        '<time><step-length value="0.1"/></time></configuration>\n'
    )
    return files[2]


def _sumo_home() -> Path:
    if home := os.environ.get("SUMO_HOME"):
        return Path(home)
    found = find_spec("sumo")
    if found is None or found.origin is None:
        sys.exit("towns need eclipse-sumo: pip install 'crashhunt[maps]', or set SUMO_HOME")
    return Path(found.origin).parent


def crashes_of(name: str, wanted: int, folder: Path) -> tuple[Path, list[str]]:
    """Hunt until there are enough; return the hunt, and the first ones of its crashes."""
    hunt = folder / name.replace(" ", "-")
    if name in TOWNS:
        words = ["--scenario", str(made(name, folder / f"{hunt.name}-town")), *TOWNS[name].words]
        steps = 600
    else:
        words, steps = ["--scenario", name], SHIPPED[name]
    trials = 20
    while True:
        given = ["run", str(hunt), "2", str(trials), str(steps), "--seed", str(SEED), "--keep-going", *words]
        subprocess.run([sys.executable, "-m", "crashhunt", *given], check=True, capture_output=True)
        found = sorted(path.name for path in (hunt / "crashes").glob("*") if _is_crash(path))
        if len(found) >= wanted or trials >= MOST_TRIALS:
            return hunt, found[:wanted]
        trials *= 2


def _is_crash(bundle: Path) -> bool:
    return not bundle.name.startswith(".") and not bundle.name.endswith(".small")


def shrunk(name: str, hunt: Path, crash: str, *, parallel: int, budget: int) -> dict[str, Any]:
    """Shrink a crash, and replay what is left, in a process each."""
    started = time.monotonic()
    words = ["shrink", hunt, "--crash", crash, "--parallel", parallel, "--budget", budget, "--json"]
    told, cpu_s = _ran(*map(str, words))
    wall_s = time.monotonic() - started
    verdict = ""
    if told["path"]:
        verdict = _ran("replay", str(hunt), "--crash", Path(told["path"]).name, "--json")[0]["verdict"]
    keys = (
        "verdict", "ended", "confirmed", "actors_before", "actors_after", "steps_before", "steps_after", "steps_cut",
        "trials_run", "steps_run",
    )  # fmt: skip
    row = {"scenario": name, "crash": crash, **{key: told[key] for key in keys}}
    row["scripted"] = told["scripted"] is not None
    return {**row, "replayed": verdict, "cpu_s": round(cpu_s, 1), "wall_s": round(wall_s, 1)}


def _ran(*words: str) -> tuple[dict[str, Any], float]:
    """Run a command; return what it prints, and the processor time that it and its processes have taken."""
    before = os.times()
    done = subprocess.run([sys.executable, "-m", "crashhunt", *words], capture_output=True, text=True, check=False)
    after = os.times()
    told: dict[str, Any] = json.loads(done.stdout or "{}")
    if not told or "error" in told:
        raise RuntimeError(f"crashhunt {' '.join(words)}: {done.stdout}{done.stderr}")
    children = after.children_user + after.children_system - before.children_user - before.children_system
    return told, children


def table(rows: list[dict[str, Any]]) -> str:
    """Return the results as Markdown."""
    lines = [
        "| crashes of | n | to the bit | seen before | left | 3 at most | scripted | trials | steps | CPU, s |",
        "| --- |" + " --- |" * 9,
    ]
    shipped = [row for row in rows if row["scenario"] in SHIPPED]
    towns = [row for row in rows if row["scenario"] in TOWNS]
    names = [name for name in (*SHIPPED, *TOWNS) if any(row["scenario"] == name for row in rows)]
    lines += [_line(name, [row for row in rows if row["scenario"] == name]) for name in names]
    for title, some in (("**shipped**", shipped), ("**towns**", towns), ("**all**", rows)):
        if some:
            lines.append(_line(title, some))
    return "\n".join(lines)


def _line(title: str, rows: list[dict[str, Any]]) -> str:
    before, after, trials, steps, cpu = (
        [row[key] for row in rows] for key in ("actors_before", "actors_after", "trials_run", "steps_run", "cpu_s")
    )
    same = sum(_is_reproduced(row) for row in rows)
    few = sum(count <= 3 for count in after)
    cells = [
        title, len(rows), same, _middle(before), f"{_middle(after)} (most {max(after)})", few,
        sum(row["scripted"] for row in rows), _middle(trials), _middle(steps), f"{_middle(cpu)} (most {max(cpu):.0f})",
    ]  # fmt: skip
    return f"| {' | '.join(map(str, cells))} |"


def _is_reproduced(row: dict[str, Any]) -> bool:
    """Whether it came again, to the bit; of what could not be made smaller, whether the crash itself did."""
    if row["verdict"] == "unchanged":
        return bool(row["confirmed"])
    return bool(row["replayed"] == "reproduced" and row["confirmed"])


def _middle(values: list[float]) -> str:
    return f"{statistics.median(values):g}"


def _stored(file: Path) -> list[dict[str, Any]]:
    if not file.exists():
        return []
    return [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines() if line.startswith("{")]


def main() -> None:
    """Shrink what was asked for, or show what has been."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n\n")[0])
    parser.add_argument("names", nargs="*", help=f"some of {', '.join((*SHIPPED, *TOWNS))}; all without")
    parser.add_argument("--crashes", type=int, default=4, help="of each scenario; of a town half as many")
    parser.add_argument("--budget", type=int, default=500, help="trials for each")
    parser.add_argument("--parallel", type=int, default=2, help="of these at a time")
    parser.add_argument("--folder", type=Path, help="where the hunts are; kept, and gone on from")
    parser.add_argument("--table", action="store_true", help="show the stored results")
    parser.add_argument("--store", action="store_true", help=f"keep the results in {STORED.name}")
    given = parser.parse_args()
    if given.table:
        print(table(_stored(STORED)))
        return
    folder = given.folder or Path(tempfile.mkdtemp(prefix="crashhunt-shrunk-"))
    folder.mkdir(parents=True, exist_ok=True)
    kept = folder / "shrunk.jsonl"
    names = given.names or [*SHIPPED, *TOWNS]
    for name in names:
        wanted = max(1, given.crashes // _BIG) if name in TOWNS else given.crashes
        hunt, crashes = crashes_of(name, wanted, folder)
        known = {row["crash"] for row in _stored(kept) if row["scenario"] == name}
        for crash in crashes:
            if crash not in known:
                row = shrunk(name, hunt, crash, parallel=given.parallel, budget=given.budget)
                print(json.dumps(row), file=sys.stderr, flush=True)
                with kept.open("a", encoding="utf-8") as file:
                    file.write(f"{json.dumps(row)}\n")
    rows = [row for row in _stored(kept) if row["scenario"] in names]
    print(table(rows))
    if given.store:
        STORED.write_text("".join(f"{json.dumps(row)}\n" for row in rows), encoding="utf-8")


if __name__ == "__main__":
    main()
