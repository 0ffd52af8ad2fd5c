"""Hunts of a few trials in environments of other projects; prints the table of the guide.

Needs the packages of the table, each of which may be missing: ``pip install minigrid pettingzoo[butterfly,sisl] mpe2
"gymnasium[box2d,mujoco,classic-control,toy-text]" ale-py gymnasium-robotics panda-gym crafter flappy-bird-gymnasium
mo-gymnasium popgym gym-pusht tetris-gymnasium gym-anytrading miniworld``.

A trial counts as bit-identical if a new process replays it with the same digest: a crash by its confirmation, any other
trial by the audit.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

TRIALS, STEPS, TIMEOUT_S = 2, 60, 120


class Environment(NamedTuple):
    """An environment of another project.

    Args:
        id: as in ``[gym]``.
        package: from which it comes, in the index of packages.
        kwargs: of the environment, in TOML.
        crash: the crash rule, in TOML.
    """

    id: str
    package: str
    kwargs: str = ""
    crash: str = "{ termination = true }"


G, M, R = "gymnasium", "minigrid", "gymnasium-robotics"
ENVIRONMENTS = (
    *(Environment(name, G) for name in (
        "CartPole-v1", "Acrobot-v1", "Pendulum-v1", "MountainCar-v0", "MountainCarContinuous-v0",
        "Blackjack-v1", "FrozenLake-v1", "CliffWalking-v1", "Taxi-v4",
        "LunarLander-v3", "BipedalWalker-v3", "CarRacing-v3",
        "Ant-v5", "HalfCheetah-v5", "Hopper-v5", "Humanoid-v5", "Walker2d-v5", "InvertedPendulum-v5", "Swimmer-v5",
        "Reacher-v5", "Pusher-v5",
    )),
    *(Environment(f"minigrid:{name}", M) for name in (
        "MiniGrid-Empty-5x5-v0", "MiniGrid-DoorKey-8x8-v0", "MiniGrid-LavaCrossingS9N1-v0", "BabyAI-GoToObj-v0",
    )),
    *(Environment(f"ale_py:ALE/{name}-v5", "ale-py") for name in ("Pong", "Breakout")),
    *(Environment(f"mpe2.{name}:parallel_env", "mpe2") for name in ("simple_spread_v3", "simple_tag_v3")),
    *(Environment(f"pettingzoo.{name}:parallel_env", "pettingzoo") for name in (
        "sisl.pursuit_v5", "sisl.multiwalker_v9",
        "butterfly.pistonball_v6", "butterfly.knights_archers_zombies_v11", "butterfly.cooperative_pong_v6",
    )),
    Environment("pettingzoo.classic.tictactoe_v3:env", "pettingzoo"),
    *(Environment(f"gymnasium_robotics:{name}", R) for name in (
        "FetchReach-v4", "PointMaze_UMaze-v3", "HandReach-v3",
    )),
    Environment("panda_gym:PandaReach-v3", "panda-gym"),
    Environment("crafter:Env", "crafter"),
    Environment("flappy_bird_gymnasium:FlappyBird-v0", "flappy-bird-gymnasium"),
    Environment("mo_gymnasium:deep-sea-treasure-v0", "mo-gymnasium"),
    Environment("popgym:popgym-RepeatPreviousEasy-v0", "popgym"),
    Environment("gym_pusht:gym_pusht/PushT-v0", "gym-pusht"),
    Environment("tetris_gymnasium.envs.tetris:Tetris", "tetris-gymnasium"),
    Environment("gym_anytrading:stocks-v0", "gym-anytrading"),
    Environment("miniworld:MiniWorld-Hallway-v0", "miniworld"),
    Environment("highway_env:highway-fast-v0", "highway-env", crash='{ info = "crashed" }'),
    Environment("highway_env:parking-v0", "highway-env", crash='{ info = "crashed" }'),
)  # fmt: skip

SCENARIO = """schema = 1
simulator = "gym"
[gym]
id = "{id}"
crash = {crash}
{kwargs}
[agents.me]
agent = "random"
"""


class Row(NamedTuple):
    """What came of an environment."""

    environment: str
    version: str
    observation: str
    action: str
    runs: str
    identical: str
    crash: str
    note: str


def version_of(package: str) -> str:
    """Return the installed version of a package; empty if it is not installed."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return ""


def measure(environment: Environment, folder: Path) -> Row:
    """Hunt in an environment."""
    version = version_of(environment.package)
    name = environment.id.removesuffix(":parallel_env").rpartition(":")[2]
    name = environment.id if name in ("env", "Env") else name
    of = f"{environment.package} {version}" if version else environment.package
    if not version:
        return Row(name, of, "", "", "not tried", "", "", f"pip install {environment.package}")
    scenario = folder / "s.toml"
    kwargs = f"kwargs = {environment.kwargs}" if environment.kwargs else ""
    scenario.write_text(SCENARIO.format(id=environment.id, crash=environment.crash, kwargs=kwargs))
    shown = ask([sys.executable, __file__, "--spaces", str(scenario)], folder)
    seen, acts = map(str, shown) if isinstance(shown, list) else ("", "")
    command = [
        sys.executable, "-m", "crashhunt", "run", "h", "1", str(TRIALS), str(STEPS), "--scenario", "s.toml",
        "--seed", "1", "--keep-going", "--audit", "1", "--timeout", str(TIMEOUT_S), "--json",
    ]  # fmt: skip
    data = ask(command, folder)
    if not isinstance(data, dict) or "error" in data:
        said = data["error"] if isinstance(data, dict) else {"message": "no answer", "fix": "", "where": ""}
        return Row(name, of, seen, acts, "no", "", "", line(said["message"], said["fix"]))
    faults = {"agent_error", "simulator_error", "process_died", "hang", "invalid"} & data["outcomes"].keys()
    crashes = data["crashes"]
    confirmed = [crash["confirmed"] for crash in crashes]
    audit = data["audit"]
    checked, differing = len(crashes) + audit["trials"], confirmed.count(False) + len(audit["differences"])
    same = f"{checked - differing} of {checked}"
    note = "; ".join(data["notes"])
    for first in audit["differences"][:1]:
        note = f"{first['field']} differs from step {first['step']} on: {first['recorded']}, {first['replayed']}"
    if faults:
        told = subprocess.run(
            [sys.executable, "-m", "crashhunt", "show", "h"], cwd=folder, capture_output=True, text=True, check=False
        )
        lines = [text for text in told.stdout.splitlines() if text.strip()]
        note = lines[2] if len(lines) > 2 else note
    found = data["outcomes"].get("collision", 0)
    return Row(name, of, seen, acts, "no" if faults else "yes", same, str(found), line(note))


def line(*parts: str) -> str:
    """Return text as a cell of a table."""
    text = "; ".join(" ".join(part.split()) for part in parts if part).replace("|", "\\|")
    return text if len(text) <= 160 else f"{text[:159]}…"


def ask(command: list[str], folder: Path) -> object:
    """Return the JSON that a command prints last; None if it prints none."""
    try:
        done = subprocess.run(
            command, cwd=folder, capture_output=True, text=True, timeout=600, stdin=subprocess.DEVNULL, check=False
        )
    except subprocess.TimeoutExpired:
        return {"error": {"message": "the hunt took more than 600 s", "fix": "", "where": ""}}
    for text in reversed(done.stdout.splitlines()):
        try:
            return json.loads(text)
        except ValueError:
            continue
    return None


def print_spaces(scenario: str) -> None:
    """Print how the spaces of an environment are recorded."""
    from crashhunt.gym import GymSimulator
    from crashhunt.scenario import load_scenario
    from crashhunt.simulators._any_space import FlatAction, OpaqueAction

    simulator = GymSimulator(load_scenario(scenario), Path())
    form, action = simulator._form, simulator.actions["me"]
    how = "" if not form.structured else " (flat)" if form.flattened else " (text)"
    acts = " (text)" if isinstance(action, OpaqueAction) else " (flat)" if isinstance(action, FlatAction) else ""
    print(json.dumps([f"{words(form.original)}{how}", f"{words(action.space)}{acts}"]))


def words(space: Any) -> str:
    """Return a space in a few words."""
    kind = type(space).__name__
    inside = getattr(space, "spaces", None)
    if inside is not None:
        parts = inside.values() if hasattr(inside, "values") else inside
        return f"{kind} of {', '.join(dict.fromkeys(type(part).__name__ for part in parts))}"
    if kind == "Discrete":
        return f"Discrete({space.n})"
    shape = getattr(space, "shape", None)
    return f"{kind}{shape} {space.dtype}" if shape is not None else kind


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help="only environments whose id has one of these in it")
    parser.add_argument("--spaces", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.spaces:
        print_spaces(options.spaces)
        return
    print("| environment | package | observation | action | runs | bit-identical | crashes | note |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    for environment in ENVIRONMENTS:
        if options.names and not any(name in environment.id for name in options.names):
            continue
        with tempfile.TemporaryDirectory() as folder:
            row = measure(environment, Path(folder))
        print("|", " | ".join(cell or "-" for cell in row), "|", flush=True)


if __name__ == "__main__":
    main()
