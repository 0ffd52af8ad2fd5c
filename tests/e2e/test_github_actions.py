"""The actions of GitHub's that come with the repository: whole, pinned, and run step by step as a runner does it."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).resolve().parent.parent.parent
ACTIONS = ROOT / ".github" / "actions"
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
NAMES = ["corpus", "gate", "hunt"]
AGENT = """
class Driver:
    def __init__(self, speed: float = 20.0):
        self.speed = speed

    def reset(self, seed):
        self.steps = seed % 2 * 1000

    def act(self, observation):
        self.steps += 1
        return (float("nan") if self.steps > 1005 else self.speed, 0)
"""


def action(name):
    return yaml.safe_load((ACTIONS / name / "action.yml").read_text())


class Runner:
    """Runs the steps of a composite action in order, as a runner does it, in a folder."""

    def __init__(self, name, folder, **inputs):
        self.path, self.folder, self.failed = ACTIONS / name, folder, False
        self.action = action(name)
        known = self.action["inputs"]
        given = {word.replace("_", "-"): value for word, value in inputs.items()}
        assert given.keys() <= known.keys()
        self.inputs = {word: str(given.get(word, known[word]["default"])) for word in known}
        self.steps, self.artifacts, self.ran, self.said = {}, {}, [], ""
        files = {word: folder / f".{word.lower()}" for word in ("GITHUB_STEP_SUMMARY", "GITHUB_OUTPUT")}
        self.summary, self.output = files.values()
        self.summary.write_text("")
        self.environment = {
            **{word: value for word, value in os.environ.items() if not word.startswith("PYTEST")},
            **{word: str(file) for word, file in files.items()},
            "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
            "GITHUB_ACTION_PATH": str(self.path),
            "GITHUB_WORKSPACE": str(folder),
            "GITHUB_ACTIONS": "true",
        }

    def value(self, text):
        """A text with its expressions worked out."""
        return re.sub(r"\$\{\{(.*?)\}\}", lambda found: str(self.worked_out(found[1])), str(text))

    def worked_out(self, expression):
        def told(found):
            return repr(self.steps.get(found[1], {}).get(found[2], ""))

        expression = re.sub(r"steps\.(\w+)\.outputs\.([\w-]+)", told, expression)
        expression = re.sub(r"inputs\.([\w-]+)", lambda found: repr(self.inputs[found[1]]), expression)
        expression = expression.replace("&&", " and ").replace("||", " or ")
        return eval(expression.strip(), {"__builtins__": {}}, {"failure": lambda: self.failed, "always": lambda: True})

    def run(self):
        for step in self.action["runs"]["steps"]:
            condition = str(step.get("if", "${{ success }}"))
            if self.failed and "failure()" not in condition and "always()" not in condition:
                continue
            if "if" in step and not self.worked_out(condition.strip().removeprefix("${{").removesuffix("}}")):
                continue
            self.ran.append(step["name"])
            if "uses" in step:
                place = self.folder / self.value(step["with"]["path"])
                assert any(place.iterdir()), "an artefact without a file"
                self.artifacts[self.value(step["with"]["name"])] = place
            elif not self.shell(step):
                self.failed = True
        return {word: self.value(output["value"]) for word, output in self.action.get("outputs", {}).items()}

    def shell(self, step):
        """Run a step in bash; return whether it went well."""
        script = self.folder / ".step.sh"
        script.write_text(step["run"])
        self.output.write_text("")
        given = {word: self.value(value) for word, value in step.get("env", {}).items()}
        done = subprocess.run(
            ["bash", "--noprofile", "--norc", "-eo", "pipefail", str(script)], cwd=self.folder, check=False,
            env={**self.environment, **given}, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        )  # fmt: skip
        self.said += done.stdout
        if "id" in step:
            self.steps[step["id"]] = dict(line.split("=", 1) for line in self.output.read_text().splitlines())
        return done.returncode == 0


@pytest.mark.parametrize("name", NAMES)
def test_an_action_is_whole(name):
    found = action(name)
    text = (ACTIONS / name / "action.yml").read_text()
    used = set(re.findall(r"inputs\.([\w-]+)", text))
    assert used == set(found["inputs"]), "an input that nobody uses, or one that is none"
    assert all(one["description"] and isinstance(one["default"], str) for one in found["inputs"].values())
    assert found["runs"]["using"] == "composite"
    steps = found["runs"]["steps"]
    ids = {step["id"] for step in steps if "id" in step}
    assert set(re.findall(r"steps\.(\w+)\.", text)) <= ids
    for step in steps:
        assert step["name"]
        if "uses" in step:
            assert re.fullmatch(r"[\w-]+/[\w-]+@[0-9a-f]{40}", step["uses"]), "what it uses may change under it"
        else:
            assert step["shell"] == "bash"
            assert "${{" not in step["run"], "what somebody gives would be run as code"
            subprocess.run(["bash", "-n"], input=step["run"], text=True, check=True)
            names = {word for word in re.findall(r"\$\{?([A-Z][A-Z_]+)", step["run"]) if "GITHUB" not in word}
            assert names <= step.get("env", {}).keys()
            assert all(word in step["run"] for word in step.get("env", {}))


def test_our_own_ci_uses_them_as_they_are():
    used = set()
    for file in WORKFLOWS:
        jobs = yaml.safe_load(file.read_text())["jobs"].values()
        for step in (step for job in jobs for step in job["steps"]):
            place = step.get("uses", "")
            if place.startswith("./"):
                name = Path(place).name
                used.add(name)
                assert step.get("with", {}).keys() <= action(name)["inputs"].keys(), f"{file.name}: {step}"
            else:
                assert not place or re.fullmatch(r"[\w.-]+/[\w.-]+@[\w./-]+", place)
    assert used == set(NAMES)


def test_steps_of_the_ci_page_give_inputs_that_the_actions_have():
    text = (ROOT / "crashhunt" / "guide" / "tutorials" / "ci.md").read_text()
    steps = []
    for shown in map(yaml.safe_load, re.findall(r"```yaml\n(.*?)```", text, re.DOTALL)):
        steps += shown if isinstance(shown, list) else [step for job in shown["jobs"].values() for step in job["steps"]]
    used = set()
    for step in (step for step in steps if "crashhunt/" in step.get("uses", "")):
        place, version = step["uses"].split("@")
        used.add(name := Path(place).name)
        assert place == f"crashhunt/crashhunt/.github/actions/{name}"
        assert re.fullmatch(r"v\d+\.\d+\.\d+", version)
        assert step.get("with", {}).keys() <= action(name)["inputs"].keys()
    assert used == set(NAMES)


STUB = """#!/usr/bin/env python3
import json, os, pathlib, sys
words = sys.argv[1:]
with open("asked.jsonl", "a") as file:
    file.write(json.dumps(words) + "\\n")
if words[0] == "crashes":
    print(json.dumps({"groups": [{"count": 1, "shortest": word} for word in json.loads(os.environ["FOUND_BY_STUB"])]}))
elif words[0] == "shrink" and "000001" in words[1]:
    os.mkdir(f"{words[1]}.small")
elif words[0] == "export" and not os.path.isdir(words[1]):
    sys.exit("it does not exist")
elif words[0] in ("export", "report"):
    pathlib.Path(words[-1]).write_text("")
"""


def stubbed(folder, *crashes, **inputs):
    """The action `hunt`, with a command that finds these crashes and of the second cannot take anything away."""
    runner = Runner("hunt", folder, **inputs)
    (folder / "bin").mkdir()
    stub = folder / "bin" / "crashhunt"
    stub.write_text(STUB)
    stub.chmod(0o755)
    runner.environment |= {
        "PATH": f"{stub.parent}{os.pathsep}{runner.environment['PATH']}",
        "FOUND_BY_STUB": json.dumps(crashes),
    }
    for crash in crashes:
        (folder / crash).mkdir(parents=True)
    return runner


def asked(folder):
    return [json.loads(line) for line in (folder / "asked.jsonl").read_text().splitlines()]


def test_arguments_reach_the_hunt_as_a_shell_would_split_them_and_no_shell_does(tmp_path):
    words = "--agent 'a b:C' --arg \"x=1|2\"\n--note $(touch\\ owned) `id` ;ü *"
    runner = stubbed(tmp_path, arguments=words, directory="a $(touch owned)/ü//")
    told = runner.run()
    assert not runner.failed, runner.said
    assert told["examples"] == "a $(touch owned)/ü-found"
    assert (told["new"], runner.artifacts) == ("0", {})
    assert asked(tmp_path)[0][1:] == [
        "a $(touch owned)/ü//", "0", "0", "1500", "--for", "30m", "--keep-going", "--keep", "3",
        "--agent", "a b:C", "--arg", "x=1|2", "--note", "$(touch owned)", "`id`", ";ü", "*",
    ]  # fmt: skip
    assert not (tmp_path / "owned").exists()


def test_arguments_that_cannot_be_split_are_no_hunt(tmp_path):
    runner = stubbed(tmp_path, arguments="--agent 'a:B")
    runner.run()
    assert runner.failed
    assert "arguments: No closing quotation: --agent 'a:B" in runner.said
    assert not (tmp_path / "asked.jsonl").exists()


def test_no_examples_are_wanted(tmp_path):
    runner = stubbed(tmp_path, "h/crashes/000000-hang", directory="h", examples=0)
    runner.run()
    assert runner.ran[-1] == "Something new", runner.said
    assert "zip" not in runner.summary.read_text()


@pytest.mark.nightly  # a dozen processes, as a runner starts them
def test_a_hunt_and_its_corpus_as_a_runner_does_it(toy):
    (toy.folder / "driver.py").write_text(AGENT)
    words = "--scenario toy --agent driver:Driver --arg 'speed=20:22' --seed 1"
    asked = {"arguments": words, "trials": 6, "max_steps": 99, "for": "5m", "shrink_for": "20s"}
    first = Runner("hunt", toy.folder, **asked)
    told = first.run()
    assert first.failed, first.said
    assert first.ran[-2:] == ["Keep them", "Something new"]
    assert int(told["kinds"]) == int(told["new"]) == 2, first.said
    place = first.artifacts["crashes"]
    files = {file.name for file in place.iterdir()}
    assert {"report.html", "crashes.sarif", "crashes.json", "new.txt"} < files
    exported = sorted(file for file in files if file.endswith(".zip"))
    assert len([file for file in exported if not file.endswith(".small.zip")]) == 2
    assert any(file.endswith(".small.zip") for file in exported)
    assert all(zipfile.is_zipfile(place / file) for file in exported)
    lines = [line for line in first.said.splitlines() if line.startswith("::error ")]
    assert len(lines) == 2
    assert all("file=driver.py,line=2," in line or "file=driver.py," in line for line in lines)
    summary = first.summary.read_text()
    assert "2 types, 2 new" not in summary  # no corpus was given
    assert f"crashhunt replay {exported[0]} --trust" in summary
    results = json.loads((place / "crashes.sarif").read_text())["runs"][0]["results"]
    assert {one["ruleId"] for one in results} == {"collision", "agent_error"}

    for file in exported:
        if not file.endswith(".small.zip"):
            toy.crashhunt("corpus", "add", str(place / file), "--to", "kept crashes", "--trust")
    still = Runner("corpus", toy.folder, corpus="kept crashes")
    still.run()
    assert not still.failed, still.said
    assert "all as expected" in still.summary.read_text()
    again = Runner("hunt", toy.folder, **asked, known="kept crashes")
    assert again.run()["new"] == "0", again.said
    assert not again.failed, again.said
    assert again.artifacts == {}

    case = next((toy.folder / "kept crashes").glob("*/crashhunt-case.toml"))
    case.write_text(case.read_text().replace('"still"', '"fixed"'))
    wrong = Runner("corpus", toy.folder, corpus="kept crashes")
    wrong.run()
    assert wrong.failed
    assert wrong.ran[-1] == "Keep what crashes"
    assert any(wrong.artifacts["corpus"].glob("*/crashes/*/crash.json"))
    assert re.search(r"^::error file=kept crashes/.*crashhunt-case\.toml,line=1,", wrong.said, re.MULTILINE)


GATE_STUB = """#!/usr/bin/env python3
import json, os, sys
with open("asked.jsonl", "a") as file:
    file.write(json.dumps(sys.argv[1:]) + "\\n")
os.makedirs("g/base", exist_ok=True)
print(json.dumps({"verdict": os.environ["VERDICT"]} if os.environ["VERDICT"] else {"error": {"message": "no"}}))
sys.exit(int(os.environ["CODE"]))
"""


@pytest.mark.parametrize(
    ("verdict", "code", "strict", "fails"),
    [
        ("worse", 1, "false", True),
        ("undecided", 3, "false", False),
        pytest.param("better", 0, "false", False, marks=pytest.mark.nightly),
        pytest.param("undecided", 3, "true", True, marks=pytest.mark.nightly),
        pytest.param("", 2, "false", True, marks=pytest.mark.nightly),
    ],
)
def test_gate_fails_where_the_change_is_worse_or_cannot_be_compared(tmp_path, verdict, code, strict, fails):
    words = {"base": "a:B", "head": "a:C d", "arguments": "--agent 'x y:Z' $(touch owned)", "directory": "g//"}
    runner = Runner("gate", tmp_path, **words, fail_on_undecided=strict)
    (tmp_path / "bin").mkdir()
    stub = tmp_path / "bin" / "crashhunt"
    stub.write_text(GATE_STUB)
    stub.chmod(0o755)
    path = f"{stub.parent}{os.pathsep}{runner.environment['PATH']}"
    runner.environment |= {"PATH": path, "VERDICT": verdict, "CODE": str(code)}
    told = runner.run()
    assert runner.failed == fails, runner.said
    assert told["verdict"] == verdict
    assert bool(runner.artifacts) == bool(verdict)
    (asked_for,) = asked(tmp_path)
    assert asked_for[:5] == ["gate", "a:B", "a:C d", "--most", "1000"]
    assert asked_for[-4:] == ["--agent", "x y:Z", "$(touch", "owned)"]
    assert asked_for[asked_for.index("--keep") + 1] == "g"
    assert not (tmp_path / "owned").exists()


@pytest.mark.nightly
def test_gate_compares_two_commits_as_a_runner_does_it(toy):
    (toy.folder / "driver.py").write_text(AGENT.replace('float("nan") if self.steps > 1005 else ', ""))
    who = ("-c", "user.name=a", "-c", "user.email=a@b", "-c", "commit.gpgsign=false")
    for words in (("init", "-q"), ("add", "driver.py", "toy"), ("commit", "-qm", "slow")):
        subprocess.run(["git", *who, *words], cwd=toy.folder, check=True)
    (toy.folder / "driver.py").write_text(AGENT.replace("self.speed, 0", "20.0, 0"))
    subprocess.run(["git", *who, "commit", "-qam", "fast"], cwd=toy.folder, check=True)
    words = "--scenario toy --agent driver:Driver --arg speed=3 --max-steps 99 --seed 1"
    runner = Runner("gate", toy.folder, base="HEAD~1", arguments=words, most=30)
    told = runner.run()
    assert runner.failed, runner.said
    assert told["verdict"] == "worse"
    assert "crashhunt gate: worse" in runner.summary.read_text()
    assert {path.name for path in runner.artifacts["gate"].iterdir()} >= {"base", "head", "gate.json"}
    assert re.search("^::error title=crashhunt gate%3A worse", runner.said, re.MULTILINE)
