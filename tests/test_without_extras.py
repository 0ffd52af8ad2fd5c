"""What works in an environment without any extra, such as that of a new clone."""

from __future__ import annotations

import json
import subprocess
import sys
import tomllib
from pathlib import Path

from packaging.requirements import Requirement

ROOT = Path(__file__).parents[1]
OTHER_NAMES = {"eclipse-sumo": "sumo"}  # imported under another name
OF_AN_EXTRA = {"optuna", "ray", "cma-es"}  # entry points that need one

LOAD = """
import json, sys
from importlib.metadata import entry_points

sys.modules.update(dict.fromkeys(json.loads(sys.argv[1])))  # None: the import fails
from crashhunt.dashboard import has_dashboard

failed = {}
for group in ("agents", "disturbances", "executors", "oracles", "samplers", "simulators"):
    for point in entry_points(group=f"crashhunt.{group}"):
        try:
            point.load()
        except ImportError as error:
            failed[point.name] = str(error)
print(json.dumps([has_dashboard(), failed]))
"""


def test_entry_points_and_the_question_for_the_dashboard_need_no_package_of_an_extra():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    core = {Requirement(word).name for word in project["dependencies"]}
    extras = {
        Requirement(word).name
        for extra, words in project["optional-dependencies"].items()
        for word in words
        if extra != "dev"  # it lists what tests use of the dependencies of others, too
    }
    blocked = sorted(OTHER_NAMES.get(name, name.replace("-", "_")) for name in extras - core - {"crashhunt"})
    assert {"optuna", "uvicorn", "ray"} <= {*blocked}
    done = subprocess.run([sys.executable, "-P", "-c", LOAD, json.dumps(blocked)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    has_dashboard, failed = json.loads(done.stdout)
    assert not has_dashboard
    assert failed.keys() <= OF_AN_EXTRA, failed
