"""Several Gymnasium environments of ours in one process, each with its own SUMO."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import gymnasium
import numpy as np
import pytest
from conftest import mostly_nightly
from gymnasium.utils.env_checker import check_env

from crashhunt.envs import SumoEnv
from crashhunt.errors import ActionError, SimulatorError, UsageError
from crashhunt.scenario import ACTIONS
from crashhunt.sumo._observing import READERS


def with_every_part(form, scenario="intersection", parts=tuple(READERS)):
    return SumoEnv(scenario, action=form, observation=parts, max_steps=30, process=True)


@pytest.mark.nightly
@pytest.mark.parametrize("form", [name for name in ACTIONS if name not in ("trajectory", "target_pose")])
@pytest.mark.filterwarnings("ignore::UserWarning")  # it recommends other ranges of actions
def test_gymnasium_accepts_every_part_and_every_form_that_can_be_drawn_at_random(form):
    env = with_every_part(form)
    check_env(env, skip_render_check=True)
    env.close()


@pytest.mark.nightly
@pytest.mark.parametrize(("form", "plan"), [
    ("trajectory:frame=ego", lambda v: np.array([[t, v * t, 0.0, 0.0, v] for t in (0.5, 1.0)])),
    ("target_pose:frame=ego", lambda v: np.array([v, 0.0, 0.0, 1.0])),
])  # fmt: skip
def test_plans_drive_the_environment_and_one_that_cannot_be_followed_is_an_error(form, plan):
    env = with_every_part(form)
    observation, _ = env.reset(seed=1)
    for _ in range(10):
        observation, reward, *_ = env.step(plan(float(observation["ego"][3])))
        assert reward > 0.0
        assert env.observation_space.contains(observation)
    with pytest.raises(ActionError, match="moves the vehicle by"):
        env.step(plan(90.0))
    env.close()


@pytest.mark.nightly
def test_every_part_is_stacked_by_gymnasiums_vectors():
    vector = gymnasium.vector.AsyncVectorEnv([lambda: with_every_part("acceleration_steering")] * 2)
    shown, _ = vector.reset(seed=[1, 2])
    assert all(shown[name].shape == (2, *space.shape) for name, space in vector.single_observation_space.items())
    assert vector.step(vector.action_space.sample())[1].shape == (2,)
    vector.close()


@pytest.mark.nightly
def test_stable_baselines3_trains_with_steering_on_a_dictionary_of_parts():
    sb3 = pytest.importorskip("stable_baselines3")
    parts = ("ego", "actors:rows=4", "route:points=10", "route_state", "signals", "right_of_way", "stop_line")
    vector = sb3.common.vec_env.DummyVecEnv([lambda: with_every_part("acceleration_steering", "motorway", parts)] * 2)
    model = sb3.PPO("MultiInputPolicy", vector, n_steps=32, batch_size=32, n_epochs=1, device="cpu", seed=1)
    before = [one.detach().clone() for one in model.policy.parameters()]
    model.learn(128)
    assert model.num_timesteps == 128
    assert any((one != two).any() for one, two in zip(before, model.policy.parameters(), strict=True))
    vector.close()


def test_what_disturbs_the_first_observation_is_reported_with_it():
    env = SumoEnv("loop", disturb="late_observation@1=itself:0.2:1,late_action@2=itself:0.2:1", max_steps=5)
    _, told = env.reset(seed=4)
    *_, then = env.step((8.0, 0))
    env.close()
    assert told["disturbances"] == ["ego sees everything 0.2 s late for 1 s"]
    assert then["disturbances"] == ["what ego does takes effect 0.2 s late for 1 s"]


def test_what_cannot_disturb_is_refused():
    with pytest.raises(UsageError, match="disturb needs a limit on the length of an episode"):
        SumoEnv("loop", disturb="brake=1")
    with pytest.raises(UsageError, match="there is no disturbance 'brakes'"):
        SumoEnv("loop", process=False, disturb="brakes=1", max_steps=5)


def ended(pid):
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline:
        try:
            with open(f"/proc/{pid}/stat") as file:
                if file.read().rpartition(")")[2].split()[0] == "Z":
                    return True
        except OSError:
            return True
        time.sleep(0.05)
    return False


def test_a_process_that_dies_is_reported():
    env = SumoEnv(process=True)
    env.reset(seed=1)
    os.kill(env._episodes._process.pid, signal.SIGKILL)
    with pytest.raises(SimulatorError, match="ended by signal 9; make a new environment"):
        env.step((8.0, 0))
    with pytest.raises(SimulatorError, match="ended by signal 9; make a new environment"):
        env.step((8.0, 0))
    env.close()
    env.close()


def drive(env, steps=25):
    found = []
    for _ in range(steps):
        observation, reward, terminated, _, _ = env.step((15.0, 0))
        found.append((observation.tobytes(), reward, terminated))
        if terminated:
            break
    return found


@pytest.fixture
def branching():
    """A running environment in a process of its own; what it branches is closed with it."""
    env = SumoEnv("loop", process=True)
    env.reset(seed=3)
    drive(env, 20)
    made = [env]
    yield env, made
    pids = [one._episodes.pid for one in made]
    for one in made:
        one.close()
        one.close()
    assert all(ended(pid) for pid in pids)


def test_copies_of_an_episode_are_bit_identical_and_independent(branching):
    env, made = branching
    one, other = env.branch(2)
    made += [one, other]
    assert len({each._episodes.pid for each in made}) == 3
    first = drive(one)
    (nested,) = one.branch(1)
    made.append(nested)
    tail = drive(one, 5)
    assert drive(env) == first == drive(other)  # neither copy has moved the original
    env.close()
    assert drive(other, 5) == tail == drive(nested, 5)  # copies outlive the original
    with pytest.raises(UsageError, match="a copy of an episode cannot be reset"):
        other.reset(seed=1)
    pid = one._episodes.pid
    os.kill(pid, signal.SIGKILL)
    with pytest.raises(SimulatorError, match=rf"^copy 1 of 2 of the environment \(process {pid}\) ended; make a new"):
        one.step((15.0, 0))
    assert drive(other, 5) == drive(nested, 5)


@pytest.mark.nightly  # by day, copies that are not reseeded
def test_reseeded_copies_differ_and_can_be_repeated(branching):
    env, made = branching
    made += (copies := [*env.branch(2, seed=5), *env.branch(2, seed=5)])
    one, other, same, again = (drive(copy) for copy in copies)
    assert one != other
    assert (one, other) == (same, again)


ORPHAN = """
import os, sys, time
from crashhunt.envs import SumoEnv
env = SumoEnv(process=True)
env.reset(seed=1)
if os.fork() == 0:  # a copy holds the connection open
    time.sleep(300)
print(env._episodes._process.pid, flush=True)
os.kill(os.getpid(), 9)
"""


def test_it_ends_with_its_parent_whatever_becomes_of_that():
    with subprocess.Popen(
        [sys.executable, "-c", ORPHAN], stdout=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        pid = int(process.stdout.readline())
        process.wait()
        try:
            assert ended(pid)
        finally:
            os.killpg(process.pid, signal.SIGKILL)  # the copy


ORDERS = """
import sys, warnings
{imports}
warnings.simplefilter("ignore")

def make():
    return gymnasium.make("crashhunt:crashhunt/SUMO-v0", action="meta", max_steps=5)

if __name__ == "__main__":
    if len(sys.argv) == 1:
        print(gymnasium.spec("crashhunt/SUMO-v0").entry_point)
    else:
        vector = gymnasium.vector.AsyncVectorEnv([make] * 2, context=sys.argv[1])
        print(vector.reset(seed=[1, 1])[0].shape)
        vector.close()
"""


IMPORTS = [
    "import crashhunt, gymnasium",
    "import gymnasium, crashhunt",
    "import crashhunt; from gymnasium.envs import registration; import gymnasium",
    "import crashhunt.envs, gymnasium",
]


@pytest.mark.parametrize(
    ("imports", "context"),
    mostly_nightly(
        [(imports, context) for imports in IMPORTS for context in ("", "fork", "spawn")],
        always=[(IMPORTS[2], "fork")],
    ),
)
def test_environment_is_registered_in_either_order_of_imports(tmp_path, imports, context):
    (tmp_path / "order.py").write_text(ORDERS.format(imports=imports))
    command = [sys.executable, "order.py", *filter(None, [context])]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("(2, " if context else "crashhunt.envs:SumoEnv")
