"""With ``--allow-control``, the page stops hunts and runs commands; without it, and for other sites, it does not."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from conftest import _commands, add_toy, crashes_on_loop, wait_for
from served import served

from crashhunt.dashboard import _control

OURS = {"Host": "localhost", "X-Crashhunt": "1"}


@pytest.fixture
def hunt(shell, made_once):
    return made_once(crashes_on_loop, shell).folder / "runs"


def test_nothing_is_controlled_unless_it_is_allowed(hunt):
    with served(hunt) as dashboard:
        one = f"/api/hunts/{dashboard.hunts()['one']['id']}"
        crash = dashboard.get(f"{one}/crashes")["crashes"][0]["id"]
        assert dashboard.get("/api")["control"] is False
        for target in (f"{one}/stop", f"{one}/crashes/{crash}/jobs/replay"):
            assert dashboard.ask(target, OURS, method="POST").status == 405
        assert dashboard.ask(f"{one}/crashes/{crash}/jobs").status == 404


def test_unknown_jobs_and_what_cannot_be_stopped_are_refused(hunt):
    with served(hunt, control=True) as dashboard:
        one = f"/api/hunts/{dashboard.hunts()['one']['id']}"
        crash = dashboard.get(f"{one}/crashes")["crashes"][0]["id"]
        jobs = f"{one}/crashes/{crash}/jobs"
        for name in ("rm", "export", "..%2freplay", "--version"):
            assert dashboard.ask(f"{jobs}/{name}", OURS, method="POST").status in (404, 409)
        assert dashboard.ask(f"{one}/crashes/nothing/jobs/replay", OURS, method="POST").status == 404
        assert dashboard.ask(f"{one}/stop", OURS, method="POST").status == 409
        assert dashboard.get(jobs)["jobs"] == []


class Forked:
    """A command of the page in a fork, as far as the page's jobs use a `subprocess.Popen`."""

    def __init__(self, words, environment, **streams):
        assert words[:4] == [sys.executable, "-P", "-m", "crashhunt"]
        assert streams == {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
        out, write = os.pipe()
        self._begun = _commands().begin(words[4:], Path.cwd(), environment, terminal=write, streams=(1, 2))
        os.close(write)
        self.stdout = os.fdopen(out, "rb")

    def wait(self):
        self._begun.communicate()
        return self._begun.returncode

    def send_signal(self, number):
        self._begun.send_signal(number)


@pytest.mark.long
@pytest.mark.parametrize(
    "names", [{"replay"}, pytest.param({"replay", "judge", "shrink"}, marks=pytest.mark.nightly)], ids=len
)
def test_commands_are_started_from_the_page_and_run(toy, page, names, monkeypatch):
    if len(names) == 1:  # at night they are processes as they are for users
        started = SimpleNamespace(
            Popen=lambda words, **streams: Forked(words, toy.environment, **streams),
            DEVNULL=subprocess.DEVNULL, PIPE=subprocess.PIPE, STDOUT=subprocess.STDOUT,
        )  # fmt: skip
        monkeypatch.setattr(_control, "subprocess", started)
    words = ("--scenario", "toy", "--arg", "speed=8:20", "--seed", "4", "--no-snapshot")
    toy.crashhunt("run", "one", "1", "1", "99", *words)
    with served(toy.folder / "one", control=True) as dashboard:
        one = f"/hunts/{dashboard.hunts()['one']['id']}"
        (crash,) = dashboard.get(f"/api{one}/crashes")["crashes"]
        page.open(f"{dashboard.url}{one}/crashes/{crash['id']}")
        page.wait("!document.getElementById('control').hidden")
        before = page.text("#verdict")
        assert before.startswith("ego drove into the back of leader")
        for name in sorted(names):
            page.run("document.querySelector(`[data-job=${arguments[0]}]`).click()", name)
        jobs = f"/api{one}/crashes/{crash['id']}/jobs"
        ended = wait_for(
            lambda: (
                len(found := [job for job in dashboard.get(jobs)["jobs"] if job["state"] == "ended"]) == len(names)
                and found
            ),
            every_s=0.1,
        )
        assert {job["name"]: job["exit_code"] for job in ended} == dict.fromkeys(names, 0), ended
        output = {job["name"]: job["output"] for job in ended}
        assert "reproduced" in output["replay"]
        page.wait("document.getElementById('jobs').innerText.includes('replay: ended with exit code 0')")
        if "judge" not in names:
            return
        assert "saved in" in output["shrink"]
        assert "It could be avoided until" in output["judge"]
        # Without a reload; textContent, because the evidence is folded.
        page.wait("document.getElementById('words').textContent.includes('It could be avoided until')")
        judged = dashboard.get(f"/api{one}/crashes/{crash['id']}")
        assert judged["judged"]["verdict"] == "avoidable"
        assert page.text("#verdict") == judged["verdict"]
        page.wait("document.querySelector('#related a')?.innerText === arguments[0]", f"{crash['id']}.small")
        page.run("document.querySelector('#related a').click()")
        page.wait("location.pathname.endsWith('.small') && window.crashhuntView?.crash")
        assert page.text("#related") == f"minimized from {crash['id']}"
        for name in (".small", "x.small", f"..%2F{crash['id']}.small", f"{crash['id']}.small.small"):
            assert dashboard.ask(f"/api{one}/crashes/{name}").status == 404


def test_a_running_hunt_is_stopped_as_by_ctrl_c(shell):
    root = shell.folder / "runs"
    root.mkdir()
    words = ("--set", "step_wall_s=0.001", "--arg", "speed=5", "--seed", "1", "--keep-going", "--no-snapshot")
    process = add_toy(shell).begin("run", "runs/one", "1", "3000", "99", "--scenario", "toy", *words)
    try:
        with served(root, control=True) as dashboard:
            wait_for(lambda: any(row["trials_run"] for row in dashboard.hunts().values()), every_s=0.1)
            row = dashboard.hunts()["one"]
            assert row["state"] == "running"
            workers = wait_for(lambda: dashboard.get(f"/api/hunts/{row['id']}")["workers"], every_s=0.1)
            assert 0 <= workers[0]["since_s"] < 3600
            assert dashboard.ask(f"/api/hunts/{row['id']}/stop", OURS, method="POST").status == 200
            process.communicate(timeout=240)
            assert process.returncode == 130
            assert dashboard.hunts()["one"]["state"] == "interrupted"
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGKILL)
            process.communicate(timeout=60)
