"""Whether the crashes of the shipped scenarios were put there, and whether the rules of fault agree with runs.

Of each collision with somebody else that a hunt finds, a few runs are made. From the first step on the agent brakes, or
changes lanes to either side and brakes: where it meets the same one each time, the agent was put into it. And what the
last of agent and other one did before it is left out, one thing at a time, as `crashhunt judge` does; the agent brakes
two seconds before. That is compared with whom the rules of fault blame, which read the recording only, and with who had
the other one in front of it when they touched.

    scripts/judged [--trials N] [--crashes N] [--folder DIR] [SCENARIO…]
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

from crashhunt.crashes import ending_of, list_bundles, overruled_trial
from crashhunt.replays import ReplayOptions, Rerun, prepare
from crashhunt.replays._warm import Reruns
from crashhunt.replays._why import _Search
from crashhunt.triage import fault_of
from crashhunt.trial import Outcome

if TYPE_CHECKING:
    from crashhunt.crashes import Bundle

_SCENARIOS = (
    "loop", "loop-two-agents", "intersection", "merge", "motorway", "highway", "highway-policy", "roundabout",
    "merge-highway-env", "intersection-highway-env", "intersection-two-agents",
)  # fmt: skip
_MANOEUVRES = ("brake", "left", "right")
_BEFORE_S = 2.0
_KEPT = 4  # of each kind


def main() -> int:
    """Hunt, judge, and print a line for each scenario and each rule."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("scenarios", nargs="*", default=_SCENARIOS)
    parser.add_argument("--trials", type=int, default=60)
    parser.add_argument("--crashes", type=int, default=12)
    parser.add_argument("--max-steps", type=int, default=600)
    parser.add_argument("--folder", type=Path, default=None)
    given = parser.parse_args()
    folder = given.folder or Path(tempfile.mkdtemp(prefix="crashhunt-judged-"))
    folder.mkdir(parents=True, exist_ok=True)
    found = []
    for name in given.scenarios:
        hunt = folder / name
        command = [sys.executable, "-m", "crashhunt", "run", str(hunt), str(len(os.sched_getaffinity(0)))]
        command += [str(given.trials), str(given.max_steps), "--scenario", name, "--seed", "1", "--keep-going"]
        command += ["--keep", str(_KEPT)]  # the shortest are those that may have been put there
        subprocess.run(command, check=True, capture_output=True)
        for bundle in sorted(_collisions(hunt), key=lambda one: one.result.steps)[: given.crashes]:
            told = {"scenario": name, **_judged(bundle)}
            found.append(told)
            with (folder / "judged.jsonl").open("a", encoding="utf-8") as file:
                file.write(f"{json.dumps(told)}\n")
        print(_about_scenario(name, len(_collisions(hunt)), [each for each in found if each["scenario"] == name]))
    print(_about_rules(found))
    return 0


def _collisions(hunt: Path) -> list[Bundle]:
    return [
        bundle
        for bundle in list_bundles(hunt)
        if bundle.result.outcome is Outcome.COLLISION and bundle.result.collision and bundle.result.collision.other
    ]


def _judged(bundle: Bundle) -> dict[str, Any]:
    rerun = prepare(bundle, ReplayOptions())
    hit = bundle.result.collision
    assert hit is not None
    fault = fault_of(bundle, rerun.recorded)
    with tempfile.TemporaryDirectory(prefix="crashhunt-judged-") as scratch:
        runs = Reruns(rerun, Path(scratch), parallel=len(os.sched_getaffinity(0)), stopped=lambda: False)
        try:
            first = _overruled(rerun, runs, 0)
            back = max(0, bundle.result.steps - round(_BEFORE_S / rerun.recorded.prologue.step_length_s))
            braked = _overruled(rerun, runs, back, ("brake",))
            without = _without(rerun, runs)
        finally:
            runs.close()
    return {
        "crash": bundle.id, "step": bundle.result.steps, "role": hit.role, "verdict": fault.verdict,
        "rules": [one.rule for one in fault.findings], "first": first, "braked": braked[0], "without": without,
    }  # fmt: skip


def _overruled(rerun: Rerun, runs: Reruns, step: int, manoeuvres: tuple[str, ...] = _MANOEUVRES) -> list[str]:
    result = rerun.bundle.result
    specs = [overruled_trial(result, rerun.recorded, step, None, manoeuvre) for manoeuvre in manoeuvres]
    endings = ["unclear"] * len(specs)
    for ended in runs.run(specs):
        if ended.recording is not None and ended.result.outcome is not Outcome.INVALID:
            endings[ended.place] = ending_of(result, rerun.recorded, step, ended.result, ended.recording)
        elif ended.result.outcome is Outcome.INVALID:
            endings[ended.place] = "cannot"
    return endings


def _without(rerun: Rerun, runs: Reruns) -> list[tuple[str, str, list[str]]]:
    """What agent and other one did, each with what became of the collision without it."""
    search = _Search(rerun)
    hit = rerun.bundle.result.collision
    assert hit is not None
    found = []
    for asked in search.asked():
        factor = asked.factor
        if not asked.inside or factor.name not in (hit.agent, hit.other) or factor.what == "there":
            continue
        ended = runs.run([spec for _, spec in asked.runs[:1]])
        endings = [str(search.ending(asked, one.place, one).ending) for one in ended]
        found.append(("ego" if factor.name == hit.agent else "the other", factor.what, endings))
    return found


def _about_scenario(name: str, crashes: int, found: list[dict[str, Any]]) -> str:
    invalid = sum(_was_put(each) for each in found)
    return f"{name}: {crashes} collisions, {len(found)} looked at, {invalid} invalid"


def _was_put(told: dict[str, Any]) -> bool:
    first = told["first"]
    return first[0] == "hit" and all(ending in ("hit", "other", "cannot") for ending in first)


def _about_rules(found: list[dict[str, Any]]) -> str:
    """For each rule and whom it blames: who touched with the front, and what would have avoided it."""
    lines = [
        "rule, blames: n | blamed is collider | braking 2 s before avoids | blamed's doing | the other party's doing"
    ]
    keys = Counter(
        (rule, told["verdict"]) for told in found for rule in told["rules"][:1] if told["verdict"] != "nobody can tell"
    )
    for (rule, verdict), count in sorted(keys.items()):
        those = [told for told in found if told["rules"][:1] == [rule] and told["verdict"] == verdict]
        front = sum((told["role"] == "collider") == (verdict == "ego") for told in those)
        braked = sum(told["braked"] == "avoided" for told in those)
        own, others = (_avoided_by(those, [verdict] if mine else [_partner(verdict)]) for mine in (True, False))
        lines.append(f"{rule}, {verdict}: {count} | {front} | {braked} | {own} | {others}")
    silent = [told for told in found if told["verdict"] == "nobody can tell"]
    lines.append(f"nobody can tell: {len(silent)} of {len(found)}")
    return "\n".join(lines)


def _partner(verdict: str) -> str:
    return "ego" if verdict == "the other" else "the other"


def _avoided_by(those: list[dict[str, Any]], who: list[str]) -> str:
    """In how many one of these did something without which no run had the same two collide; of how many."""
    asked = [
        [ends for actor, _, ends in told["without"] if actor in who and set(ends) != {"unclear"}] for told in those
    ]
    asked = [each for each in asked if each]
    helped = sum(any("same" not in ends and "unclear" not in ends for ends in each) for each in asked)
    return f"{helped} of {len(asked)}"


if __name__ == "__main__":
    raise SystemExit(main())
