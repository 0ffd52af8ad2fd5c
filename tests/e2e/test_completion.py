"""The tab key, in a real bash that has read the script."""

from __future__ import annotations

import subprocess

import pytest
from browsers import needed
from conftest import CRASHHUNT, mostly_nightly

# Everything that bash would set when somebody presses the key at the end of the line.
ASK = """
eval "$2"
COMP_LINE=$1 COMP_POINT=${#1} COMP_TYPE=9
complete -p crashhunt | grep -q _python_argcomplete || exit 3
_python_argcomplete crashhunt
printf '%s\\n' "${COMPREPLY[@]}"
"""


@pytest.fixture
def press(toy):
    bash = needed("bash")
    environment = {**toy.environment, "PATH": f"{CRASHHUNT.parent}:{toy.environment['PATH']}"}
    script = toy.crashhunt("completion", "bash").out

    def ask(line: str) -> list[str]:
        done = subprocess.run(
            [bash, "-c", ASK, "bash", line, script], cwd=toy.folder, env=environment, capture_output=True, text=True,
            check=True,
        )  # fmt: skip
        assert done.stderr == ""
        return [word.strip() for word in done.stdout.splitlines() if word.strip()]

    return ask


LINES = [
    ("crashhunt rep", ["replay", "report"]),
    ("crashhunt suite ", ["run", "defaults"]),
    ("crashhunt run out 1 1 9 --scen", ["--scenario"]),
    ("crashhunt run out 1 1 9 --scenario merge", ["merge", "merge-highway-env"]),
    ("crashhunt run out 1 1 9 --scenario to", ["toy/"]),
    ("crashhunt run out 1 1 9 --agent id", ["idm"]),
    ("crashhunt run out 1 1 9 --sampler s", ["sobol", "sweep"]),
    ("crashhunt run out 1 1 9 --crash-on hang,col", ["hang,collision"]),
    ("crashhunt run out 1 1 9 --crash-on red", ["red_light"]),
    ("crashhunt run out 1 1 9 --scenario toy --set g", ["gap_m="]),
    ("crashhunt run out 1 1 9 --scenario merge --arg head", ["headway_s="]),
    ("crashhunt trials h --outcome sur", ["survived"]),
    ("crashhunt replay h --crash ", ["000004-collision", "000017-hang"]),
    ("crashhunt replay h --code c", ["current"]),
    ("crashhunt show ", ["h/", "h.zip", "toy/"]),
    ("crashhunt export h f", ["faulty.py"]),
    ("crashhunt guide det", ["determinism"]),
    ("crashhunt run out 1 1 9 --seed ", []),
]


@pytest.mark.parametrize(
    ("line", "found"),
    mostly_nightly(LINES, LINES[::6]),
)
def test_the_tab_key_completes(press, toy, line, found):
    for name in ("000004-collision", "000017-hang"):
        (toy.folder / "h" / "crashes" / name).mkdir(parents=True)
        (toy.folder / "h" / "crashes" / name / "crash.json").touch()
    (toy.folder / "h.zip").touch()
    assert sorted(press(line)) == sorted(found)


def test_every_shell_gets_a_script_and_others_a_word(toy):
    for shell, says in (("zsh", "compdef"), ("fish", "complete --command crashhunt")):
        assert says in toy.crashhunt("completion", shell).out
    refused = toy.crashhunt("completion", "csh", expect=2)
    assert "give one of bash, zsh, fish" in refused.err
