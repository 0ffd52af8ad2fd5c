"""How well crash types agree with planted bugs: by signature, and divided by cause. Run it as ``scripts/causes``.

Agents with two or three planted bugs are hunted. The label of a crash is the set of bugs without each of which the same
trial has no crash with the same two actors until 5 s after it. A crash with an empty set does not count: the agent
without any bug has it, too, or each of several bugs suffices. The adjusted Rand index (Hubert and Arabie 1985) compares
types with the labels of the crashes that need a single bug: 1 is equal, 0 chance. A crash that needs several bugs has
no single label: removing either one is a fix. The bug of them that acted last is compared as well. Its cause is
consistent if it is also the cause of crashes that need one of these bugs alone, and of no crash that needs another bug
alone.

    scripts/causes --folder DIR [--trials N] [--judge N] [SCENARIO|FILE.sumocfg:BUGS…]     goes on where it was
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
from collections import Counter
from dataclasses import replace
from math import comb
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from crashhunt.base import layout
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
    ("motorway", "sign+wrong_side"), ("motorway", "sign+frozen+off_edge"), ("highway", "late+blind_ahead"),
)  # fmt: skip
_TITLES = (
    "scenario", "bugs", "crashes", "need no bug, with an omission", "need one bug", "of bugs", "ARI types",
    "ARI types and causes", "ARI causes alone", "ARI of all, the bug that acted last (crashes)", "need several",
    "consistent", "contradictory", "hidden by --keep 3",
)  # fmt: skip
_AFTER_S = 5.0
_KEEP = 3


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
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--judge", type=int, default=8)
    given = parser.parse_args()
    given.folder = given.folder.resolve()
    given.folder.mkdir(parents=True, exist_ok=True)
    shutil.copy(Path(__file__).with_name("planted_bugs.py"), given.folder)
    print(f"| {' | '.join(_TITLES)} |")
    print(f"{'| --- ' * len(_TITLES)}|", flush=True)
    chosen = [tuple(one.rsplit(":", 1)) for one in given.only] or AGENTS
    for scenario, bugs in chosen:
        store = given.folder / f"{Path(scenario).stem}-{bugs}.json"
        if not store.is_file():
            store.write_text(json.dumps(_studied(scenario, bugs, given)), encoding="utf-8")
        print(_line(json.loads(store.read_text(encoding="utf-8"))), flush=True)
    return 0


def _studied(scenario: str, bugs: str, given: argparse.Namespace) -> dict[str, Any]:
    hunt = given.folder / f"{Path(scenario).stem}-{bugs}"
    named = str(Path(scenario).resolve()) if Path(scenario).is_file() else scenario
    if not (hunt / "ledger.sqlite").is_file():
        command = [sys.executable, "-m", "crashhunt", "run", str(hunt), str(len(os.sched_getaffinity(0)))]
        command += [str(given.trials), str(given.steps), "--scenario", named, "--agent", "planted_bugs:Planted"]
        command += ["--arg", f"bugs={bugs}", "--arg", "desired_speed=18:28", "--seed", str(given.seed)]
        command += ["--keep-going"]
        command += ["--action", "continuous"] if scenario == "motorway" else []
        subprocess.run(command, check=True, capture_output=True, cwd=given.folder)
    rows = []
    bundles = list_bundles(hunt)
    labels = _labels(bundles, bugs.split("+"))
    for group in group_crashes(bundles).groups:
        for part in divide_by_cause(group, ReplayOptions(trusted=True), most=given.judge, parallel=2, write=False):
            rows += [
                {
                    "crash": bundle.id,
                    "needs": [name for name in labels[bundle.id] if name] if "" in labels[bundle.id] else [],
                    "last": _last_bug(bundle, labels[bundle.id]),
                    "has_no_bug": "" not in labels[bundle.id],
                    "type": str(group.signature),
                    "cause": str(part.cause),
                    "judged": bundle in part.judged,
                    "steps": bundle.result.steps,
                }
                for bundle in part.members
            ]
    return {"scenario": Path(scenario).stem, "bugs": bugs, "rows": rows}


def _labels(bundles: Sequence[Bundle], bugs: Sequence[str]) -> dict[str, list[str]]:
    """Return the bugs that each crash needs, by runs of its trial without one bug at a time; "" is all of them."""
    found: dict[str, list[str]] = {bundle.id: [] for bundle in bundles}
    if not bundles:
        return found
    reruns = [prepare(bundle, ReplayOptions(trusted=True)) for bundle in bundles]
    asked = [(bundle, bug) for bundle in bundles for bug in (*bugs, "")]
    specs = []
    for rerun in reruns:
        longer = rerun.bundle.result.steps + round(_AFTER_S / rerun.recorded.prologue.step_length_s)
        for bug in (*bugs, ""):
            given = {**rerun.spec.arguments["ego"], "bugs": "+".join(name for name in bugs if bug and name != bug)}
            specs.append(replace(rerun.spec, arguments={"ego": given}, max_steps=longer))
    with TemporaryDirectory(prefix="crashhunt-causes-") as scratch:
        runs = Reruns(reruns[0], Path(scratch), parallel=2, stopped=lambda: False)
        for ended in runs.run(specs, recorded=False):
            bundle, bug = asked[ended.place]
            if not _is_same(ended.result, bundle.result):
                found[bundle.id].append(bug)
        runs.close()
    return found


def _last_bug(bundle: Bundle, needs: Sequence[str]) -> str:
    """Return the needed bug that changed an action last, as the agent has printed it; empty if there is none."""
    lines = (bundle.path / layout.RUN_LOG).read_text(encoding="utf-8").splitlines()
    acted = [line.split()[1] for line in lines if line.startswith("PLANTED ")]
    return next((bug for bug in reversed(acted) if bug in needs), "")


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
    rows = [row for row in study["rows"] if row["needs"]]
    single = [row for row in rows if len(row["needs"]) == 1]
    labels = [row["needs"][0] for row in single]
    types, causes = [row["type"] for row in single], [(row["type"], row["cause"]) for row in single]
    merged = [row["cause"] for row in single]
    of_cause: dict[str, set[str]] = {}
    for row in single:
        of_cause.setdefault(row["cause"], set()).add(row["needs"][0])
    several = [(of_cause.get(row["cause"], set()), {*row["needs"]}) for row in rows if len(row["needs"]) > 1]
    consistent = sum(bool(bugs) and bugs <= needs for bugs, needs in several)
    contradictory = sum(not bugs <= needs for bugs, needs in several)
    indices = [f"{adjusted_rand_index(labels, found):.2f}" for found in (types, causes, merged)]
    last = [(row["last"], row["cause"]) for row in rows if row["last"]]
    indices.append(f"{adjusted_rand_index(*zip(*last, strict=True)):.2f} ({len(last)})" if last else "-")
    hidden = [", ".join(sorted({*labels} - _kept(rows, key))) or "none" for key in ("type", "cause")]
    none = [row for row in study["rows"] if row["has_no_bug"]]
    claimed = sum(row["judged"] and row["cause"].startswith("omission") for row in none)
    cells = [
        study["scenario"],
        study["bugs"],
        len(study["rows"]),
        f"{len(none)}, {claimed}",
        len(single),
        len({*labels}),
        *indices,
        len(several),
    ]
    return f"| {' | '.join(map(str, [*cells, consistent, contradictory]))} | {hidden[0]}; by cause {hidden[1]} |"


def _kept(rows: list[dict[str, Any]], key: str) -> set[str]:
    """Return the bugs of the crashes that are kept: the shortest few of each type, or of each type and cause."""
    kept: set[str] = set()
    for name in {(row["type"], row[key]) for row in rows}:
        those = sorted((row for row in rows if (row["type"], row[key]) == name), key=lambda row: row["steps"])
        kept |= {bug for row in those[:_KEEP] for bug in row["needs"]}
    return kept


if __name__ == "__main__":
    sys.exit(main())
