"""Trained policies as agents. PyTorch and Stable-Baselines3 are tested where they are installed."""

from __future__ import annotations

import sys
from contextlib import nullcontext
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from gymnasium import spaces

from crashhunt.agents import NumpyPolicy, OnnxPolicy, StableBaselines3, TorchPolicy
from crashhunt.scenario import load_scenario, shipped_folder
from crashhunt.simulators import MetaAction, SpeedAndLaneChange, action_form
from crashhunt.testing import AgentContract

WEIGHTS = shipped_folder() / "highway-policy" / "policy.npz"
BOX = spaces.Box(-1.0, 1.0, (2,), np.float32)


def scenes(count=30, seed=0):
    """Observations in the default layout: a lane in the middle, and others around."""
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(count):
        shown = np.zeros((8, 7), np.float32)
        shown[:, 0] = 1.0
        shown[0, 1:] = rng.uniform(0, 900), 4.0, rng.uniform(15, 30), 0.0, 1.0, 0.0
        shown[1:, 1] = rng.uniform(-80, 80, 7)
        shown[1:, 2] = rng.choice([-4.0, 0.0, 4.0], 7)
        shown[1:, 3] = rng.uniform(-10, 5, 7)
        shown[1:, 5] = 1.0
        found.append(shown)
    return found


class _Policy(AgentContract):
    @pytest.fixture
    def observations(self):
        return scenes()

    @pytest.fixture
    def form(self):
        return MetaAction()


class TestNumpyPolicy(_Policy):
    @pytest.fixture
    def make(self, form):
        return lambda: NumpyPolicy(str(WEIGHTS), step_length_s=1.0, action_space=form.space)


class TestNumpyPolicyByTargetSpeed(_Policy):
    @pytest.fixture
    def form(self):
        return SpeedAndLaneChange()

    @pytest.fixture
    def make(self, form):
        return lambda: NumpyPolicy(str(WEIGHTS), step_length_s=0.1, action_space=form.space)


def test_the_shipped_policy_is_small_and_has_learned_to_keep_away():
    assert WEIGHTS.stat().st_size < 250_000
    policy = NumpyPolicy(str(WEIGHTS), action_space=MetaAction().space)
    ahead, free = np.zeros((8, 7), np.float32), np.zeros((8, 7), np.float32)
    for shown in (ahead, free):
        shown[0] = 1, 300, 4, 30, 0, 1, 0
    ahead[1] = 1, 12, 0, -10, 0, 1, 0  # close, in the same lane, much slower
    names = ("LANE_LEFT", "IDLE", "LANE_RIGHT", "FASTER", "SLOWER")
    assert names[policy.act(ahead)] in ("LANE_LEFT", "LANE_RIGHT", "SLOWER")
    policy.reset(0)
    assert names[policy.act(free)] != "SLOWER"
    assert len(policy.values) == 5
    assert "values" in policy.panels()


def test_it_decides_once_a_period_and_idles_in_between():
    policy = NumpyPolicy(str(WEIGHTS), step_length_s=0.2, action_space=MetaAction().space)
    decisions = [policy.act(shown) for shown in scenes(25)]
    assert all(decision == 1 for number, decision in enumerate(decisions) if number % 5)
    assert any(decision != 1 for decision in decisions[::5])


def test_by_target_speed_it_never_leaves_the_leftmost_lane_to_the_left():
    policy = NumpyPolicy(str(WEIGHTS), action_space=SpeedAndLaneChange().space)
    for shown in scenes(60, seed=3):
        shown[0, 2] = 0.0
        speed, change = policy.act(shown)
        assert speed in (20.0, 25.0, 30.0)
        assert change != 1


@pytest.mark.parametrize(
    ("path", "says"),
    [
        ("no/such.npz", "not contain the weights"),
        ("text.npz", "not contain the weights"),
        ("other.npz", "not contain the weights"),
        ("cut.npz", "not contain the weights"),
    ],
)
def test_a_file_without_weights_is_said_to_be_one(tmp_path, path, says):
    (tmp_path / "text.npz").write_text("hello")
    np.savez(tmp_path / "other.npz", something=np.zeros(3))
    (tmp_path / "cut.npz").write_bytes(WEIGHTS.read_bytes()[:5000])
    with pytest.raises(ValueError, match=says):
        NumpyPolicy(str(tmp_path / path))


def test_the_weights_of_a_scenario_lie_next_to_it_and_are_named_by_their_path():
    for name in ("highway-policy", "motorway"):
        default = load_scenario(name).agents["ego"].arguments["path"].default
        assert Path(default).resolve() == WEIGHTS.resolve()


@pytest.fixture
def linear(tmp_path):
    """A network of one layer as an ONNX model, and its weights."""
    onnx = pytest.importorskip("onnx")
    rng = np.random.default_rng(1)
    weights = rng.normal(size=(56, 5)).astype(np.float32)

    def save(matrix, path):
        graph = onnx.helper.make_graph(
            [onnx.helper.make_node("MatMul", ["seen", "weights"], ["values"])],
            "policy",
            [onnx.helper.make_tensor_value_info("seen", onnx.TensorProto.FLOAT, [1, 56])],
            [onnx.helper.make_tensor_value_info("values", onnx.TensorProto.FLOAT, [1, matrix.shape[1]])],
            [onnx.numpy_helper.from_array(matrix, "weights")],
        )
        model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 17)], ir_version=9)
        onnx.save(model, path)
        return str(path)

    return weights, save(weights, tmp_path / "policy.onnx"), save(weights[:, :2] * 9, tmp_path / "steering.onnx")


class TestOnnxPolicy(_Policy):
    @pytest.fixture
    def make(self, linear, form):
        return lambda: OnnxPolicy(linear[1], action_space=form.space)

    def test_it_takes_the_greatest_value(self, make, linear, observations):
        agent = make()
        agent.reset(1)
        assert [agent.act(seen) for seen in observations] == [
            int((seen.ravel() @ linear[0]).argmax()) for seen in observations
        ]

    def test_actions_need_not_begin_at_0(self, linear, observations):
        plain, shifted = (OnnxPolicy(linear[1], action_space=spaces.Discrete(5, start=start)) for start in (0, -1))
        assert [plain.act(seen) - 1 for seen in observations] == [shifted.act(seen) for seen in observations]


@pytest.mark.parametrize(
    ("shown", "actions", "says"),
    [
        (
            (8, 7),
            spaces.Discrete(9),
            r"the shape \(1, 5\) for one observation, but must return \(1, 9\) for actions in Discrete\(9\)",
        ),
        ((8, 7), BOX, r"must return \(1, 2\) for"),
        ((5, 5), spaces.Discrete(5), r"does not accept observations of the shape \(1, 25\)"),
    ],
)
def test_a_model_of_another_shape_is_refused(linear, shown, actions, says):
    seen = spaces.Box(-1.0, 1.0, shown, np.float32)
    OnnxPolicy(linear[1], action_space=spaces.Discrete(5), observation_space=spaces.Box(-1.0, 1.0, (8, 7), np.float32))
    with pytest.raises(ValueError, match=says):
        OnnxPolicy(linear[1], action_space=actions, observation_space=seen)


def test_a_file_that_is_no_model_is_refused_in_one_line(tmp_path):
    pytest.importorskip("onnxruntime")
    (tmp_path / "text.onnx").write_text("hello")
    with pytest.raises(ValueError, match="cannot be loaded: InvalidProtobuf") as caught:
        OnnxPolicy(str(tmp_path / "text.onnx"))
    assert "\n" not in str(caught.value)


def test_weights_that_do_not_fit_together_are_refused(tmp_path):
    with np.load(WEIGHTS) as file:
        data = dict(file)
    last = max(name for name in data if name.startswith("bias_"))[-1]
    np.savez(tmp_path / "nine.npz", **{**data, f"weight_{last}": np.ones((9, len(data[f"bias_{int(last) - 1}"]))),
                                       f"bias_{last}": np.ones(9)})  # fmt: skip
    with pytest.raises(ValueError, match=r"values of the shape \(9,\), not \(5,\)"):
        NumpyPolicy(str(tmp_path / "nine.npz"))
    np.savez(tmp_path / "cut.npz", **{**data, "columns": data["columns"][:-1]})
    with pytest.raises(ValueError, match="does not contain the weights of a policy"):
        NumpyPolicy(str(tmp_path / "cut.npz"))


class TestOnnxPolicyThatSteers(_Policy):
    @pytest.fixture
    def form(self):
        return action_form(BOX)

    @pytest.fixture
    def make(self, linear):
        return lambda: OnnxPolicy(linear[2], action_space=BOX)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of torch.jit, whose files still are around
@pytest.mark.filterwarnings("ignore:.torch.jit:FutureWarning")  # deprecated, but users have such files
class TestTorchPolicy(_Policy):
    @pytest.fixture(params=["pt", "pt2"])
    def make(self, request, tmp_path, form):
        torch = pytest.importorskip("torch")
        torch.manual_seed(0)
        module = torch.nn.Sequential(torch.nn.Linear(56, 8), torch.nn.ReLU(), torch.nn.Linear(8, 5)).eval()
        path = tmp_path / f"policy.{request.param}"
        if request.param == "pt2":
            torch.export.save(torch.export.export(module, (torch.zeros(1, 56),)), path)
        else:
            torch.jit.trace(module, torch.zeros(1, 56)).save(str(path))
        return lambda: TorchPolicy(str(path), action_space=form.space)


class TestStableBaselines3(_Policy):
    @pytest.fixture(params=["PPO", "DQN"])
    def make(self, request, tmp_path, form):
        library = pytest.importorskip("stable_baselines3")
        gymnasium = pytest.importorskip("gymnasium")

        class Nothing(gymnasium.Env):
            observation_space = spaces.Box(-1e6, 1e6, (8, 7), np.float32)
            action_space = form.space

        model = getattr(library, request.param)("MlpPolicy", Nothing(), seed=1, device="cpu")
        model.save(tmp_path / "model.zip")
        space = Nothing.observation_space
        return lambda: StableBaselines3(str(tmp_path / "model.zip"), algorithm=request.param, observation_space=space)

    def test_a_model_of_other_observations_is_refused(self, make, request, tmp_path):
        make()
        algorithm = request.node.callspec.params["make"]
        other = spaces.Box(-1.0, 1.0, (3,), np.float32)
        with pytest.raises(ValueError, match=r"shape \(8, 7\), but those of this scenario have shape \(3,\)"):
            StableBaselines3(str(tmp_path / "model.zip"), algorithm=algorithm, observation_space=other)

    def test_a_model_of_other_actions_or_of_another_algorithm_is_refused(self, make, request, tmp_path):
        make()
        algorithm, file = request.node.callspec.params["make"], str(tmp_path / "model.zip")
        with pytest.raises(ValueError, match=r"was trained with actions in Discrete\(5\), but those of this scenario"):
            StableBaselines3(file, algorithm=algorithm, action_space=spaces.Discrete(9))
        with pytest.raises(ValueError, match="is not a model of"):
            StableBaselines3(file, algorithm={"PPO": "DQN", "DQN": "PPO"}[algorithm])


@pytest.mark.parametrize("kind", [StableBaselines3, TorchPolicy, OnnxPolicy])
def test_what_is_not_installed_or_not_there_is_said(kind, tmp_path, monkeypatch):
    library = {"StableBaselines3": "stable_baselines3", "TorchPolicy": "torch", "OnnxPolicy": "onnxruntime"}[
        kind.__name__
    ]
    if library in sys.modules or kind is OnnxPolicy:
        with pytest.raises(ValueError, match="there is no file"):
            kind(str(tmp_path / "no.zip"))
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(ValueError, match=r"pip install (-e )?\S*\[(sb3|torch|onnx)\]"):
        kind(str(tmp_path / "no.zip"))
    monkeypatch.setitem(sys.modules, "sb3_contrib", None)
    with pytest.raises(ValueError, match="pip install sb3-contrib"):
        StableBaselines3(str(tmp_path / "no.zip"), algorithm="sb3_contrib:TQC")


def test_an_algorithm_that_no_one_knows_is_refused():
    with pytest.raises(ValueError, match="'POP' is unknown"):
        StableBaselines3("x.zip", algorithm="POP")


def test_it_remembers_nothing_of_the_episode_before():
    policy = NumpyPolicy(str(WEIGHTS), step_length_s=0.2, action_space=MetaAction().space)
    shown = scenes(1)[0]
    policy.act(shown)
    policy.reset(0)
    assert not policy.values.any()
    policy.act(shown)
    assert policy.values.any()


def test_a_network_sees_its_columns_scaled_and_not_how_far_the_vehicle_has_driven():
    shown = scenes(1)[0][:3]
    shown[1:3, 1] = -170.0, 170.0
    seen = NumpyPolicy.features(shown, 4, np.array([1, 3]), np.array([100.0, 20.0], np.float32)).reshape(4, 2)
    assert seen[0, 0] == 0.0
    assert seen[0, 1] == pytest.approx(min(1.0, shown[0, 3] / 20))
    assert seen[1:3] == pytest.approx(np.stack(([-1.0, 1.0], shown[1:3, 3] / 20), axis=1))
    assert not seen[3].any()  # there is no such row


@pytest.fixture
def five(tmp_path):
    """A network whose five values are the speeds of the first five vehicles."""
    path = tmp_path / "five.npz"
    np.savez(path, weight_0=np.eye(5, dtype=np.float32), bias_0=np.zeros(5, np.float32), rows=5, columns=[3],
             scale=[10.0], target_speeds=[20.0, 25.0, 30.0], period_s=1.0)  # fmt: skip
    return str(path)


LEFT, IDLE, RIGHT, FASTER, SLOWER = range(5)


def test_by_target_speed_faster_and_slower_are_the_next_of_its_speeds_and_idle_keeps_it(five):
    policy = NumpyPolicy(five, action_space=SpeedAndLaneChange().space)
    policy.evaluate = lambda features: np.eye(5, dtype=np.float32)[policy.next]

    def act(decision, speed, y=4.0):
        policy.next = decision
        shown = np.zeros((8, 7), np.float32)
        shown[0, 2:4] = y, speed
        return policy.act(shown)

    assert act(IDLE, 24.0) == (25.0, 0)  # the nearest to begin with
    assert act(IDLE, 29.0) == (25.0, 0)
    assert act(FASTER, 21.0) == (25.0, 0)
    assert act(FASTER, 24.0) == (30.0, 0)
    assert act(FASTER, 33.0) == (30.0, 0)
    assert act(SLOWER, 29.0) == (25.0, 0)
    assert act(SLOWER, 21.0) == (20.0, 0)
    assert act(LEFT, 21.0) == (20.0, 1)
    assert act(LEFT, 21.0, y=0.5) == (20.0, 0)
    assert act(RIGHT, 21.0, y=0.5) == (20.0, -1)
    policy.reset(0)
    assert act(IDLE, 29.0) == (30.0, 0)


def test_layers_but_the_last_are_rectified(tmp_path, five):
    with np.load(five) as file:
        data = dict(file)
    flipped = np.diag([-1.0] * 5).astype(np.float32)
    np.savez(tmp_path / "two.npz", **{**data, "weight_1": flipped, "bias_1": np.arange(5.0, dtype=np.float32)})
    policy = NumpyPolicy(str(tmp_path / "two.npz"))
    assert policy.evaluate(np.array([-1, 1, -2, 2, 0], np.float32)).tolist() == [0, 0, 2, 1, 4]


def test_steering_is_clipped_to_its_space_and_has_its_shape(linear):
    space = spaces.Box(np.array([[-0.5], [-0.2]], np.float32), np.array([[0.5], [0.1]], np.float32))
    policy = OnnxPolicy(linear[2], action_space=space)
    for seen in scenes(5):
        wanted = (seen.ravel() @ (linear[0][:, :2] * 9)).reshape(2, 1)
        assert policy.act(seen) == pytest.approx(np.clip(wanted, space.low, space.high))
        assert space.contains(policy.act(seen))


class _Model:
    """What Stable-Baselines3 would have loaded."""

    observation_space = spaces.Box(-1.0, 1.0, (8, 7), np.float32)
    action_space = spaces.Discrete(5)

    def __init__(self):
        self.calls = []

    @classmethod
    def load(cls, path, device, custom_objects):
        return cls()

    def set_random_seed(self, seed):
        self.calls.append(seed)

    def predict(self, observation, state, episode_start, deterministic):
        self.calls.append((state, bool(episode_start[0]), deterministic))
        return 3, (state or 0) + 1


def test_a_recurrent_model_receives_its_state_and_where_an_episode_begins(tmp_path, monkeypatch):
    library = ModuleType("stable_baselines3")
    library.PPO = library.DQN = _Model
    library.Recurrent, library.Broken = _Model, SimpleNamespace(load=lambda path, **_: {}[path])
    monkeypatch.setitem(sys.modules, "stable_baselines3", library)
    (tmp_path / "model.zip").touch()
    path = str(tmp_path / "model.zip")
    agent = StableBaselines3(path, deterministic=False, action_space=spaces.Discrete(5))
    for seed in (7, 8):
        agent.reset(seed)
        assert [agent.act(None), agent.act(None)] == [3, 3]
    episode = [(None, True, False), (1, False, False)]
    assert agent._model.calls == [7, *episode, 8, *episode]
    StableBaselines3(path, algorithm="stable_baselines3:Recurrent", observation_space=_Model.observation_space)
    with pytest.raises(ValueError, match="has no class"):
        StableBaselines3(path, algorithm="stable_baselines3:Other")
    with pytest.raises(ValueError, match=r"is not a model of Broken.*KeyError"):
        StableBaselines3(path, algorithm="stable_baselines3:Broken")
    for wrong in ({"observation_space": BOX}, {"action_space": spaces.Discrete(4)}, {"action_space": BOX}):
        with pytest.raises(ValueError, match="was trained"):
            StableBaselines3(path, **wrong)


def test_a_module_that_remembers_is_loaded_again_after_it_was_tried(tmp_path, monkeypatch):
    """Whether it fits is tried with a blank observation, which a module with buffers would remember."""
    loads, seeds = [], []

    class Module:
        def __init__(self, path):
            loads.append(path)
            self.calls = 0

        def module(self):
            return self

        def buffers(self):
            return iter([self.calls] if loads[-1].stem == "remembers" else [])

        def __call__(self, batch):
            self.calls += 1
            values = np.eye(1, 5, min(self.calls, 4), dtype=np.float32)  # another action at each call
            return SimpleNamespace(numpy=lambda: values)

    library = SimpleNamespace(
        export=SimpleNamespace(load=Module), from_numpy=np.asarray, inference_mode=nullcontext, manual_seed=seeds.append
    )
    monkeypatch.setitem(sys.modules, "torch", library)
    shown = spaces.Box(-1.0, 1.0, (8, 7), np.float32)
    for name, number, first in (("remembers.pt2", 2, 1), ("plain.pt2", 1, 2)):
        (tmp_path / name).touch()
        loads.clear()
        agent = TorchPolicy(str(tmp_path / name), action_space=spaces.Discrete(5), observation_space=shown)
        agent.reset(9)
        assert agent.act(scenes(1)[0]) == first
        assert len(loads) == number
    assert seeds == [9, 9]
