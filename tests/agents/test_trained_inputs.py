"""Observations of trained policies: statistics of VecNormalize, and stacks. Stable-Baselines3 is not needed."""

from __future__ import annotations

import pickle
import sys
from types import MappingProxyType, ModuleType

import numpy as np
import pytest
from gymnasium import spaces

from crashhunt.agents import OnnxPolicy, StableBaselines3
from crashhunt.agents._trained_inputs import TrainedInputs, read_statistics

MODULE = "stable_baselines3.common.vec_env.vec_normalize"
FAR = spaces.Box(-1e5, 1e5, (2,), np.float32)
BOTH = spaces.Dict({"far": FAR, "flag": spaces.Discrete(2)})


@pytest.fixture
def save(tmp_path, monkeypatch):
    """A function that writes what `VecNormalize.save` writes, and removes the library again."""

    def write(moments, *, kind="VecNormalize", **given):
        module = ModuleType(MODULE)
        names = ("VecNormalize", "RunningMeanStd", "Mine")
        for name in names:
            setattr(module, name, type(name, (), {"__module__": MODULE}))
        with monkeypatch.context() as patched:
            for end in (position for position, letter in enumerate(MODULE) if letter == "."):
                patched.setitem(sys.modules, MODULE[:end], ModuleType(MODULE[:end]))
            patched.setitem(sys.modules, MODULE, module)

            def make(name, **state):
                made = getattr(module, name)()
                vars(made).update(state)
                return made

            rms = {key: make("RunningMeanStd", mean=mean, var=var, count=9.0) for key, (mean, var) in moments.items()}
            state = {"norm_obs": True, "clip_obs": 10.0, "epsilon": 1e-8, "norm_obs_keys": None, **given}
            state |= {"obs_rms": rms.get("", rms), "observation_space": spaces.Dict({"far": FAR})}
            path = tmp_path / "norm.pkl"
            path.write_bytes(pickle.dumps(make(kind, **state)))
        return str(path)

    return write


MEAN, VARIANCE = np.array([5000.0, 0.0]), np.array([400.0, 4.0])


def test_observations_are_normalized_and_clipped_as_in_training(save):
    read = read_statistics(save({"": (MEAN, VARIANCE)}, clip_obs=3.0, epsilon=0.1))
    inputs = TrainedInputs("m.zip", FAR, FAR, statistics=read)
    shown = np.array([5010.0, -1.0], np.float32)
    wanted = np.clip((shown - MEAN) / np.sqrt(VARIANCE + 0.1), -3, 3).astype(np.float32)
    assert np.array_equal(inputs.convert(shown), wanted)
    assert not read.notices
    assert inputs.convert(np.array([0.0, 0.0], np.float32))[0] == -3.0
    inputs.convert(np.array([0.0, 0.0], np.float32))
    (notice,) = read.notices
    assert "more than 3 standard deviations" in notice


def test_only_the_named_parts_of_a_dictionary_are_normalized(save):
    read = read_statistics(save({"far": (MEAN, VARIANCE)}, norm_obs_keys=["far"]))
    inputs = TrainedInputs("m.zip", BOTH, BOTH, statistics=read)
    found = inputs.convert({"far": np.array([5000.0, 0.0], np.float32), "flag": np.int64(1)})
    assert found["flag"] == 1
    assert found["far"].tolist() == [0.0, 0.0]


def test_statistics_of_rewards_only_change_nothing(save):
    assert read_statistics(save({"": (MEAN, VARIANCE)}, norm_obs=False)) is None
    assert read_statistics("none") is None
    assert read_statistics(None) is None


def test_file_that_would_run_code_is_read_without_running_it(tmp_path):
    class Attack:
        def __reduce__(self):
            return (exec, ("raise SystemExit",))

    (tmp_path / "norm.pkl").write_bytes(pickle.dumps(Attack()))
    with pytest.raises(ValueError, match=r"contains builtins.exec \(allowed: VecNormalize"):
        read_statistics(str(tmp_path / "norm.pkl"))


def test_other_files_are_refused_in_one_line(tmp_path, save):
    (tmp_path / "text.pkl").write_text("hello")
    with pytest.raises(ValueError, match=r"is not a file of VecNormalize.save"):
        read_statistics(str(tmp_path / "text.pkl"))
    with pytest.raises(ValueError, match=r"there is no file 'no.pkl'"):
        read_statistics("no.pkl")
    with pytest.raises(ValueError, match=r"contains stable_baselines3.*Mine"):
        read_statistics(save({"": (MEAN, VARIANCE)}, kind="Mine"))
    with pytest.raises(ValueError, match="lacks statistics"):
        read_statistics(save({"": (MEAN, VARIANCE)}, norm_obs_keys=["other"]))
    with pytest.raises(ValueError, match=r"statistics of the shape \(3,\), but .* have shape \(2,\)"):
        TrainedInputs("m.zip", FAR, FAR, statistics=read_statistics(save({"": (np.zeros(3), np.ones(3))})))
    with pytest.raises(ValueError, match="statistics of 'seen', which observations of this scenario lack"):
        TrainedInputs("m.zip", FAR, FAR, statistics=read_statistics(save({"seen": (MEAN, VARIANCE)})))


def test_stack_begins_with_zeros_and_ends_with_the_newest():
    stacked = spaces.Box(-1e5, 1e5, (6,), np.float32)
    inputs = TrainedInputs("m.zip", stacked, FAR, frames=3)
    for _ in range(2):
        found = [inputs.convert(np.array([step, -step], np.float32)).tolist() for step in (1, 2, 3, 4)]
        assert found == [[0, 0, 0, 0, 1, -1], [0, 0, 1, -1, 2, -2], [1, -1, 2, -2, 3, -3], [2, -2, 3, -3, 4, -4]]
        inputs.reset()


def test_order_of_statistics_and_stack_follows_from_their_shapes(save):
    stacked = spaces.Box(-1e5, 1e5, (4,), np.float32)
    before = read_statistics(save({"": (MEAN, VARIANCE)}))
    after = read_statistics(save({"": (np.tile(MEAN, 2), np.tile(VARIANCE, 2))}, clip_obs=1000.0))
    shown = np.array([5000.0, 0.0], np.float32)
    first = TrainedInputs("m.zip", stacked, FAR, statistics=before, frames=2).convert(shown)
    assert first.tolist() == [0.0, 0.0, 0.0, 0.0]
    second = TrainedInputs("m.zip", stacked, FAR, statistics=after, frames=2).convert(shown)
    assert second.tolist() == [-250.0, 0.0, 0.0, 0.0]


IMAGE, FIRST = spaces.Box(0, 255, (4, 5, 3), np.uint8), spaces.Box(0, 255, (3, 4, 5), np.uint8)


def test_images_may_have_their_channels_first_in_the_model():
    TrainedInputs("m.zip", FIRST, IMAGE)
    stacked = TrainedInputs("m.zip", spaces.Box(0, 255, (6, 4, 5), np.uint8), IMAGE, frames=2)
    assert stacked.convert(np.ones(IMAGE.shape, np.uint8)).shape == (4, 5, 6)
    first = TrainedInputs("m.zip", spaces.Box(0, 255, (6, 4, 5), np.uint8), FIRST, frames=2)
    assert first.convert(np.ones(FIRST.shape, np.uint8)).shape == (6, 4, 5)


@pytest.mark.parametrize(
    ("trained", "shown", "given", "says"),
    [
        (spaces.Box(-1e5, 1e5, (8,), np.float32), FAR, {}, "give frame_stack=4 if VecFrameStack"),
        (spaces.Box(-1e5, 1e5, (3,), np.float32), FAR, {}, r"shape \(3,\), but .* \(2,\). Fix: name an environment"),
        (FAR, FAR, {"frames": 4}, r"not 4 stacked observations of shape \(2,\). Fix: correct frame_stack=4"),
        (spaces.Box(-1.0, 1.0, (2,), np.float32), FAR, {}, "observations in Box.*ignore_bounds=true"),
        (spaces.Box(0.0, 255.0, IMAGE.shape, np.float32), IMAGE, {}, "observations in Box.*float32.*uint8"),
        (spaces.Box(0, 255, (6, 4, 5), np.uint8), IMAGE, {}, "give frame_stack=2"),
        (spaces.Discrete(3), spaces.Discrete(4), {}, r"in Discrete\(3\), but those of this scenario are in Discrete"),
        (spaces.Discrete(3), FAR, {}, "was trained on observations of shape"),
        (BOTH, FAR, {}, "was trained on observations of shape"),
    ],
)
def test_observations_that_are_not_those_of_the_training_are_refused_with_the_fix(trained, shown, given, says):
    with pytest.raises(ValueError, match=says):
        TrainedInputs("m.zip", trained, shown, **given)


def test_bounds_may_be_ignored():
    TrainedInputs("m.zip", spaces.Box(-1.0, 1.0, (2,), np.float32), FAR, ignores_bounds=True)
    TrainedInputs("m.zip", spaces.Discrete(3, dtype=np.int32), spaces.Discrete(3))


class Model:
    """What Stable-Baselines3 would have loaded."""

    observation_space, action_space = FAR, spaces.Discrete(3)
    kept = MappingProxyType({})

    @classmethod
    def load(cls, path, device, custom_objects):
        made = cls()
        vars(made).update(cls.kept)
        return made

    def set_random_seed(self, seed):
        pass

    def predict(self, observation, state, episode_start, deterministic, **given):
        self.seen = observation, given
        return 1, None


class Masked(Model):
    def predict(self, observation, state, episode_start, deterministic, action_masks=None):
        return super().predict(observation, state, episode_start, deterministic, masks=action_masks)


@pytest.fixture
def load(tmp_path, monkeypatch):
    """A function that makes the agent for a model."""
    library = ModuleType("stable_baselines3")
    monkeypatch.setitem(sys.modules, "stable_baselines3", library)
    (tmp_path / "model.zip").touch()

    def make(kind=Model, **given):
        library.PPO = kind
        agent = StableBaselines3(str(tmp_path / "model.zip"), **{"observation_space": FAR, **given})
        agent.reset(0)
        return agent

    return make


SHOWN = np.array([5020.0, 0.0], np.float32)


def test_model_receives_normalized_observations(load, save):
    agent = load(normalize=save({"": (MEAN, VARIANCE)}))
    agent.act(SHOWN)
    assert agent._model.seen[0].tolist() == pytest.approx([1.0, 0.0])


def test_model_that_was_normalized_is_refused_without_its_statistics(load, save):
    kept = {"_last_original_obs": SHOWN, "_last_obs": np.zeros(2)}
    on_policy = type("OnPolicy", (Model,), {"kept": kept})
    with pytest.raises(ValueError, match=r"was trained under VecNormalize. Fix: give normalize=FILE"):
        load(on_policy)
    load(on_policy, normalize=save({"": (MEAN, VARIANCE)}))
    load(on_policy, normalize="none")


def test_off_policy_model_that_was_probably_normalized_is_a_notice(load):
    for original, last, count in ((SHOWN, np.zeros(2), 1), (SHOWN, SHOWN + 1, 0), (np.ones(2), np.zeros(2), 0)):
        kept = {"_last_original_obs": original, "_last_obs": last, "replay_buffer_class": None}
        agent = load(type("OffPolicy", (Model,), {"kept": kept}))
        assert len(agent.notices) == count
        assert all("probably trained under VecNormalize: give normalize=FILE" in notice for notice in agent.notices)


def test_model_receives_the_masks_of_each_step(load):
    masks = [np.array([True, False, True]), np.array([False, True, True])]
    steps = iter([masks[0], *masks])
    agent = load(Masked, action_masks=lambda: next(steps))
    for mask in masks:
        agent.act(SHOWN)
        assert agent._model.seen[1]["masks"] is mask


def test_mask_may_be_part_of_the_observation(load):
    shown = spaces.Dict({"far": FAR, "action_mask": spaces.MultiBinary(3)})
    kind = type("Parts", (Masked,), {"observation_space": shown})
    agent = load(kind, observation_space=shown, action_masks=lambda: None)
    agent.act({"far": SHOWN, "action_mask": np.array([1, 0, 1], np.int8)})
    assert agent._model.seen[1]["masks"].tolist() == [True, False, True]


@pytest.mark.parametrize("masks", [None, lambda: None])
def test_model_that_needs_masks_is_refused_where_there_are_none(load, masks):
    with pytest.raises(ValueError, match=r"action masks, but this scenario has none .*action_masks\(\).*Fix: name"):
        load(Masked, action_masks=masks)


@pytest.mark.parametrize("given", [spaces.Discrete(3, start=1), spaces.Box(-1.0, 1.0, (3,), np.float32)])
def test_other_actions_are_refused(load, given):
    with pytest.raises(ValueError, match="was trained with actions in"):
        load(action_space=given)


def test_actions_of_another_scale_are_refused_unless_bounds_are_ignored(load):
    kind = type("Scaled", (Model,), {"action_space": spaces.Box(-1.0, 1.0, (2,), np.float32)})
    other = spaces.Box(-2.0, 2.0, (2,), np.float32)
    with pytest.raises(ValueError, match="Fix: name an environment with all action wrappers"):
        load(kind, action_space=other)
    load(kind, action_space=other, ignore_bounds=True)
    load(kind, action_space=spaces.Box(-1.0, 1.0, (2,), np.float64))


def test_noise_of_a_model_depends_on_the_seed_of_the_trial(load):
    order = []
    policy = type("Policy", (), {"reset_noise": lambda self: order.append("noise")})()
    kind = type("Noise", (Model,), {"kept": {"use_sde": True, "policy": policy}})
    kind.set_random_seed = lambda self, seed: order.append(seed)
    load(kind).reset(7)
    assert order == [0, "noise", 7, "noise"]


@pytest.mark.parametrize("frames", [0, -1])
def test_stack_has_at_least_one_observation(load, frames):
    with pytest.raises(ValueError, match="must be at least 1"):
        load(frame_stack=frames)


def test_network_is_normalized_and_masked_as_asked(save):
    class Network(OnnxPolicy):
        def _load(self, path):
            pass

        def _answer(self, batch):
            self.batch = batch
            return np.array([[1.0, 3.0, 2.0]])

    mask = np.array([True, False, True])
    given = {"action_space": spaces.Discrete(3), "observation_space": FAR, "action_masks": lambda: mask}
    agent = Network("n.onnx", normalize=save({"": (MEAN, VARIANCE)}), mask=True, **given)
    assert agent.act(SHOWN) == 2
    assert agent.batch.tolist() == [pytest.approx([1.0, 0.0])]
    assert not agent.notices
    assert Network("n.onnx", **given).act(SHOWN) == 1
    with pytest.raises(ValueError, match="this scenario has none"):
        Network("n.onnx", mask=True, action_space=spaces.Discrete(3), observation_space=FAR)
