"""Models of Stable-Baselines3 act as in its own loop; these tests run only where the library is installed."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

from crashhunt.agents import StableBaselines3

sb3 = pytest.importorskip("stable_baselines3")
contrib = pytest.importorskip("sb3_contrib")
pytest.importorskip("torch").set_num_threads(1)
vec_env = pytest.importorskip("stable_baselines3.common.vec_env")


class Walk(gymnasium.Env):
    """A random walk far from 0, whose observations are made by a function."""

    def __init__(self, observation_space, action_space, show):
        self.observation_space, self.action_space, self._show = observation_space, action_space, show

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps, self.x = 0, self.np_random.normal(size=2)
        return self._show(self), {}

    def step(self, action):
        self.steps += 1
        push = 0.1 * np.mean(np.asarray(action, float))
        self.x = self.x * 0.9 + self.np_random.normal(size=2) + push
        return self._show(self), float(-abs(self.x[0])), False, self.steps >= 25, {}

    def action_masks(self):
        mask = np.ones(3, bool)
        mask[self.steps % 3] = False
        return mask


FAR = spaces.Box(-1e5, 1e5, (2,), np.float32)
IMAGE = spaces.Box(0, 255, (36, 38, 3), np.uint8)
THREE, PUSH = spaces.Discrete(3), spaces.Box(-2.0, 5.0, (2,), np.float32)


def far(env):
    return (5000 + 100 * env.x).astype(np.float32)


def image(env):
    return np.random.default_rng(int(abs(env.x[0]) * 1e6)).integers(0, 256, IMAGE.shape).astype(np.uint8)


def box(action=THREE):
    return Walk(FAR, action, far)


def pictures():
    return Walk(IMAGE, THREE, image)


PARTS = spaces.Dict({"far": FAR, "flag": spaces.Box(0.0, 1.0, (1,), np.float32)})
GOALS = spaces.Dict(dict.fromkeys(("observation", "achieved_goal", "desired_goal"), FAR))


def parts():
    return Walk(PARTS, THREE, lambda env: {"far": far(env), "flag": np.float32([env.steps % 2])})


def goals():
    env = Walk(GOALS, PUSH, lambda env: dict.fromkeys(GOALS, far(env)))
    env.compute_reward = lambda achieved, desired, info: -np.linalg.norm(achieved - desired, axis=-1)
    return env


def normalize(env, **given):
    return vec_env.VecNormalize(env, **given)


def stack(env):
    return vec_env.VecFrameStack(env, 4)


SHORT = {"seed": 1, "device": "cpu"}
ROLLOUT = {**SHORT, "n_steps": 32, "batch_size": 16, "n_epochs": 1}
OFF_POLICY = {**SHORT, "learning_starts": 30, "buffer_size": 100}


def model_of(name, env, policy="MlpPolicy", **given):
    kind = getattr(sb3, name, None) or getattr(contrib, name)
    model = kind(policy, env, **given)
    model.learn(64)
    return model


def algorithm_of(model):
    name = type(model).__name__
    return name if hasattr(sb3, name) else f"sb3_contrib:{name}"


# name, environment, wrappers, model, options of the agent
CASES = {
    "normalised": (box, [normalize], ("PPO", ROLLOUT), {}),
    "normalised with options": (
        box,
        [lambda env: normalize(env, clip_obs=0.5, epsilon=0.1)],
        ("PPO", ROLLOUT),
        {},
    ),
    "rewards normalised": (box, [lambda env: normalize(env, norm_obs=False)], ("PPO", ROLLOUT), {}),
    "stacked": (box, [stack], ("PPO", ROLLOUT), {"frame_stack": 4}),
    "normalised and stacked": (box, [normalize, stack], ("PPO", ROLLOUT), {"frame_stack": 4}),
    "stacked and normalised": (box, [stack, normalize], ("PPO", ROLLOUT), {"frame_stack": 4}),
    "images": (pictures, [], ("PPO", {**ROLLOUT, "policy": "CnnPolicy"}), {}),
    "images stacked": (pictures, [stack], ("DQN", {**OFF_POLICY, "policy": "CnnPolicy"}), {"frame_stack": 4}),
    "images transposed and stacked": (
        pictures,
        [lambda env: vec_env.VecTransposeImage(env), stack],
        ("A2C", {**SHORT, "policy": "CnnPolicy"}),
        {"frame_stack": 4},
    ),
    "parts normalised": (
        parts,
        [lambda env: normalize(env, norm_obs_keys=["far"]), stack],
        ("PPO", {**ROLLOUT, "policy": "MultiInputPolicy"}),
        {"frame_stack": 4},
    ),
    "hindsight": (
        goals,
        [normalize],
        ("SAC", {**OFF_POLICY, "policy": "MultiInputPolicy", "replay_buffer_class": sb3.HerReplayBuffer}),
        {},
    ),
    "recurrent": (box, [normalize], ("RecurrentPPO", {**ROLLOUT, "policy": "MlpLstmPolicy"}), {}),
    "masked": (box, [normalize], ("MaskablePPO", ROLLOUT), {}),
    **{name: (lambda: box(PUSH), [], (name, OFF_POLICY), {}) for name in ("SAC", "TD3", "DDPG", "TQC", "CrossQ")},
    "DQN": (box, [], ("DQN", OFF_POLICY), {}),
    "QRDQN": (box, [], ("QRDQN", OFF_POLICY), {}),
    "ARS": (lambda: box(PUSH), [], ("ARS", {**SHORT, "n_delta": 2}), {}),
    "TRPO": (lambda: box(PUSH), [], ("TRPO", {**SHORT, "n_steps": 32, "batch_size": 16}), {}),
    "noise": (lambda: box(PUSH), [], ("PPO", {**ROLLOUT, "use_sde": True}), {}),
    "squashed": (
        lambda: box(PUSH),
        [],
        ("PPO", {**ROLLOUT, "use_sde": True, "policy_kwargs": {"squash_output": True}}),
        {},
    ),
}


@pytest.mark.parametrize("deterministic", [True, False], ids=["deterministic", "drawn"])
@pytest.mark.parametrize("case", CASES)
def test_model_acts_as_in_the_loop_of_its_library(case, deterministic, tmp_path):
    make, wrappers, (name, given), options = CASES[case]
    env = vec_env.DummyVecEnv([make])
    statistics = None
    for wrap in wrappers:
        env = wrap(env)
        if isinstance(env, vec_env.VecNormalize):
            statistics = env
    model = model_of(name, env, **given)
    model.save(tmp_path / "model.zip")
    if statistics is not None:
        statistics.save(tmp_path / "norm.pkl")
        statistics.training = statistics.norm_reward = False
        options = {**options, "normalize": str(tmp_path / "norm.pkl")}
    env.seed(7)
    shown, state, first, wanted = env.reset(), None, np.ones(1, bool), []
    kind = type(model)
    loaded = kind.load(tmp_path / "model.zip", env=None if case != "hindsight" else env, device="cpu")
    loaded.set_random_seed(3)
    if getattr(loaded, "use_sde", False):
        loaded.policy.reset_noise()
    for _ in range(25):
        masked = {"action_masks": np.stack(env.env_method("action_masks"))} if name == "MaskablePPO" else {}
        action, state = loaded.predict(shown, state=state, episode_start=first, deterministic=deterministic, **masked)
        wanted.append(np.array(action[0]))
        shown, _, first, _ = env.step(action)
    plain = make()
    plain.reset(seed=0)
    agent = StableBaselines3(
        str(tmp_path / "model.zip"),
        algorithm=algorithm_of(model),
        deterministic=deterministic,
        observation_space=plain.observation_space,
        action_space=plain.action_space,
        action_masks=plain.action_masks,
        **options,
    )
    for _ in range(2):  # an agent remembers nothing of the episode before
        observation, _ = plain.reset(seed=7)
        agent.reset(3)
        for action in wanted:
            got = np.asarray(agent.act(observation))
            assert np.array_equal(got, action) or np.allclose(got, action, rtol=1e-5, atol=1e-6)
            observation, *_ = plain.step(action)
    assert not agent.notices or case == "normalised with options"
