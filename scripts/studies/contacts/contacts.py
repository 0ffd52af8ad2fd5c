"""Whether everything that is said of a collision agrees, on networks and in traffic that nobody has tuned.

Networks are made by SUMO's netgenerate, or are those below a folder (``--networks DIR``). Each is hunted at several
step lengths, with an agent that does not react, changes lanes without looking or into vehicles beside it, or stops and
starts, among drivers that err. Each collision is then described by all parts that describe one: its type, role, speeds
and lane, the fault, and until when braking would have avoided it. The descriptions are compared with each other and
with the recording by rules that share no code with them (`contact_rules`). Each collision is also described again
mirrored, rotated, and with its scenes taken at other instants, as if the steps had begun earlier or later.

    scripts/studies/run contacts [--trials N] [--folder DIR] [--networks DIR] [NAME…]   hunt, then compare
    scripts/studies/run contacts --only-compare --folder DIR          compare the collisions of an earlier run
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from towns import AGENT_HEAD, write_traffic

NETWORKS = {
    "grid-priority": "--grid --grid.number 4 --grid.length 110 -L 2 -j priority",
    "grid-lights": "--grid --grid.number 4 --grid.length 130 -L 2 -j traffic_light",
    "grid-right-before-left": "--grid --grid.number 4 --grid.length 90 -L 1 -j right_before_left",
    "grid-three-lanes": "--grid --grid.number 3 --grid.length 220 -L 3 -j traffic_light",
    "grid-all-way-stop": "--grid --grid.number 4 --grid.length 100 -L 2 -j allway_stop",
    "grid-priority-stop": "--grid --grid.number 4 --grid.length 120 -L 2 -j priority_stop",
    "grid-unregulated": "--grid --grid.number 3 --grid.length 110 -L 2 -j unregulated",
    "grid-long": "--grid --grid.x-number 2 --grid.y-number 6 --grid.length 300 -L 3 -j priority",
    "grid-short": "--grid --grid.number 6 --grid.length 45 -L 2 -j traffic_light",
    "grid-four-lanes": "--grid --grid.number 3 --grid.length 180 -L 4 -j priority",
    "grid-left-hand": "--grid --grid.number 4 --grid.length 120 -L 2 -j priority --lefthand",
    "grid-left-hand-lights": "--grid --grid.number 3 --grid.length 150 -L 3 -j traffic_light --lefthand",
    "spider-priority": "--spider --spider.arm-number 6 --spider.circle-number 3 --spider.space-radius 90 -L 2",
    "spider-right-before-left":
        "--spider --spider.arm-number 5 --spider.circle-number 3 --spider.space-radius 80 -L 1 -j right_before_left",
    "spider-lights":
        "--spider --spider.arm-number 7 --spider.circle-number 2 --spider.space-radius 120 -L 3 -j traffic_light",
    "spider-left-hand":
        "--spider --spider.arm-number 6 --spider.circle-number 2 --spider.space-radius 110 -L 2 --lefthand",
    "random-1": "--rand --rand.iterations 60 --rand.max-distance 170 -L 2 --seed 11",
    "random-2": "--rand --rand.iterations 60 --rand.max-distance 220 -L 3 --seed 12 -j traffic_light",
    "random-3": "--rand --rand.iterations 80 --rand.max-distance 140 -L 1 --seed 13 -j right_before_left",
    "random-4": "--rand --rand.iterations 50 --rand.max-distance 250 -L 2 --seed 14 -j priority --bidi-probability 0",
    "random-left-hand": "--rand --rand.iterations 60 --rand.max-distance 180 -L 2 --seed 15 --lefthand",
    "random-lanes": "--rand --rand.iterations 60 --rand.max-distance 200 --rand.random-lanenumber -L 4 --seed 16",
}  # fmt: skip
"""Name to the arguments of netgenerate."""
STEPS_S = (0.1, 0.2, 0.5, 1.0)
AGENT = f"""\
{AGENT_HEAD}        self.defect, self.step_s = defect, step_length_s

    def reset(self, seed):
        super().reset(seed)
        self.time_s, self.phase = 0.0, seed % 5

    def act(self, observation):
        action = super().act(observation)
        self.time_s += self.step_s
        if self.time_s < 3.0 or self.defect == "none":
            return action
        if self.defect == "asleep":
            return 14.0, 0
        if self.defect == "starts":
            return (0.0 if (self.time_s + self.phase) % 9.0 < 5.0 else 13.0), 0
        if self.defect == "blind":
            return action[0], 1 if (self.time_s + self.phase) // 2.0 % 2 else -1
        for present, ahead, right, *_, cos_h, _ in observation[1:]:  # there is a vehicle beside it: change into it
            if present and abs(ahead) < 8.0 and 2.0 < abs(right) < 4.5 and cos_h > 0.9:
                return 14.0, 1 if right < 0 else -1
        return 14.0, 0
"""
_SECONDS, _TRIAL_S = 90, 40.0
_HUNT = ("--ego", "any", "--agent", "erring:Erring",
         "--disturb", "ignore_priority=0.2,cut_in=0.1,stop=0.03", "--keep-going",
         "--crash-on", "collision")  # fmt: skip


def main() -> int:
    """Hunt, compare, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("names", nargs="*")
    parser.add_argument("--trials", type=int, default=8)
    parser.add_argument("--seed", type=int, default=5, help="of the traffic and of the hunts")
    parser.add_argument("--folder", type=Path, default=None)
    parser.add_argument("--networks", type=Path, default=None, help="hunt on all *.net.xml below this folder as well")
    parser.add_argument("--steps", type=float, nargs="*", default=STEPS_S, help="step lengths, in s")
    parser.add_argument("--defects", default="asleep|blind|starts|merges", help="of the agent")
    parser.add_argument("--only-hunt", action="store_true")
    parser.add_argument("--only-compare", action="store_true")
    parser.add_argument("--again", action="store_true", help="describe collisions of an earlier version again")
    parser.add_argument("--every", type=int, default=1, help="variants of one in so many collisions; 0 leaves them out")
    given = parser.parse_args()
    folder = given.folder or Path(tempfile.mkdtemp(prefix="crashhunt-contacts-"))
    if not given.only_compare:
        for name, network in _networks(given, folder):
            for step_s in given.steps:
                _hunt(network, folder / "hunts" / f"{name}-{step_s:g}", step_s, given)
    from contact_rules import compare

    if given.only_hunt:
        return 0
    return compare(folder, again=given.again, every=given.every)


def _networks(given: argparse.Namespace, folder: Path) -> list[tuple[str, Path]]:
    found = []
    (folder / "networks").mkdir(parents=True, exist_ok=True)
    for name, words in NETWORKS.items():
        if given.names and name not in given.names:
            continue
        network = folder / "networks" / f"{name}.net.xml"
        if not network.is_file():
            program = shutil.which("netgenerate")
            if program is None:
                raise FileNotFoundError(
                    "netgenerate is missing: pip install 'crashhunt[maps]', and have it on the PATH"
                )
            command = [program, *words.split(), "--no-turnarounds", "true", "--output-file", str(network)]
            subprocess.run(command, check=True, capture_output=True)
        found.append((name, network))
    for network in sorted(given.networks.rglob("*.net.xml")) if given.networks is not None else ():
        name = network.name.removesuffix(".net.xml")
        if not given.names or name in given.names:
            found.append((name, network))
    return found


def _hunt(network: Path, folder: Path, step_s: float, given: argparse.Namespace) -> None:
    """Hunt on a network with traffic at random."""
    if (folder / "hunt" / "ledger.sqlite").is_file():
        return
    folder.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(network, folder / "town.net.xml")
    write_traffic(folder / "town.net.xml", folder, seed=f"{folder.name}-{given.seed}", seconds=_SECONDS, step_s=step_s)
    (folder / "erring.py").write_text(AGENT, encoding="utf-8")
    command = [sys.executable, "-m", "crashhunt", "run", "hunt", str(len(os.sched_getaffinity(0))), str(given.trials)]
    command += [str(round(_TRIAL_S / step_s)), "--scenario", "town.sumocfg", *_HUNT]
    command += ["--seed", str(given.seed), "--arg", f"defect={given.defects}"]
    done = subprocess.run(command, check=False, capture_output=True, text=True, cwd=folder)
    print(f"{folder.name}: {done.stderr.strip().splitlines()[-1:] if done.returncode else 'hunted'}", flush=True)


if __name__ == "__main__":
    raise SystemExit(main())
