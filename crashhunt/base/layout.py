"""The names of everything that crashhunt keeps on disk, and where it lies itself."""

from __future__ import annotations

from pathlib import Path
from typing import Final

__all__ = [
    "ARCHIVE_INDEX",
    "BLACK_BOX",
    "CRASH",
    "CRASHES",
    "ENVIRONMENT",
    "ERROR_LOG",
    "FOXGLOVE_LAYOUT",
    "GIT_DIFF",
    "HUNT",
    "LEDGER",
    "LOG",
    "MANIFEST",
    "MAP",
    "NOTICES",
    "PACKAGE",
    "PARAMS",
    "REPORT",
    "REQUEST",
    "RUN_LOG",
    "SCENARIO",
    "SNAPSHOTS",
    "STACK",
    "TRIALS",
]

PACKAGE: Final = Path(__file__).resolve().parent.parent
"""The folder of the package `crashhunt`."""

# Of a hunt's directory.
HUNT: Final = "hunt.toml"
LEDGER: Final = "ledger.sqlite"
REQUEST: Final = "request.json"
SNAPSHOTS: Final = "snapshots"
CRASHES: Final = "crashes"
TRIALS: Final = "trials"
REPORT: Final = "report.html"

# Of a bundle, and of a trial that is kept for another reason than a crash.
CRASH: Final = "crash.json"
PARAMS: Final = "params.json"
LOG: Final = "log.mcap"
RUN_LOG: Final = "run.log"
ERROR_LOG: Final = "error.log"
FOXGLOVE_LAYOUT: Final = "foxglove-layout.json"

# Of a snapshot.
MANIFEST: Final = "manifest.json"
ENVIRONMENT: Final = "environment.json"
GIT_DIFF: Final = "git.diff"
SCENARIO: Final = "scenario.toml"

# Of an exported crash.
ARCHIVE_INDEX: Final = "archive.json"

# Of the scratch folder of a trial that runs; of the whole hunt's, the last one.
BLACK_BOX: Final = "blackbox.bin"
STACK: Final = "stack.txt"
MAP: Final = "map.json"
NOTICES: Final = "notices.txt"
