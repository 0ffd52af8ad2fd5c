"""The environment that begins with saved crashes: where it begins, what it draws, and what it refuses."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import threading
import warnings
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
from conftest import Shell, wait_for
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env

import crashhunt
from crashhunt.crashes import list_bundles
from crashhunt.errors import CrashhuntError, SimulatorError
from crashhunt.replays import ReplayOptions, prepare
from crashhunt.training import CrashEnv, _training_episodes as _episodes
from crashhunt.training._crash_priorities import CrashReplay
from crashhunt.training._training_episodes import _Start
from crashhunt.trial import Outcome

TOY = """
title = "A toy"
schema = 1
simulator = "toy"
step_length_s = 0.1
[arguments.gap_m]
default = 12.0
range = "8:16"
[agents.ego]
agent = "crashhunt.agents:KeepLaneWithSpeed"
action = "ACTION"
[agents.ego.arguments.speed]
default = 12.0
"""
BEFORE_S = 1.0


def hunt(folder, name, *, action="meta", trials=5, scenario="toy"):
    (folder / f"{scenario}.toml").write_text(TOY.replace("ACTION", action))
    words = ("run", name, "1", str(trials), "60", "--scenario", f"{scenario}.toml", "--seed", "4", "--keep-going")
    Shell(folder).crashhunt(*words, "--no-snapshot")
    return folder / name


def hunted(shell):
    hunt(shell.folder, "hunt")


@pytest.fixture(scope="module")
def crashes(made_once, tmp_path_factory):
    return made_once(hunted, Shell(tmp_path_factory.mktemp("training"))).folder / "hunt"


@pytest.fixture
def env(crashes):
    made = CrashEnv(crashes, before_s=BEFORE_S, share=1.0)
    yield made
    made.close()


def finish(env, action=1):
    """Drive to the end of the episode; return the last info and the sum of rewards."""
    total = 0.0
    while True:
        _, reward, terminated, truncated, info = env.step(action)
        total += reward
        if terminated or truncated:
            return info, total


def bundle_of(crashes, name):
    return next(bundle for bundle in list_bundles(crashes) if bundle.id == name.rpartition("/")[2])


def test_recorded_actions_lead_to_the_same_crash(env, crashes):
    assert len(env.crashes) >= 2
    for name in env.crashes:
        bundle = bundle_of(crashes, name)
        recording, steps = bundle.recording(), bundle.result.steps
        observation, info = env.reset(options={"crash": name})
        assert info["step"] == max(0, steps - round(BEFORE_S / 0.1))
        assert np.array_equal(observation, recording.observations("ego")[info["step"]])
        assert (info["crash"], info["seed"]) == (name, bundle.result.spec.seed)
        for action in recording.actions("ego")[info["step"] :]:
            _, _, terminated, truncated, last = env.step(action)
        assert (terminated, truncated) == (True, False)
        assert (last["step"], last["outcome"], last["has_crashed"]) == (steps, "collision", True)


def test_a_crash_can_be_avoided_and_the_episode_is_truncated_later(crashes):
    env = CrashEnv(crashes, before_s=2.0, after_s=0.5, share=1.0)
    avoided = 0
    for name in env.crashes:
        steps = bundle_of(crashes, name).result.steps
        env.reset(options={"crash": name})
        info, _ = finish(env, action=4)  # SLOWER
        if not info["has_crashed"] and steps + 5 < 60:  # before the hunt's own limit
            avoided += 1
            assert (info["outcome"], info["step"]) == ("survived", steps + 5)
            assert env.scores[name] < 1.0
    assert avoided


def test_same_seed_gives_the_same_episodes(crashes):
    seen = []
    env = CrashEnv(crashes, before_s=BEFORE_S, share=0.5)
    for _ in range(2):
        found = []
        for episode in range(6):
            observation, info = env.reset(seed=7 if episode == 0 else None)
            found.append((observation.tobytes(), tuple(info.items()), finish(env)[1]))
        seen.append(found)
    assert seen[0] == seen[1]
    names = {dict(facts)["crash"] for _, facts, _ in seen[0]}
    assert "" in names
    assert len(names) > 1


def test_the_users_random_generators_keep_their_state(env):
    before = random.getstate(), np.random.get_state()[1].tolist()  # noqa: NPY002 - which scenarios may use
    env.reset(seed=1)
    finish(env)
    assert (random.getstate(), np.random.get_state()[1].tolist()) == before  # noqa: NPY002


def test_passes_gymnasiums_checker(crashes):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        env = crashhunt.make_training_env([crashes], before_s=BEFORE_S)
        check_env(env.unwrapped, skip_render_check=True)
    assert isinstance(env.unwrapped, CrashEnv)


def test_vector_environments(crashes):
    def make():
        return gymnasium.make("crashhunt:crashhunt/Crashes-v0", crashes=[crashes], before_s=BEFORE_S)

    vector = gymnasium.vector.SyncVectorEnv([make, make])
    observations, _ = vector.reset(seed=[5, 5])
    assert np.array_equal(observations[0], observations[1])
    for _ in range(20):
        observations, *_ = vector.step(np.array([1, 1]))
        assert np.array_equal(observations[0], observations[1])
    vector.close()


@pytest.mark.nightly
def test_a_process_of_its_own_gives_the_same_episodes(crashes):
    found = []
    for process in (False, True):
        env = CrashEnv(crashes, before_s=BEFORE_S, share=0.5, process=process)
        episodes = []
        for episode in range(3):
            observation, info = env.reset(seed=2 if episode == 0 else None)
            episodes.append((observation.tobytes(), info, finish(env)))
        env.close()
        found.append(episodes)
    assert found[0] == found[1]


@pytest.fixture
def remote(crashes):
    made = CrashEnv(crashes, before_s=BEFORE_S, share=1.0, process=True)
    yield made
    made.close()


@pytest.mark.nightly  # by day, that of an environment which repeats no crashes: tests/envs/test_sumo_env.py
@pytest.mark.parametrize("crash", ["", None])
def test_a_killed_process_is_reported_whatever_is_asked_next(remote, crash):
    remote.reset(seed=1)
    os.kill(remote._episodes.pid, signal.SIGKILL)
    for _ in range(2):
        with pytest.raises(SimulatorError, match="the process of the environment ended by signal 9; make a new"):
            remote.reset(options={"crash": crash})
    remote.close()
    remote.close()


def test_requests_of_several_threads_do_not_mix(remote):
    failed = []

    def ask(name, words, kind):
        try:
            for _ in range(20):
                assert isinstance(remote._episodes._ask(name, *words), kind)
        except Exception as error:
            failed.append(error)

    kinds = [("agent_name", (), str), ("reset_to_crash", (0,), tuple), ("agent_name", (), str)]
    threads = [threading.Thread(target=ask, args=words) for words in kinds]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not failed


def test_a_compact_recording_is_compared_by_the_actors_that_it_has(crashes):
    env = CrashEnv(crashes, before_s=BEFORE_S, share=1.0)
    name = env.crashes[0]
    rerun = prepare(bundle_of(crashes, name), ReplayOptions(code="current"))
    compact = rerun.recorded.compacted((), radius_m=0.1, observations=False)
    start = _Start.of(replace(rerun, recorded=compact), "ego", BEFORE_S)
    assert start.scenes[0][0] == ("ego",)  # without the vehicle ahead
    env._episodes._starts[0] = start
    assert env.reset(options={"crash": name})[1]["step"] == len(start.actions)
    env._episodes._starts[0] = replace(start, actions=tuple(np.asarray(4 - action) for action in start.actions))
    with pytest.raises(SimulatorError, match="the scene of step"):
        env.reset(options={"crash": name})


def test_crashes_of_a_corpus(crashes, shell):
    bundles = list_bundles(crashes)[:2]
    shell.crashhunt("corpus", "add", *(str(bundle.path) for bundle in bundles), "--to", "corpus")
    env = CrashEnv(shell.folder / "corpus", before_s=BEFORE_S, share=1.0, test=0.0)
    assert [name.rpartition("/")[2] for name in env.crashes] == [bundle.id for bundle in bundles]
    assert env.reset(seed=1)[1]["crash"] in env.crashes


def refused(crashes, **options):
    with pytest.raises(CrashhuntError) as caught:
        CrashEnv(crashes, **{"before_s": BEFORE_S, **options})
    assert "\n" not in str(caught.value)
    assert caught.value.fix
    return str(caught.value)


def test_bad_input_is_one_line(crashes, tmp_path):
    assert "'nowhere' is not a directory" in refused("nowhere")
    assert "no crash was saved here" in refused(tmp_path)
    assert "no controlled vehicle 'other'" in refused(crashes, agent="other")
    assert "crashes is in the training part (test=0.999999)" in refused(crashes, test=0.999999)


def test_crashes_of_other_scenarios_and_spaces_are_refused(crashes, tmp_path, monkeypatch):
    other, begin = tmp_path / "other", _episodes._Stage.__init__
    shutil.copytree(crashes, other)
    for name, value, said in (
        ("name", "another.toml", "the crashes belong to two scenarios: 'toy.toml' and 'another.toml'"),
        ("action_space", spaces.Box(-1.0, 1.0), "the action spaces differ: Discrete(5) and Box("),
        ("observation_space", spaces.Discrete(2), "the observation spaces differ: Box("),
    ):

        def begin_another(stage, bundle, *words, name=name, value=value):
            begin(stage, bundle, *words)
            if bundle.hunt == other:
                setattr(stage, name, value)

        monkeypatch.setattr(_episodes._Stage, "__init__", begin_another)
        assert said in refused([crashes, other], test=0.0)


def test_a_crash_without_its_snapshot_is_refused(crashes, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(crashes, copy)
    shutil.rmtree(copy / "snapshots")
    assert "the snapshot is missing; copy the whole directory of the hunt, or write the crash" in refused(copy)


def test_step_before_a_reset_is_reported(env):
    with pytest.raises(SimulatorError, match="no episode is running"):
        env.step(1)


@pytest.mark.parametrize(
    ("outcome", "was_truncated", "ends"),
    [
        (Outcome.FINISHED, True, (False, True)),
        (Outcome.FINISHED, False, (True, False)),
        (Outcome.FINISHED, None, (True, False)),  # by a simulator without this report
        (Outcome.COLLISION, True, (True, False)),
        (Outcome.SURVIVED, False, (False, True)),
    ],
)
def test_time_limit_of_an_environment_truncates_an_episode(outcome, was_truncated, ends):
    episodes, simulator = object.__new__(_episodes.CrashEpisodes), SimpleNamespace(was_truncated=was_truncated)
    simulator.actions = {"ego": SimpleNamespace(encode=lambda action: action)}
    episode = SimpleNamespace(
        result=None, spec=SimpleNamespace(reseeding=None), steps=3, scene=SimpleNamespace(time_s=0.3),
        observations={"ego": 1}, rewards={"ego": 1.0}, terminations={"ego": outcome == Outcome.FINISHED},
        step=lambda actions: SimpleNamespace(outcome=outcome),
    )  # fmt: skip
    settings = SimpleNamespace(crash_on=(Outcome.COLLISION,))
    episodes._episode = episode
    episodes._running = SimpleNamespace(simulator=simulator, agent="ego", settings=settings)
    assert episodes.step(1)[2:4] == ends


# The other simulators, and other libraries' vectors of environments.


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("scenario", "steps", "disturb"), [("loop", 400, ("brake=0.05",)), ("highway", 40, ())], ids=["sumo", "highway"]
)
def test_recorded_actions_lead_to_the_same_crash_elsewhere(scenario, steps, disturb, tmp_path):
    crashhunt.run(
        tmp_path / "hunt", 2, 40, steps, scenario=scenario, seed=1, keep_going=True, disturb=disturb,
        snapshot_code=False,
    )  # fmt: skip
    env = CrashEnv(tmp_path / "hunt", before_s=3.0, share=1.0, test=0.0)
    assert env.crashes
    for name in env.crashes:
        bundle = bundle_of(tmp_path / "hunt", name)
        recording = bundle.recording()
        observation, info = env.reset(options={"crash": name})
        assert np.array_equal(observation, recording.observations(env.agent)[info["step"]])
        for action in recording.actions(env.agent)[info["step"] :]:
            _, _, terminated, _, last = env.step(action)
        assert (terminated, last["step"], last["has_crashed"]) == (True, bundle.result.steps, True)
    env.reset(options={"crash": ""})
    env.close()


@pytest.mark.nightly
@pytest.mark.parametrize("agent", ["ego", "second"])
def test_the_other_agents_drive_as_in_the_hunt(agent, tmp_path):
    second = '[agents.second]\nagent = "crashhunt.agents:CarFollowing"\naction = "meta"\n'
    (tmp_path / "two.toml").write_text(TOY.replace("ACTION", "meta") + second)
    words = ("run", "hunt", "1", "6", "60", "--scenario", "two.toml", "--seed", "4", "--keep-going", "--no-snapshot")
    Shell(tmp_path).crashhunt(*words)
    env = CrashEnv(tmp_path / "hunt", before_s=BEFORE_S, share=1.0, test=0.0, agent=agent)
    for name in env.crashes:
        bundle = bundle_of(tmp_path / "hunt", name)
        _, info = env.reset(options={"crash": name})
        for action in bundle.recording().actions(agent)[info["step"] :]:
            _, _, terminated, _, last = env.step(action)
        assert (terminated, last["step"]) == (True, bundle.result.steps)


VECTORS = """
import sys
import gymnasium
import numpy as np

def make():
    return gymnasium.make("crashhunt:crashhunt/Crashes-v0", crashes=[sys.argv[1]], before_s=1.0)

if __name__ == "__main__":
    vector = gymnasium.vector.AsyncVectorEnv([make, make])
    first, _ = vector.reset(seed=[5, 5])
    assert np.array_equal(first[0], first[1])
    vector.step(np.array([1, 1]))
    vector.close()
    try:
        from stable_baselines3 import PPO
        from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv
    except ImportError:
        sys.exit()
    for kind in (DummyVecEnv, SubprocVecEnv):
        several = kind([make, make])
        PPO("MlpPolicy", several, n_steps=32, batch_size=32, n_epochs=1, device="cpu", seed=1).learn(128)
        several.close()
"""


@pytest.mark.nightly
def test_vectors_of_processes_and_of_stable_baselines3(crashes, tmp_path):
    (tmp_path / "vectors.py").write_text(VECTORS)
    words = [sys.executable, "vectors.py", str(crashes)]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, timeout=500, check=False)
    assert done.returncode == 0, done.stderr


ATTACKED = """
import sys
import gymnasium

def make():
    words = {"crashes": [sys.argv[1]], "before_s": 1.0, "process": True, "trained_on": "policy"}
    return gymnasium.make("crashhunt:crashhunt/Crashes-v0", **words)

if __name__ == "__main__":
    vector = gymnasium.vector.AsyncVectorEnv([make, make])
    vector.reset(seed=[1, 2])
    print("ready", flush=True)
    while True:
        vector.step(vector.action_space.sample())
"""


def processes_with(mark):
    """Return the processes that have a mark in their environment."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            if mark.encode() in (folder / "environ").read_bytes():
                found.append(int(folder.name))
    return found


@pytest.mark.nightly
@pytest.mark.parametrize("attack", ["ctrl-c", "killed program", "killed environment"])
def test_no_process_outlives_a_training(crashes, tmp_path, attack):
    (tmp_path / "attacked.py").write_text(ATTACKED)
    mark = f"ATTACKED={tmp_path}"
    words = [sys.executable, "attacked.py", str(crashes)]
    with subprocess.Popen(
        words, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
        env={**os.environ, "ATTACKED": str(tmp_path)},
    ) as program:  # fmt: skip
        assert program.stdout.readline() == "ready\n"
        alive = processes_with(mark)
        assert len(alive) >= 5  # the program, two workers and their environments
        if attack == "ctrl-c":
            os.killpg(program.pid, signal.SIGINT)
        else:
            names = {pid: Path(f"/proc/{pid}/cmdline").read_text() for pid in alive}
            environments = [pid for pid, name in names.items() if "crashhunt.envs._process" in name]
            assert len(environments) == 2
            os.kill(program.pid if attack == "killed program" else environments[0], signal.SIGKILL)
        said = program.communicate(timeout=100)[1]
    if attack == "killed environment":
        expected = "SimulatorError: the process of the environment ended by signal 9; make a new environment"
        assert said.splitlines()[-1].endswith(expected)
    wait_for(lambda: not processes_with(mark), every_s=0.1)
    assert json.loads((tmp_path / "policy" / "trained_on.json").read_text())["seeds"]
    assert [file.name for file in (tmp_path / "policy").iterdir()] == ["trained_on.json"]


# Which crash is drawn.


def test_a_removed_crash_is_never_drawn_also_after_a_restart():
    replay, rng = CrashReplay(3), np.random.default_rng(1)
    replay.remove(1)
    for index in (0, 2):
        for _ in range(60):
            replay.record(index, has_crashed=False)
    replay.restart()
    assert {replay.draw(rng) for _ in range(60)} == {0, 2}
    replay.remove(0)
    replay.remove(2)
    assert replay.is_empty


def test_solved_crashes_only_are_drawn_evenly():
    replay = CrashReplay(2)
    replay.scores[:] = 0.0
    assert replay.probabilities().tolist() == [0.5, 0.5]
