"""Every operation on a crash, for every form of actions, on SUMO: it works, or refuses in one line."""

from __future__ import annotations

import pytest

from crashhunt.scenario import ACTIONS

pytest.importorskip("libsumo")

# One blind driver for each form: it accelerates along its straight lane until it hits the vehicle ahead.
AGENT = '''
import numpy as np

ANSWERS = {
    "speed_and_lane": lambda speed, top: (top, 0),
    "speed_and_lateral": lambda speed, top: (top, 0.0),
    "meta": lambda speed, top: 3 if speed < top else 1,
    "acceleration": lambda speed, top: (2.0 * (speed < top), 0),
    "acceleration_steering": lambda speed, top: (2.0 * (speed < top), 0.0),
    "throttle_brake_steering": lambda speed, top: (0.8 * (speed < top), 0.0, 0.0),
    "trajectory:frame=ego": lambda speed, top: trajectory(speed, 2.0 * (speed < top)),
    "target_pose:frame=ego": lambda speed, top: (max(1.0, speed + (speed < top)), 0.0, 0.0, 1.0),
    "sumo": lambda speed, top: (top, 0),
}


def trajectory(speed, acceleration):
    t = np.arange(0.0, 1.01, 0.1)
    return np.column_stack((t, speed * t + acceleration * t * t / 2, 0 * t, 0 * t, speed + acceleration * t))


class Blind:
    observation = "ego"

    def __init__(self, columns, form: str = "meta", top: float = 30.0):
        self.speed, self.answer, self.top = columns["ego"]["speed"], ANSWERS[form], top

    def reset(self, seed):
        pass

    def act(self, observation):
        return self.answer(float(observation["ego"][self.speed]), self.top)


class Planned(Blind):
    """Plans all its poses at the start: it accelerates by 2 m/s², whatever happens."""

    def reset(self, seed):
        self.poses = None

    def act(self, observation):
        x, y, heading, speed = observation["ego"][:4].tolist()
        if self.poses is None:
            self.poses = ((x + speed * t + t * t, y, heading, 0.1) for t in np.arange(0.1, 99.0, 0.1))
        return next(self.poses)
'''
RELATIVE = ("trajectory", "target_pose")
WITHOUT_LANE_CHANGES = (
    "speed_and_lateral", "acceleration_steering", "throttle_brake_steering", "trajectory", "target_pose",
)  # fmt: skip
WITHOUT_REFERENCE = ("speed_and_lateral", "sumo")
OPERATIONS = {
    "replay": ("replay", "h", "--expect", "reproduced"),
    "fault": ("crashes", "h", "--json"),
    "judge": ("judge", "h", "--runs", "12", "--why", "10", "--reference", "3", "--json"),
    "braking": ("whatif", "h", "--before", "3", "--overrule", "brake", "--times", "1", "--json"),
    "lane change": ("whatif", "h", "--before", "3", "--overrule", "left", "--times", "1", "--json"),
    "keep lane": ("whatif", "h", "--before", "1", "--overrule", "keep_lane", "--times", "1", "--json"),
    "reference driver": ("whatif", "h", "--before", "3", "--overrule", "reference", "--times", "1", "--json"),
    "futures": ("whatif", "h", "--before", "1", "--futures", "--times", "1", "--json"),
    "minimize": ("shrink", "h", "--budget", "5", "--json"),
    "film": ("replay", "h", "--from-log", "--gif", "f.gif", "--size", "128x64", "--fps", "1", "--last-seconds", "1"),
    "OpenSCENARIO": ("export", "h", "f.xosc", "--as", "openscenario", "--recorded-agent"),
    "CommonRoad": ("export", "h", "f.xml", "--as", "commonroad", "--recorded-agent"),
    "disturbances": ("--disturb", "brake=0.2,cut_in=0.2,noisy_observation=0.2,late_observation=0.2"),
    "late actions": ("--disturb", "late_action=0.5"),
    "probes": ("--probe", "2s"),
    "branches": ("--disturb", "brake=0.05", "--branch"),
    "near misses": ("--near-misses", "1"),
}
REFUSED = {
    **{(form, "lane change"): "none of its actions is known to change the lane" for form in WITHOUT_LANE_CHANGES},
    **{(form, "late actions"): "which cannot be delayed" for form in RELATIVE},
    **{(form, "reference driver"): "the lanes and speeds that its actions mean are" for form in WITHOUT_REFERENCE},
    ("sumo", "keep lane"): "the lane of ego cannot be held",
    ("trajectory", "disturbances"): "would return a trajectory that does not begin where the vehicle is",
}  # as the page reference/actions.md says; tests/on_sumo/test_declared_actions_on_sumo.py compares it by day


def hunt(shell, form, *options, trials="1", steps="300", expect=0):
    name = f"{form}:frame=ego" if form in RELATIVE else form
    words = ("--scenario", "motorway", "--agent", "blind:Blind", "--action", name, "--arg", f"form={name}")
    (shell.folder / "blind.py").write_text(AGENT)
    return shell.crashhunt("run", *words, "--seed", "3", *options[1:], options[0], "1", trials, steps, expect=expect)


def outcome(shell, form, operation):
    """The first line of the refusal; empty if the operation works."""
    words = OPERATIONS[operation]
    if not words[0].startswith("--"):
        done = shell.crashhunt(*words, expect=None)
    else:  # 20 steps before the crash, so that the trial survives
        done = hunt(shell, form, operation.replace(" ", "-"), *words, "--keep-going", steps="35", expect=None)
    print("@@", form, operation, done.code, done.err[-250:].replace("\n", "|"), flush=True)
    if done.code == 2:
        assert done.err.count("\n") == 1, done.err
        return done.err.removeprefix("crashhunt: ")
    assert done.code == 0, (done.out, done.err)
    assert "Traceback" not in done.err
    return ""


def test_agent_that_was_overruled_is_not_blamed_for_poses_that_are_due_in_the_next_step(shell):
    (shell.folder / "blind.py").write_text(AGENT)
    words = ("--scenario", "motorway", "--agent", "blind:Planned", "--action", "target_pose", "--seed", "3")
    shell.crashhunt("run", "h", "1", "1", "100", *words, "--no-snapshot")
    found = shell.crashhunt("whatif", "h", "--before", "3", "--overrule", "reference", "--json").json
    assert not found["outcomes"].get("agent_error"), found
    (judged,) = shell.crashhunt(
        "judge", "h", "--runs", "1", "--why", "0", "--reference", "9", "--no-drivers", "--json"
    ).json["judged"]
    assert judged["reference"]["omission"], judged["reference"]


@pytest.mark.nightly
@pytest.mark.parametrize("form", ACTIONS)
def test_every_operation_works_with_every_form_or_refuses_in_one_line(shell, form):
    hunt(shell, form, "h")
    found = {operation: outcome(shell, form, operation) for operation in OPERATIONS}
    for operation, said in found.items():
        assert REFUSED.get((form, operation), "") in said, operation
        assert bool(said) == ((form, operation) in REFUSED), (operation, said)
    shown = shell.crashhunt("show", "h", "--json").json
    assert shown["judged"]["avoidable"]
    assert shown["fault"]["verdict"] == "ego"
