"""The names of all files and folders that crashhunt writes, and the folder of crashhunt's code."""

from __future__ import annotations

from pathlib import Path
from typing import Final

PACKAGE: Final = Path(__file__).resolve().parent.parent
"""The folder of the package `crashhunt`."""

# Of a hunt's directory.
HUNT: Final = "hunt.toml"
LEDGER: Final = "ledger.sqlite"
REQUEST: Final = "request.json"
SNAPSHOTS: Final = "snapshots"
CRASHES: Final = "crashes"
NEAR_MISSES: Final = "near-misses"
PROBES: Final = "probes"
BRANCHES: Final = "branches"
BESIDE: Final = (NEAR_MISSES, PROBES, BRANCHES)
"""Folders of bundles that are no crashes of the hunt's own trials."""
TRIALS: Final = "trials"
REPORT: Final = "report.html"
NOTES: Final = "notes.jsonl"

# Of a bundle, and of a trial that is kept for another reason than a crash.
CRASH: Final = "crash.json"
PARAMS: Final = "params.json"
LOG: Final = "log.mcap"
RUN_LOG: Final = "run.log"
ERROR_LOG: Final = "error.log"
FOXGLOVE_LAYOUT: Final = "foxglove-layout.json"
LIGHTS: Final = "lights.json"
"""Traffic lights, lights of vehicles and routes, which the replay that confirms a crash reads from the simulator."""

# Of a case of a corpus, which is a hunt's directory besides.
CASE: Final = "crashhunt-case.toml"

# Of a snapshot.
MANIFEST: Final = "manifest.json"
ENVIRONMENT: Final = "environment.json"
GIT_DIFF: Final = "git.diff"
SCENARIO: Final = "scenario.toml"

CODE: Final = "code"
FILES: Final = "files"  # which arguments name
SCENARIO_FILES: Final = "scenario"

# Next to a policy: the traffics that it was trained on.
TRAINED_ON: Final = "trained_on.json"

# Of an exported crash; and of this user on this machine, what it is signed with.
ARCHIVE_INDEX: Final = "archive.json"
ARCHIVE_KEY: Final = "archive-key"

# Of the scratch folder of a trial that runs; of the whole hunt's, the last one.
BLACK_BOX: Final = "blackbox.bin"
ENTERED: Final = "entered.json"  # of a trial that can exclude other vehicles
RESPONSES: Final = "responses.json"  # of a trial with a reference driver
STACK: Final = "stack.txt"
MAP: Final = "map.json"
NOTICES: Final = "notices.txt"
JOB: Final = "job.json"
ANSWER: Final = "answer.json"

SCRATCH: Final = ".scratch"
"""What the name of the folder in a hunt begins with into which running trials write."""

SMALL: Final = ".small"
"""What the name of a bundle ends with that another one was made smaller to."""

# What is not whole yet begins with a dot, and so does what only this process needs.
SHOWN: Final = "[!.]*"
"""The glob pattern of what is whole."""
BUILDING: Final = ".building-"
"""What the name of a snapshot begins with that is being made; its owner follows."""
REPLACED: Final = ".replaced-"
"""What stands in the name of a hunt that another one has taken the place of."""

KEPT: Final = frozenset(
    (
        HUNT, LEDGER, REQUEST, NOTES, CRASH, PARAMS, LOG, RUN_LOG, ERROR_LOG, FOXGLOVE_LAYOUT, LIGHTS,
        CASE, MANIFEST, ENVIRONMENT, GIT_DIFF, SCENARIO, TRAINED_ON,
    )
)  # fmt: skip
"""Files that no output replaces that the user names."""


def crash_folder(number: int, outcome: str) -> str:
    """Return the name of a crash's folder, which is the id of the crash, such as ``000012-collision``."""
    return f"{number:06d}-{outcome}"
