"""How well crash types agree with planted bugs: by signature, and divided by cause. Run it as ``scripts/causes``.

Agents with two or three planted bugs are hunted. The label of a crash is the bug without which the same trial has no
crash with the same two actors until 5 s after it; of several such bugs, the one that acted last. A crash without such a
bug is not labelled, and does not count. Crashes that need a single bug are also compared on their own. The
adjusted Rand index (Hubert and Arabie 1985) compares labels with types: 1 is equal, 0 chance.

    scripts/causes --folder DIR [--trials N] [--judge N] [SCENARIO:BUGS…]     goes on where it was
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
from collections import Counter
from dataclasses import replace
from math import comb
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from crashhunt.crashes import group_crashes, list_bundles
from crashhunt.replays import ReplayOptions, prepare
from crashhunt.trial import Outcome
from crashhunt.whatif import Reruns, divide_by_cause

if TYPE_CHECKING:
    from collections.abc import Sequence

    from crashhunt.crashes import Bundle
    from crashhunt.trial import TrialResult

AGENTS = (
    ("loop", "sign+frozen"), ("loop", "wrong_side+frozen"), ("loop", "sign+blind_behind"), ("loop", "sign+off_edge"),
    ("merge", "sign+wrong_side"), ("merge", "frozen+blind_behind"), ("merge", "wrong_side+off_edge"),
    ("merge", "frozen+wrong_side+blind_behind"), ("motorway", "sign+blind_behind"), ("motorway", "frozen+index"),
    ("motorway", "sign+wrong_side"), ("motorway", "sign+frozen+off_edge"),
)  # fmt: skip
_AFTER_S = 5.0
_KEEP = 3
_PLANTED = re.compile(r"PLANTED (\w+) (\d+)")


def adjusted_rand_index(labels: Sequence[object], found: Sequence[object]) -> float:
    """Return the adjusted Rand index of two partitions; 1 where both have a single class, or are all singletons."""
    pairs = sum(comb(count, 2) for count in Counter(zip(labels, found, strict=True)).values())
    of_labels = sum(comb(count, 2) for count in Counter(labels).values())
    of_found = sum(comb(count, 2) for count in Counter(found).values())
    expected = of_labels * of_found / max(1, comb(len(labels), 2))
    most = (of_labels + of_found) / 2
    return 1.0 if most == expected else (pairs - expected) / (most - expected)


def main() -> int:
    """Hunt, divide, and print a line for each agent."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("only", nargs="*", metavar="SCENARIO:BUG+BUG", help="these agents; default: all")
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--trials", type=int, default=30)
    parser.add_argument("--steps", type=int, default=500)
    parser.add_argument("--judge", type=int, default=8)
    given = parser.parse_args()
    given.folder = given.folder.resolve()
    given.folder.mkdir(parents=True, exist_ok=True)
    shutil.copy(Path(__file__).with_name("planted_bugs.py"), given.folder)
    print("| scenario | bugs | crashes | labels | types | by cause | ARI types | ARI by cause | ARI causes alone | "
          "of crashes that need one bug | hidden by --keep 3 |")  # fmt: skip
    print(f"{'| --- ' * 11}|", flush=True)
    chosen = [tuple(one.split(":", 1)) for one in given.only] or AGENTS
    for scenario, bugs in chosen:
        store = given.folder / f"{scenario}-{bugs}.json"
        if not store.is_file():
            store.write_text(json.dumps(_studied(scenario, bugs, given)), encoding="utf-8")
        print(_line(json.loads(store.read_text(encoding="utf-8"))), flush=True)
    return 0


def _studied(scenario: str, bugs: str, given: argparse.Namespace) -> dict[str, Any]:
    hunt = given.folder / f"{scenario}-{bugs}"
    if not (hunt / "ledger.sqlite").is_file():
        command = [sys.executable, "-m", "crashhunt", "run", str(hunt), str(len(os.sched_getaffinity(0)))]
        command += [str(given.trials), str(given.steps), "--scenario", scenario, "--agent", "planted_bugs:Planted"]
        command += ["--arg", f"bugs={bugs}", "--arg", "desired_speed=18:28", "--seed", "7", "--keep-going"]
        command += ["--action", "continuous"] if scenario == "motorway" else []
        subprocess.run(command, check=True, capture_output=True, cwd=given.folder)
    rows = []
    labels = _labels(list_bundles(hunt), bugs.split("+"))
    for group in group_crashes(list_bundles(hunt)).groups:
        for part in divide_by_cause(group, ReplayOptions(trusted=True), most=given.judge, parallel=2, write=False):
            rows += [
                {
                    "crash": bundle.id,
                    "label": labels[bundle.id][0],
                    "needs": labels[bundle.id][1],
                    "type": str(group.signature),
                    "cause": str(part.cause),
                    "judged": bundle in part.judged,
                    "steps": bundle.result.steps,
                }
                for bundle in part.members
            ]
    return {"scenario": scenario, "bugs": bugs, "rows": rows}


def _labels(bundles: Sequence[Bundle], bugs: Sequence[str]) -> dict[str, tuple[str, int]]:
    """Return the bug behind each crash and how many bugs it needs, by runs of its trial without one bug at a time."""
    found: dict[str, tuple[str, int]] = {bundle.id: ("", 0) for bundle in bundles}
    if not bundles:
        return found
    reruns = [prepare(bundle, ReplayOptions(trusted=True)) for bundle in bundles]
    asked = [(bundle, bug) for bundle in bundles for bug in bugs]
    specs = []
    for rerun in reruns:
        longer = rerun.bundle.result.steps + round(_AFTER_S / rerun.recorded.prologue.step_length_s)
        for bug in bugs:
            given = {**rerun.spec.arguments["ego"], "bugs": "+".join(name for name in bugs if name != bug)}
            specs.append(replace(rerun.spec, arguments={"ego": given}, max_steps=longer))
    needed: dict[str, list[str]] = {}
    with TemporaryDirectory(prefix="crashhunt-causes-") as scratch:
        runs = Reruns(reruns[0], Path(scratch), parallel=2, stopped=lambda: False)
        for ended in runs.run(specs, recorded=False):
            bundle, bug = asked[ended.place]
            if not _is_same(ended.result, bundle.result):
                needed.setdefault(bundle.id, []).append(bug)
        runs.close()
    for bundle in bundles:
        acted = {name: int(step) for name, step in _PLANTED.findall((bundle.path / "run.log").read_text())}
        those = needed.get(bundle.id, [])
        found[bundle.id] = max(those, key=lambda name: acted.get(name, 0), default=""), len(those)
    return found


def _is_same(rerun: TrialResult, result: TrialResult) -> bool:
    """Whether a run ends in the same crash: with the same actors, or without a partner in the same way.

    Another crash that follows later, by another bug, is not the same one.
    """
    if rerun.outcome in (Outcome.SURVIVED, Outcome.FINISHED):
        return False
    was, now = result.collision, rerun.collision
    if was is None or now is None:
        return rerun.outcome is result.outcome
    return {was.collider, was.victim} == {now.collider, now.victim}


def _line(study: dict[str, Any]) -> str:
    rows = [row for row in study["rows"] if row["label"]]
    labels = [row["label"] for row in rows]
    types, causes = [row["type"] for row in rows], [(row["type"], row["cause"]) for row in rows]
    merged = [row["cause"] for row in rows]
    single = [row for row in rows if row["needs"] == 1]
    alone = adjusted_rand_index([row["label"] for row in single], [row["cause"] for row in single])
    hidden = [", ".join(sorted({*labels} - _kept(rows, key))) or "none" for key in ("type", "cause")]
    indices = [f"{adjusted_rand_index(labels, found):.2f}" for found in (types, causes, merged)]
    counts = [len(study["rows"]), *(len({*found}) for found in (labels, types, causes))]
    cells = [study["scenario"], study["bugs"], *counts, *indices, f"{alone:.2f} ({len(single)})"]
    return f"| {' | '.join(map(str, cells))} | {hidden[0]}; by cause {hidden[1]} |"


def _kept(rows: list[dict[str, Any]], key: str) -> set[str]:
    """Return the labels of the crashes that are kept: the shortest few of each type, or of each type and cause."""
    kept: set[str] = set()
    for name in {(row["type"], row[key]) for row in rows}:
        those = sorted((row for row in rows if (row["type"], row[key]) == name), key=lambda row: row["steps"])
        kept |= {row["label"] for row in those[:_KEEP]}
    return kept


if __name__ == "__main__":
    sys.exit(main())
