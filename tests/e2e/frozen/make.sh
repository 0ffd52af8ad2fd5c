#!/usr/bin/env bash
# Makes what tests/e2e/test_older_versions.py reads of a version, with the crashhunt that is given:
#   tests/e2e/frozen/make.sh .venv/bin/crashhunt NAME
# NAME is version-N, by the version of the formats. Nothing that is here is ever made anew.
set -euo pipefail
crashhunt=$(realpath "$1")
here=$(realpath "$(dirname "$0")")
name=$2
place=$here/$name
mkdir "$place"
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"

# A SUMO crash with the code of the agent, and of crashhunt.
cat >planner.py <<'END'
"""Drives at a steady speed, and changes lanes now and then."""


class Planner:
    def __init__(self, speed: float = 16.0) -> None:
        self.speed = speed

    def reset(self, seed: int) -> None:
        self.steps = 0

    def act(self, observation):
        self.steps += 1
        return self.speed, 1 if self.steps % 40 == 0 and observation[0, 2] > 1.6 else 0
END
"$crashhunt" run sumo 1 40 800 --scenario loop --agent planner:Planner --arg speed=12:20 --seed 3
"$crashhunt" export sumo "$here/../bundles/$name.zip"

# A highway-env crash and a software fault of the toy's, without code: today's drives.
"$crashhunt" run highway 1 40 100 --scenario highway --no-snapshot --seed 3
"$crashhunt" export highway "$place/highway.zip"
cp -r "$here/toy" .
"$crashhunt" run fault 1 3 60 --scenario toy --no-snapshot --seed 1 --set fail_at_step=9
"$crashhunt" export fault "$place/fault.zip"

# A hunt that was interrupted after four of six trials, with its ledger and the folders of its crashes.
"$crashhunt" run hunt 1 4 60 --scenario toy --no-snapshot --seed 1 --keep-going
cp -r hunt "$place/hunt"
rm -f "$place/hunt/.lock"
du -sh "$place" "$here/../bundles/$name.zip"
