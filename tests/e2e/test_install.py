from __future__ import annotations

import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def test_what_goes_into_a_wheel_is_all_there_is(tmp_path):
    """The list that the wheel is built from; by night it is built and used."""
    builder = pytest.importorskip("hatchling.builders.wheel").WheelBuilder(str(ROOT))
    files = {file.distribution_path: file.path for file in builder.recurse_included_files()}
    kept = subprocess.run(["git", "ls-files", "crashhunt", "scenarios"], cwd=ROOT, capture_output=True, text=True)
    if kept.returncode:
        pytest.skip("this is no work tree of git")
    tracked = set(kept.stdout.splitlines())
    wanted = {name if name.startswith("crashhunt/") else f"crashhunt/{name}" for name in tracked}
    assert wanted - files.keys() == set()
    site = tmp_path / "site"
    for name, path in files.items():
        (site / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, site / name)
    shipped = {path.parent.name for path in (ROOT / "scenarios").glob("*/scenario.toml")}
    assert {entry["name"] for entry in installed(site)("scenarios")["scenarios"]} == shipped


def test_readme_of_a_distribution_links_to_the_files_of_its_tag():
    """PyPI shows it without the files beside it."""
    core = pytest.importorskip("hatchling.builders.wheel").WheelBuilder(str(ROOT)).metadata.core
    links = re.findall(r"(!?)\[[^\[\]]*\]\(([^)]*)\)", core.readme)
    assert all(link.startswith("https://") for _, link in links)
    source = f"{core.urls['Source']}/"
    ours = [(mark, link.removeprefix(source)) for mark, link in links if link.startswith(source)]
    assert len(ours) > 30
    for mark, link in ours:
        way, tag, file = link.partition("#")[0].split("/", 2)
        assert (way, tag) == ("raw" if mark else "blob", f"v{core.version}")
        assert (ROOT / file).exists()


def installed(site):
    """Runs commands of what is in a folder, before the editable installation of this environment."""
    program = f"import sys; sys.path.insert(0, {str(site)!r}); from crashhunt.cli import main; sys.exit(main())"
    environment = {"PYTHONPATH": str(site), "PATH": "/usr/bin:/bin", "HOME": str(site.parent)}

    def crashhunt(*words: str) -> dict:
        done = subprocess.run(
            [sys.executable, "-c", program, *words, "--json"], cwd=site.parent, env=environment, capture_output=True,
            text=True, check=False,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout)

    return crashhunt


@pytest.mark.nightly
@pytest.mark.timeout(300)
def test_a_wheel_of_the_files_in_the_container_brings_its_scenarios_along(tmp_path):
    source = tmp_path / "source"
    lines = re.findall(r"^COPY (.+) /source", (ROOT / ".ci/Containerfile").read_text(), re.MULTILINE)
    names = " ".join(lines).split()
    assert "." not in names  # with .venv, it has gigabytes
    for name in names:
        (source / name).parent.mkdir(parents=True, exist_ok=True)
        (shutil.copytree if (ROOT / name).is_dir() else shutil.copyfile)(ROOT / name, source / name)
    # What it is built with need not be downloaded, where a development environment has it.
    quick = ["--no-build-isolation"] if importlib.util.find_spec("hatchling") else []
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", *quick, "--wheel-dir", tmp_path, source]
    # The compiled core is built in the environment that runs this, and by test_build.py.
    subprocess.run(command, check=True, env={**os.environ, "CRASHHUNT_CORE": "0"})
    (wheel,) = tmp_path.glob("*.whl")
    site = tmp_path / "site"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site)  # as pip does it; what it depends on is in this environment already
    shutil.rmtree(source)
    crashhunt = installed(site)
    shipped = {path.parent.name for path in (ROOT / "scenarios").glob("*/scenario.toml")}
    assert {entry["name"] for entry in crashhunt("scenarios")["scenarios"]} == shipped
    pages = {path.stem for path in (ROOT / "crashhunt" / "guide").rglob("*.md")} - {"index"}
    assert {entry["topic"] for entry in crashhunt("guide")["topics"]} == pages
    found = crashhunt("run", "out", "2", "50", "600", "--arg", "speed=20:25", "--seed", "1")
    assert found["stopped_because"] == "crash"
    shutil.rmtree(site / "crashhunt" / "scenarios")  # the bundle has its own
    assert crashhunt("replay", "out")["verdict"] == "reproduced"
