"""The script that builds a release leaves neither processes nor folders when it is stopped."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from pathlib import Path

RELEASE = Path(__file__).parents[1] / "scripts" / "release"

# Stands for Python: it writes into the folder that it is given until some time after SIGTERM.
ENDLESS = """#!/usr/bin/env bash
[ "$1" != -c ] || exit 0
trap 'for i in {1..50}; do mkdir -p "$3/late-$i"; sleep 0.01; done; exit 1' TERM
while true; do mkdir -p "$3/$((i += 1))"; sleep 0.01; done
"""


def test_stopped_script_removes_its_folder_after_its_processes(tmp_path):
    python, folder, place = tmp_path / "python", tmp_path / "folder", tmp_path / "scripts"
    python.write_text(ENDLESS, encoding="utf-8")
    python.chmod(0o755)
    folder.mkdir()
    place.mkdir()
    (place / "release").write_bytes(RELEASE.read_bytes())  # it writes next to itself
    release = subprocess.Popen(
        ["bash", str(place / "release"), str(python)], env={**os.environ, "TMPDIR": str(folder)},
        stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    while not list(folder.glob("*/build/*")):
        time.sleep(0.01)
    release.send_signal(signal.SIGTERM)
    _, written = release.communicate(timeout=60)
    assert release.returncode == -signal.SIGTERM
    assert "cannot remove" not in written
    assert list(folder.iterdir()) == []
