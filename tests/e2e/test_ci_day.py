"""A day with a corpus and CI: every command of the guide's pages, in their order, and its workflows step by step."""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys
from importlib import resources
from pathlib import Path

import pytest
import yaml
from repositories import git
from test_github_actions import Runner

GUIDE = resources.files("crashhunt") / "guide"
PROJECT = """
[build-system]
requires = ["hatchling"]
build-backend = "hatchling.build"

[project]
name = "my-pkg"
version = "1"
"""
PLANNER = """
class Planner:
    def __init__(self, speed: float = 24.0):
        self.speed = speed

    def reset(self, seed):
        pass

    def act(self, observation):
        return (self.speed, 0)
"""
GOOD = PLANNER.replace("(self.speed, 0)", "(4.0, 0)")


def commands_of(page):
    """Return the commands that the text blocks of a page show, in their order."""
    blocks = re.findall(r"```(?:text|console)\n(.*?)```", (GUIDE / page).read_text(), re.S)
    return [line[2:] for block in blocks for line in block.splitlines() if line.startswith("$ ")]


def workflows_of(page):
    """Return the workflows of a page by the name of their file."""
    blocks = re.findall(r"```yaml\n# \.github/workflows/(\S+)\n(.*?)```", (GUIDE / page).read_text(), re.S)
    return {name: yaml.safe_load(text) for name, text in blocks}


class Job:
    """Runs the steps of a workflow's job in a fresh checkout, as a runner does it.

    Args:
        job: as the workflow has it.
        repository: that is checked out.
        folder: for the checkout.
        inputs: of crashhunt's actions, in addition to those of the workflow.
    """

    def __init__(self, job, repository, folder, **inputs):
        self.job, self.repository, self.folder, self.inputs = job, repository, folder, inputs
        self.steps, self.failed, self.said, self.actions = {}, False, "", []
        self.environment = {
            **{word: value for word, value in os.environ.items() if not word.startswith("PYTEST")},
            "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
            "PIP_TARGET": str(folder / ".site"), "PIP_NO_DEPS": "1", "PIP_NO_BUILD_ISOLATION": "0",
            "PIP_DISABLE_PIP_VERSION_CHECK": "1", "PYTHONPATH": str(folder / ".site"),
        }  # fmt: skip

    def run(self):
        for step in self.job["steps"]:
            if self.failed and "always()" not in str(step.get("if", "")):
                continue
            if "run" in step:
                done = subprocess.run(
                    ["bash", "-eo", "pipefail", "-c", step["run"]], cwd=self.folder, env=self.environment, check=False,
                    stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
                )  # fmt: skip
                self.said += done.stdout
                self.failed = self.failed or done.returncode != 0
            else:
                self.use(step, *step["uses"].split("@"))
        return self

    def use(self, step, name, version):
        given = step.get("with", {})
        if name == "actions/checkout":
            git(self.repository, "clone", "-q", str(self.repository), str(self.folder))
        elif name == "actions/setup-python":
            assert tuple(map(int, given["python-version"].split("."))) >= (3, 11)
        elif name == "github/codeql-action/upload-sarif":
            assert "steps.night.outputs.sarif" in step["if"]
            wanted = re.fullmatch(r"\$\{\{ steps\.(\w+)\.outputs\.(\w+) \}\}", given["sarif_file"])
            file = self.steps[wanted[1]][wanted[2]]
            assert json.loads((self.folder / file).read_text())["version"] == "2.1.0"
            self.actions.append("sarif")
        else:
            assert name.startswith("crashhunt/crashhunt/.github/actions/"), name
            assert re.fullmatch(r"v\d+\.\d+\.\d+", version)
            action = Runner(Path(name).name, self.folder, **{**given, **self.inputs.get(Path(name).name, {})})
            action.environment |= {"PYTHONPATH": self.environment["PYTHONPATH"]}
            self.steps[step.get("id", "")] = action.run()
            self.said += action.said
            self.failed = self.failed or action.failed
            self.actions.append(Path(name).name)


@pytest.fixture
def project(shell):
    """A repository with an agent that got worse after v1.2, and a hunt that has found it."""
    folder = shell.folder / "project"
    (folder / "my_pkg").mkdir(parents=True)
    (folder / "pyproject.toml").write_text(PROJECT)
    (folder / ".gitignore").write_text("build/\n*.egg-info/\n__pycache__/\n.site/\n")
    git(folder, "init", "-q")
    for tag, code in (("v1.1", GOOD), ("v1.2", GOOD + "\n# faster soon\n"), ("v1.3", PLANNER)):
        (folder / "my_pkg" / "__init__.py").write_text(code)
        git(folder, "add", ".")
        git(folder, "commit", "-qm", f"Release {tag}")
        git(folder, "tag", tag)
    shell.folder = folder
    words = ("--agent", "my_pkg:Planner", "--seed", "1", "--set", "vehicles=60")
    shell.crashhunt("run", "../crash", "2", "20", "600", *words)
    return shell


@pytest.mark.nightly  # 30 processes, three of them SUMO hunts
def test_every_command_of_the_corpus_page_and_the_workflows_of_the_ci_page(project, tmp_path):
    (bundle,) = (project.folder.parent / "crash" / "crashes").glob("*-collision")
    shown = commands_of("howto/corpus.md")
    assert [command.split()[:3] for command in shown] == [
        ["crashhunt", "corpus", "add"], ["crashhunt", "corpus", "run"], ["crashhunt", "corpus", "run"],
        ["crashhunt", "show", "out/000003-collision-aaa010"], ["pytest", "crashes"],
        ["crashhunt", "bisect", "crashes/000003-collision-aaa010"],
    ]  # fmt: skip
    case, results = None, []
    for command in shown:
        command = command.replace("crash/crashes/000003-collision", str(bundle))
        if case is not None:
            command = command.replace("000003-collision-aaa010", case)
        words = shlex.split(command)
        if words[0] == "pytest":
            done = subprocess.run(
                [sys.executable, "-m", "pytest", "-q", "-p", "crashhunt.corpus.pytest_plugin", *words[1:]],
                cwd=project.folder, env={**project.environment, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}, check=False,
                capture_output=True, text=True,
            )  # fmt: skip
            assert done.returncode == 0, done.stdout + done.stderr
            results.append(done.stdout)
            continue
        results.append(project.crashhunt(*words[1:]).out)
        case = case or next((project.folder / "crashes").iterdir()).name
    added, run, kept, show, tested, bisected = results
    assert f"crashes/{case} is new (" in added
    assert "1 case: 1 still crashes" in run
    assert "1 case: 1 still crashes" in kept
    assert "drove into" in show
    assert "1 xfailed" in tested
    assert "is the first in which it crashes: Release v1.3" in bisected
    for words in (
        ("show", f"crashes/{case}"),
        ("replay", f"crashes/{case}"),
        ("report", f"crashes/{case}", "-o", "../r.html"),
    ):
        project.crashhunt(*words)

    git(project.folder, "add", "crashes")
    git(project.folder, "commit", "-qm", "Keep a crash")
    workflows = workflows_of("tutorials/ci.md")
    assert set(workflows) == {"hunt.yml", "crashes.yml", "hunt-nightly.yml"}
    limits = {"hunt": {"trials": "8", "max_steps": "300", "for": "60s", "shrink_for": "5s"}}
    outcomes = {}
    for name, workflow in workflows.items():
        (job,) = workflow["jobs"].values()
        outcomes[name] = Job(job, project.folder, tmp_path / name, **limits).run()
    assert "Successfully installed my-pkg" in outcomes["crashes.yml"].said
    assert not outcomes["crashes.yml"].failed, outcomes["crashes.yml"].said  # the known crash is expected
    assert outcomes["crashes.yml"].actions == ["corpus"]
    assert outcomes["hunt.yml"].actions == ["hunt"]
    assert outcomes["hunt-nightly.yml"].actions == ["hunt", "sarif"], outcomes["hunt-nightly.yml"].said

    # Fixed: the case may be tightened, and then it must not crash again.
    (project.folder / "my_pkg" / "__init__.py").write_text(GOOD + "\n# fixed\n")
    project.crashhunt("corpus", "add", f"crashes/{case}", "--to", "crashes", "--expect", "fixed")
    git(project.folder, "commit", "-qam", "Fix it")
    (job,) = workflows["crashes.yml"]["jobs"].values()
    assert not Job(job, project.folder, tmp_path / "fixed").run().failed
    (project.folder / "my_pkg" / "__init__.py").write_text(PLANNER)
    git(project.folder, "commit", "-qam", "Break it again")
    broken = Job(job, project.folder, tmp_path / "broken").run()
    assert broken.failed
    assert "still crashes, and fixed was expected" in broken.said
