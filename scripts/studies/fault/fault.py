"""Whether the crashes of the shipped scenarios were put there, and whether the rules of fault agree with runs.

Of each collision with somebody else that a hunt finds, a few runs are made. From the first step on the agent brakes, or
changes lanes to either side and brakes: where it meets the same one each time, the agent was put into it. And what the
last of agent and other one did before it is left out, one thing at a time, as `crashhunt judge` does. That is compared
with whom the rules of fault blame, which read the recording only, and with who had the other one in front of it when
they touched. The one blamed also keeps the duty that the rule names: it brakes two or four seconds before, it stays in
its lane, or it does not make the mistake that the hunt had it make.

    scripts/studies/run fault [--trials N] [--crashes N] [--folder DIR] [SCENARIO…]     these scenarios, or all
    scripts/studies/run fault --put [--trials N]                                        only whether they were put there
    scripts/studies/run fault --towns                                                   in towns that netgenerate makes
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections import Counter
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from towns import TOWNS, make_town

from crashhunt.analysis._causes import _Search
from crashhunt.crashes import ending_of, fault_of, list_bundles, overruled_trial
from crashhunt.replays import ReplayOptions, Rerun, prepare, reruns_of
from crashhunt.trial import KINDS, Disturbance, Outcome

if TYPE_CHECKING:
    from collections.abc import Iterator

    from crashhunt.crashes import Bundle
    from crashhunt.trial import TrialResult
    from crashhunt.trial_reruns import Reruns

_SCENARIOS = (
    "loop", "loop-two-agents", "intersection", "merge", "motorway", "highway", "highway-policy", "roundabout",
    "merge-highway-env", "intersection-highway-env", "intersection-two-agents",
)  # fmt: skip
_MANOEUVRES = ("brake", "left", "right")
_BEFORE_S = (2.0, 4.0)
_KEPT = 4  # of each kind
_VANISHED = ("none", "avoided", "other")  # the two do not collide
_SAYS = (*_VANISHED, "same", "hit")
_EARLIER = 2  # of the runs without something: from when it began, and from half a second before
_TOWNS = ("--ego", "any", "--agent", "erring:Erring", "--arg", "defect=none|asleep|blind")
_MISTAKES = ("--disturb", "ignore_priority=0.2,cut_in=0.1,stop=0.03")


def main() -> int:
    """Hunt, judge, and print a line for each scenario and each rule."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("scenarios", nargs="*")
    parser.add_argument("--trials", type=int, default=60)
    parser.add_argument("--crashes", type=int, default=12)
    parser.add_argument("--max-steps", type=int, default=600)
    parser.add_argument("--folder", type=Path, default=None)
    parser.add_argument("--put", action="store_true", help="only whether the agent was put into its crash")
    parser.add_argument("--towns", action="store_true", help="in towns that netgenerate makes, with others that err")
    parser.add_argument("--told", type=Path, help="print the tables of such a file, and run nothing")
    given = parser.parse_args()
    if given.told is not None:
        found = [json.loads(line) for line in given.told.read_text(encoding="utf-8").splitlines()]
        for name in dict.fromkeys(each["scenario"] for each in found):
            those = [each for each in found if each["scenario"] == name]
            print(_about_scenario(name, those[0]["of"], those))
        print("" if given.put else _about_rules(found))
        return 0
    folder = given.folder or Path(tempfile.mkdtemp(prefix="crashhunt-judged-"))
    folder.mkdir(parents=True, exist_ok=True)
    found = []
    for name in given.scenarios or (TOWNS if given.towns else _SCENARIOS):
        hunt = _hunted(name, given, folder)
        collisions = sorted(_collisions(hunt), key=lambda one: one.result.steps)
        chosen = collisions[: given.crashes]
        for judged in _put(chosen) if given.put else map(_judged, chosen):
            found.append(told := {"scenario": name, "of": len(collisions), **judged})
            with (folder / "judged.jsonl").open("a", encoding="utf-8") as file:
                file.write(f"{json.dumps(told)}\n")
        print(_about_scenario(name, len(collisions), [each for each in found if each["scenario"] == name]), flush=True)
    print("" if given.put else _about_rules(found))
    return 0


def _hunted(name: str, given: argparse.Namespace, folder: Path) -> Path:
    """The directory of a hunt for crashes of a scenario, or in a town."""
    place, hunt, scenario = Path.cwd(), folder / name / "hunt", name
    hunt.parent.mkdir(parents=True, exist_ok=True)
    more: tuple[str, ...] = ()
    if given.towns:
        town = make_town(name, folder / name)
        place, scenario, more = town.parent, town.name, (*_TOWNS, *_MISTAKES)
    command = [sys.executable, "-m", "crashhunt", "run", str(hunt.resolve()), str(len(os.sched_getaffinity(0)))]
    command += [str(given.trials), str(given.max_steps), "--scenario", scenario, "--seed", "1", "--keep-going", *more]
    if not (given.towns or given.put):
        command += ["--keep", str(_KEPT)]  # the shortest are those that may have been put there
    subprocess.run(command, check=True, capture_output=True, cwd=place)
    return hunt


def _collisions(hunt: Path) -> list[Bundle]:
    return [
        bundle
        for bundle in list_bundles(hunt)
        if bundle.result.outcome is Outcome.COLLISION and bundle.result.collision and bundle.result.collision.other
    ]


def _put(bundles: list[Bundle]) -> Iterator[dict[str, Any]]:
    """Whether the agent was put into its crash, of each of a hunt, by the same workers; a run or three for each."""
    if not bundles:
        return
    reruns = [prepare(bundle, ReplayOptions(force=True)) for bundle in bundles]
    with closing(reruns_of(reruns[0], parallel=len(os.sched_getaffinity(0)), stopped=lambda: False)) as runs:
        for bundle, rerun in zip(bundles, reruns, strict=True):
            first = _overruled(rerun, runs, 0, ("brake",))
            more = _overruled(rerun, runs, 0, ("left", "right")) if first == ["hit"] else []
            yield {"crash": bundle.id, "step": bundle.result.steps, "first": [*first, *more]}


def _judged(bundle: Bundle) -> dict[str, Any]:
    rerun = prepare(bundle, ReplayOptions(force=True))
    hit = bundle.result.collision
    assert hit is not None
    told: dict[str, Any] = {"crash": bundle.id, "step": bundle.result.steps, "role": hit.role}
    with closing(reruns_of(rerun, parallel=len(os.sched_getaffinity(0)), stopped=lambda: False)) as runs:
        fault = fault_of(bundle, rerun.recorded)
        told |= {"verdict": fault.verdict, "rules": [one.rule for one in fault.findings]}
        told["first"] = _overruled(rerun, runs, 0)
        told["braked"] = [_overruled(rerun, runs, _before(rerun, each), ("brake",))[0] for each in _BEFORE_S]
        told["without"] = _without(rerun, runs)
        told["other_braked"] = [_stopped_behind(rerun, runs, each) for each in _BEFORE_S]
    return told


def _before(rerun: Rerun, ago_s: float) -> int:
    return max(0, rerun.bundle.result.steps - round(ago_s / rerun.recorded.prologue.step_length_s))


def _stopped_behind(rerun: Rerun, runs: Reruns, ago_s: float) -> str:
    """What comes of it where the one behind the agent brakes, if that is the other one."""
    result, step = rerun.bundle.result, _before(rerun, ago_s)
    hit = result.collision
    assert hit is not None
    if hit.role != "victim" or hit.other in rerun.recorded.agents:
        return "cannot"
    brakes = Disturbance(
        step=step + 1, who="behind", what="stop", how_strong=9.0, how_long=ago_s + 5.0, agent=hit.agent
    )
    spec = overruled_trial(result, rerun.recorded, step, None, "brake")
    before = tuple(one for one in rerun.spec.disturbances if one.step <= step)
    (ended,) = runs.run([replace(spec, overruled=None, disturbances=(*before, brakes))])
    if not any((one.step, one.vehicle) == (step + 1, hit.other) for one in ended.result.disturbances):
        return "cannot"  # it was somebody else who was behind
    return _again(rerun, ended.result)


def _again(rerun: Rerun, result: TrialResult) -> str:
    hit, now = rerun.bundle.result.collision, result.collision
    assert hit is not None
    if result.outcome in (Outcome.SURVIVED, Outcome.FINISHED):
        return "avoided"
    return "hit" if now is not None and {now.collider, now.victim} == {hit.collider, hit.victim} else "other"


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
        ended = runs.run([spec for _, spec in asked.runs[:_EARLIER]])
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
    titles = ("rule, blames: n", "blamed is collider", "keeps its duty: at once + 2 s earlier", "ego brakes 2 s before",
              "without blamed's doing", "without the other party's doing")  # fmt: skip
    lines = [" | ".join(titles)]
    keys = Counter(
        (rule, told["verdict"]) for told in found for rule in told["rules"][:1] if told["verdict"] != "nobody can tell"
    )
    for (rule, verdict), count in sorted(keys.items()):
        those = [told for told in found if told["rules"][:1] == [rule] and told["verdict"] == verdict]
        front = sum((told["role"] == "collider") == (verdict == "ego") for told in those)
        braked = sum(told["braked"][0] in _VANISHED for told in those)
        own, others = (_avoided_by(those, [verdict] if mine else [_partner(verdict)]) for mine in (True, False))
        lines.append(f"{rule}, {verdict}: {count} | {front} | {_duty(those, rule)} | {braked} | {own} | {others}")
    silent = [told for told in found if told["verdict"] == "nobody can tell"]
    lines.append(f"nobody can tell: {len(silent)} of {len(found)}")
    return "\n".join(lines)


def _duty(those: list[dict[str, Any]], rule: str) -> str:
    """In how many the two do not collide where the one blamed keeps the duty that the rule names; and in which not."""
    helped, late, left = 0, 0, []
    asked = [(told, [one for one in _kept(told, rule) if one in _SAYS]) for told in those]
    for told, endings in asked:
        helped += endings[:1] != [] and endings[0] in _VANISHED
        late += endings[:1] != [] and endings[0] not in _VANISHED and any(one in _VANISHED for one in endings[1:])
        if endings and not any(one in _VANISHED for one in endings):
            left.append(f"{told['scenario']} {told['crash']}")
    said = f"{helped} + {late} of {sum(bool(endings) for _, endings in asked)}"
    return f"{said} (not: {', '.join(left)})" if left else said


def _kept(told: dict[str, Any], rule: str) -> list[str]:
    """What comes of a collision where the one blamed keeps its duty; from nearer to it, and from further before."""
    blamed = told["verdict"]
    mistakes = [ends for who, what, ends in told["without"] if who == blamed and what in KINDS]
    if blamed == "the other" and mistakes:
        return list(mistakes[-1])
    if rule == "lane change":
        return [one for who, what, ends in told["without"] if who == blamed and what == "changed lanes" for one in ends]
    return list(told["braked"] if blamed == "ego" else told["other_braked"])


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
