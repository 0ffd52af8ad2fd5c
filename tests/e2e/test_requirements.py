"""Requirements on the command line: from the formula to the crash that is replayed, shown and kept."""

from __future__ import annotations

import json
import tomllib

CALM = "calm=always (acceleration > -6)"


def hunt(shell, *words, name="h", trials="12", expect=0):
    options = ["--scenario", "toy", "--seed", "4", "--no-snapshot", "--json"]
    return shell.crashhunt("run", name, "1", trials, "60", *options, *words, expect=expect)


def collect(shell):
    """Collect the violations of two requirements, in ``h``; for `made_once`."""
    words = ["--require", CALM, "--require", "apart=always (clearance_m > 6)", "--oracle", "none", "--keep-going"]
    words += ["--keep", "1"]
    hunt(shell, *words, trials="3")


def test_violations_are_crashes_of_one_type_per_requirement(toy, made_once):
    made_once(collect, toy)
    found = {}
    for path in (toy.folder / "h" / "crashes").iterdir():
        crash = json.loads((path / "crash.json").read_text())
        found.setdefault(crash["event"]["name"], path.name)
        assert crash["outcome"] == "requirement"
        assert crash["confirmed"] is True
        assert set(crash["robustness"]) == {"calm", "apart"}
    assert set(found) == {"calm", "apart"}
    for name, crash in found.items():
        assert toy.crashhunt("replay", "h", "--crash", crash, "--json").json["verdict"] == "reproduced"
        shown = toy.crashhunt("show", "h", "--crash", crash).out
        assert f"violates {name}: always (" in shown
        assert "is false at step" in shown
    types = {group["signature"]["manner"] for group in toy.crashhunt("crashes", "h", "--json").json["groups"]}
    assert types == {"requirement calm", "requirement apart"}
    assert toy.crashhunt("check", "h").code == 0


def test_a_kept_violation_is_reproduced_and_fails_the_corpus(toy, made_once):
    made_once(collect, toy)
    crash = min(path.name for path in (toy.folder / "h" / "crashes").iterdir())
    toy.crashhunt("corpus", "add", "h", "--to", "kept", "--crash", crash)
    case = toy.crashhunt("corpus", "run", "kept", "--json", expect=None).json["cases"][0]
    assert case["got"] == "still"


def test_requirements_of_the_scenario_hold_unless_others_are_given(toy):
    file = toy.folder / "toy" / "scenario.toml"
    text = file.read_text()
    file.write_text('requirement.calm = "always (acceleration > -6)"\n' + text)
    crash = hunt(toy).json["crashes"][0]
    assert (crash["outcome"], crash["requirement"]) == ("requirement", "calm")
    settings = tomllib.loads((toy.folder / "h" / "hunt.toml").read_text())
    assert "requirement:calm=always (acceleration > -6)" in settings["oracles"]
    other = hunt(toy, "--require", "always (speed >= 0)", name="o", trials="3").json
    assert "requirement" not in other["outcomes"]


def test_a_requirement_that_cannot_be_used_is_refused_in_one_line(toy):
    for text, message in (  # mistakes of the language in tests/requirements/test_language.py
        ("always (sped > 1)", "the signal 'sped' of ego is unknown; did you mean 'speed'?"),
        ("always[0:90] (speed > 1)", "its windows end 90 s after a sample, and 60 steps take"),
    ):
        done = hunt(toy, "--require", text, expect=2)
        assert message in done.err
        assert "\n" not in done.json["error"]["message"]
    file = toy.folder / "toy" / "scenario.toml"
    file.write_text('requirement."so so" = "speed > 1"\n' + file.read_text())
    assert "'so so' is not a name of a requirement" in hunt(toy, expect=2).err


def test_signals_are_listed_with_units(toy):
    listed = toy.crashhunt("signals", "toy", "--json").json
    assert {"name": "speed", "unit": "m/s", "meaning": "speed along the heading"} in listed["signals"]
    assert listed["agents"] == ["ego"]
    (toy.folder / "needs.py").write_text(DRIVER)
    words = ("--agent", "needs:Follows", "--arg", "speed=signal:0:1", "--observe", "actors:rows=1,ego", "--json")
    observed = [one for one in toy.crashhunt("signals", "toy", *words).json["signals"] if "observation" in one["name"]]
    assert observed[-1]["meaning"].endswith("of the part ego")
    path = toy.folder / "toy" / "scenario.toml"
    path.write_text(f'requirement.late = "eventually[0:99] (speed > 1)"\n{path.read_text()}')
    assert "m/s²" in toy.crashhunt("signals", "toy").out  # although the window is longer than the step that runs


DRIVER = """
class Follows:
    def __init__(self, speed, step_length_s):
        self.speed, self.step_s, self.steps = speed, step_length_s, 0

    def reset(self, seed):
        pass

    def act(self, observation):
        self.steps += 1
        return self.speed((self.steps - 1) * self.step_s), 0
"""
