"""Files that were written before format version 1.

The formats of crashhunt were numbered again when they became version 1, and every later version reads version 1. Files
from before are read only by `LAST_REVISION`, and `HOW_TO_READ` says so wherever such a file is refused.
"""

from __future__ import annotations

LAST_REVISION = "40b50271"
"""Git revision of crashhunt that reads every file from before format version 1."""
HOW_TO_READ = (
    f"read it with crashhunt of git revision {LAST_REVISION} (pip install "
    f"'git+https://github.com/crashhunt/crashhunt@{LAST_REVISION}'), or hunt again"
)
"""The fix of the error that refuses such a file."""
