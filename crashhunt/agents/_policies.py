"""Policies of other libraries: Stable-Baselines3, PyTorch and ONNX. Each library is imported at its first use."""

from __future__ import annotations

import importlib
import inspect
import math
from abc import ABC, abstractmethod
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal
from zipfile import BadZipFile

import numpy as np

from crashhunt.agents._car_following import VX, Y, check_layout
from crashhunt.agents._protocol import SPEED_OR_META, meta_actions
from crashhunt.agents._trained_inputs import NOT_NORMALIZED, TrainedInputs, is_equal, read_statistics
from crashhunt.base.extras import install_command
from crashhunt.trial import Argument

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import ModuleType

    from gymnasium import Space
    from numpy.typing import NDArray

    ActionMasks = Callable[[], NDArray[np.bool_] | None]

_ALGORITHMS = ("PPO", "DQN", "A2C", "SAC", "TD3", "DDPG")
_USUAL_CLIP = 10.0  # of VecNormalize
_MASK = "action_mask"  # Gymnasium's and PettingZoo's key
# To drive, a model needs no experience, which may be large, and some buffers cannot be made without an environment.
_WITHOUT_REPLAY_BUFFER: Final[dict[str, object]] = {
    "replay_buffer_class": None,
    "replay_buffer_kwargs": {},
    "buffer_size": 1,
    "optimize_memory_usage": False,
}


class StableBaselines3:
    """Drives by a model that Stable-Baselines3 or sb3-contrib has saved.

    Files of Stable-Baselines3 contain pickles, so load only your own files. The model receives what it received in its
    training: hidden states and action masks, and observations that are normalised and stacked as the arguments say. A
    model whose observations or actions cannot be those of its training is refused.

    Args:
        path: path of the ``.zip`` file that ``model.save`` wrote.
        algorithm: name of the model's class, or ``module:Class`` such as ``sb3_contrib:TQC``.
        deterministic: whether to take the most probable action; otherwise an action is drawn.
        normalize: path of the file that ``VecNormalize.save`` wrote; ``none`` if observations were not normalised.
        frame_stack: number of observations that ``VecFrameStack`` stacked.
        ignore_bounds: whether to drive in spaces with other bounds than those of the training.
        observation_space: observation space of the vehicle.
        action_space: action space of the vehicle.
        action_masks: function that returns which actions are possible now; None if the simulator has no masks.

    Raises:
        ValueError: the file or the algorithm does not exist, or the file is not a model of this algorithm. The model
            was trained with other observations or actions, or with statistics or masks that are missing.
    """

    libraries = ("stable_baselines3", "sb3_contrib")  # imported before any trial's time runs

    def __init__(
        self,
        path: Annotated[str, Argument("path", help="of the saved model, a .zip file")],
        algorithm: Annotated[str, Argument("algorithm", help=f"its class: {', '.join(_ALGORITHMS)}")] = "PPO",
        deterministic: Annotated[bool, Argument("deterministic", help="the most probable action")] = True,
        normalize: Annotated[str | None, Argument("normalize", help="file of VecNormalize.save, or none")] = None,
        frame_stack: Annotated[int | None, Argument("frame_stack", help="how many VecFrameStack stacked")] = None,
        ignore_bounds: Annotated[bool | None, Argument("ignore_bounds", help="accept other bounds")] = None,
        observation_space: Space[object] | None = None,
        action_space: Space[object] | None = None,
        action_masks: ActionMasks | None = None,
    ) -> None:
        module, _, name = algorithm.rpartition(":")
        if not module and name not in _ALGORITHMS:
            raise ValueError(f"algorithm {algorithm!r} is unknown (allowed: {', '.join(_ALGORITHMS)}, module:Class)")
        kind = getattr(
            _library(module or "stable_baselines3", "sb3-contrib" if module == "sb3_contrib" else "sb3"),
            name,
            None,
        )
        if kind is None:
            raise ValueError(f"algorithm {algorithm!r}: {module} has no class {name!r}")
        file = _existing(path)
        if frame_stack is not None and frame_stack < 1:
            raise ValueError(f"frame_stack is {frame_stack}; it must be at least 1")
        statistics = read_statistics(normalize)
        try:
            self._model = kind.load(file, device="cpu", custom_objects=_WITHOUT_REPLAY_BUFFER)
        except Exception as error:
            why = f"{type(error).__name__}: {_first_line(error)}"
            raise ValueError(
                f"{path!r} is not a model of {name}, or was saved with another version of its libraries ({why})"
            ) from error
        self._deterministic = deterministic
        self.notices: list[str] = [] if statistics is None else statistics.notices
        if not normalize and (evidence := _evidence_of_normalization(self._model)):
            fix = (
                f"give normalize=FILE, where FILE is what VecNormalize.save wrote, or normalize={NOT_NORMALIZED} if "
                "observations were not normalised (norm_obs=False)"
            )
            if evidence == "certain":
                raise ValueError(f"{path!r} was trained under VecNormalize. Fix: {fix}")
            self.notices.append(f"the model was probably trained under VecNormalize: {fix}")
        trained = self._model.observation_space
        self._inputs = TrainedInputs(
            path,
            trained,
            trained if observation_space is None else observation_space,
            statistics=statistics,
            frames=frame_stack or 1,
            ignores_bounds=bool(ignore_bounds),
        )
        decides = self._model.action_space
        if action_space is not None and not _is_same_choice(decides, action_space, ignores_bounds=bool(ignore_bounds)):
            raise ValueError(
                f"{path!r} was trained with actions in {decides}, but those of this scenario are in {action_space}. "
                "Fix: name an environment with all action wrappers of the training"
            )
        self._masks = None
        if "action_masks" in inspect.signature(self._model.predict).parameters:
            self._masks = _masks_for(path, observation_space, action_masks)

    def reset(self, seed: int) -> None:
        """Forget the hidden state and earlier observations, and seed the model."""
        self._model.set_random_seed(seed)
        if getattr(self._model, "use_sde", False):
            self._model.policy.reset_noise()  # the model has drawn noise before it was seeded
        self._state: object = None
        self._first = True
        self._inputs.reset()

    def act(self, observation: object) -> object:
        """Return the action that the model predicts."""
        masked = {} if self._masks is None else {"action_masks": self._masks(observation)}
        observation = self._inputs.convert(observation)
        action, self._state = self._model.predict(
            observation,
            state=self._state,
            episode_start=np.array([self._first]),
            deterministic=self._deterministic,
            **masked,
        )
        self._first = False
        return action


def _evidence_of_normalization(model: Any) -> Literal["certain", "likely", ""]:
    """Return whether a model was trained under `VecNormalize`, which the model itself does not say.

    A model keeps its last observation, and the original of an observation that was normalised. An off-policy model also
    keeps the observation before the last one as an original, if nothing was normalised.
    """
    original = getattr(model, "_last_original_obs", None)
    last: Any = getattr(model, "_last_obs", None)
    if original is None:
        return ""
    if not hasattr(model, "replay_buffer_class"):
        return "certain"
    parts = [(original, last)] if not isinstance(original, dict) else [(original[key], last[key]) for key in original]
    seen = [(np.abs(one), np.abs(other)) for one, other in parts if np.asarray(one).dtype.kind == "f"]
    is_scaled = any(one.max() > _USUAL_CLIP >= other.max() for one, other in seen)
    return "likely" if is_scaled and all(other.max() <= _USUAL_CLIP for _, other in seen) else ""


def _masks_for(path: str, shown: Space[object] | None, masks: ActionMasks | None) -> Callable[[Any], object]:
    """Return the function that returns the action mask for an observation.

    Raises:
        ValueError: neither the environment nor its observations contain a mask.
    """
    if masks is not None and masks() is not None:
        return lambda _: masks()
    from gymnasium.spaces import Dict

    if isinstance(shown, Dict) and _MASK in shown.spaces:
        return lambda observation: np.asarray(observation[_MASK], bool)
    raise ValueError(
        f"{path!r} was trained with action masks, but this scenario has none (allowed: the environment's method "
        f"action_masks(), info[{_MASK!r}] of reset and step, or {_MASK!r} in a dictionary of observations). "
        "Fix: name an environment that gives its masks, such as one in ActionMasker of sb3_contrib"
    )


class _Network(ABC):
    """A neural network that is called with a batch of one observation."""

    def __init__(
        self,
        path: Annotated[str, Argument("path", help="of the weights, with their layers")],
        flatten: Annotated[bool, Argument("flatten", help="observations as one row of numbers")] = True,
        normalize: Annotated[str | None, Argument("normalize", help="file of VecNormalize.save, or none")] = None,
        mask: Annotated[bool | None, Argument("mask", help="take only possible actions")] = None,
        action_space: Space[object] | None = None,
        observation_space: Space[object] | None = None,
        action_masks: ActionMasks | None = None,
    ) -> None:
        self._statistics = read_statistics(normalize)
        self.notices = [] if self._statistics is None else self._statistics.notices
        self._masks = None
        if mask:
            self._masks = _masks_for(path, observation_space, action_masks)
        try:
            self._load(path)
        except ValueError:
            raise
        except Exception as error:
            raise ValueError(f"{path!r} cannot be loaded: {type(error).__name__}: {_first_line(error)}") from error
        self._flatten = flatten
        self._space = action_space
        if observation_space is not None and observation_space.shape is not None:
            self._try(path, observation_space)

    def _try(self, path: str, shown: Space[object]) -> None:
        """Call the policy once, to check that it accepts the observations and returns valid actions."""
        blank = self._normalized(np.zeros(shown.shape or (), np.float32))
        self.notices.clear()  # of the blank observation
        batch = blank.reshape(1, -1) if self._flatten else blank[None]
        try:
            values = np.asarray(self._answer(batch))
        except Exception as error:
            why = f"{type(error).__name__}: {_first_line(error)}"
            raise ValueError(f"{path!r} does not accept observations of the shape {batch.shape} ({why})") from error
        wanted = _count(self._space)
        if values.shape[:1] != (1,) or (wanted and values[0].size != wanted):
            raise ValueError(
                f"{path!r} returns values of the shape {values.shape} for one observation, but must return (1, "
                f"{wanted}) for actions in {self._space}"
            )
        self._forget(path)

    def _normalized(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        return observation if self._statistics is None else self._statistics.apply("", observation)

    def _forget(self, path: str) -> None:  # noqa: B027 - most remember nothing
        """Reset the state to that before the first decision."""

    @abstractmethod
    def _load(self, path: str) -> None:
        """Load the library and the weights of the network."""

    @abstractmethod
    def _answer(self, batch: NDArray[np.float32]) -> NDArray[np.generic]:
        """Return, for each observation of a batch, a value for each discrete action, or the continuous action."""

    def act(self, observation: object) -> object:
        """Return the action for the network's output."""
        seen = self._normalized(np.array(observation, np.float32))
        values = self._answer(seen.reshape(1, -1) if self._flatten else seen[None])[0]
        from gymnasium.spaces import Box, Discrete

        space = self._space
        if self._masks is not None:
            values = np.where(np.asarray(self._masks(observation)).reshape(values.shape), values, -np.inf)
        if isinstance(space, Box):
            return np.clip(values.reshape(space.shape), space.low, space.high).astype(space.dtype)
        return int(np.argmax(values) + (space.start if isinstance(space, Discrete) else 0))


class TorchPolicy(_Network):
    """Drives by a PyTorch module, saved by ``torch.export.save`` (``.pt2``) or ``torch.jit.save``.

    The module is called with a batch of one observation, float32. For discrete actions, it returns a value for each
    action, and the action with the greatest value is taken. For continuous actions, it returns the action, which is
    clipped to the action space.

    Args:
        path: path of the saved module.
        flatten: whether the network expects an observation as one row of numbers.
        normalize: path of the file that ``VecNormalize.save`` wrote, if it normalised the network's observations.
        mask: whether to take the greatest value among the possible actions only.
        action_space: action space of the vehicle.
        observation_space: observation space of the vehicle.
        action_masks: function that returns which actions are possible now; None if the simulator has no masks.

    Raises:
        ValueError: the file does not exist, or the network has another shape of input or output.
    """

    libraries = ("torch",)  # imported before any trial's time runs

    def _load(self, path: str) -> None:
        self._torch = _library("torch", "torch")
        file = _existing(path)
        if file.suffix == ".pt2":
            self._module = self._torch.export.load(file).module()
        else:
            self._module = self._torch.jit.load(str(file), map_location="cpu").eval()

    def _forget(self, path: str) -> None:
        if any(True for _ in self._module.buffers()):  # in which a module may remember
            self._load(path)

    def reset(self, seed: int) -> None:
        """Seed the random generator of PyTorch."""
        self._torch.manual_seed(seed)

    def _answer(self, batch: NDArray[np.float32]) -> NDArray[np.generic]:
        with self._torch.inference_mode():
            answer: NDArray[np.generic] = self._module(self._torch.from_numpy(batch)).numpy()
        return answer


class OnnxPolicy(_Network):
    """Drives by an ONNX model with one input and one output, with the same meaning as for `TorchPolicy`.

    Args:
        path: path of the ONNX model.
        flatten: whether the network expects an observation as one row of numbers.
        normalize: path of the file that ``VecNormalize.save`` wrote, if it normalised the network's observations.
        mask: whether to take the greatest value among the possible actions only.
        action_space: action space of the vehicle.
        observation_space: observation space of the vehicle.
        action_masks: function that returns which actions are possible now; None if the simulator has no masks.

    Raises:
        ValueError: the file does not exist, or the network has another shape of input or output.
    """

    libraries = ("onnxruntime",)  # imported before any trial's time runs

    def _load(self, path: str) -> None:
        runtime = _library("onnxruntime", "onnx")
        options = runtime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        self._session = runtime.InferenceSession(_existing(path), options, providers=["CPUExecutionProvider"])
        self._input = self._session.get_inputs()[0].name

    def reset(self, seed: int) -> None:
        """Do nothing, because the agent has no state."""

    def _answer(self, batch: NDArray[np.float32]) -> NDArray[np.generic]:
        answer: NDArray[np.generic] = self._session.run(None, {self._input: batch})[0]
        return answer


def _library(name: str, package: str) -> ModuleType:
    """Import a library of an extra of crashhunt, or of a package, whose name has a hyphen."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        command = f"pip install {package}" if "-" in package else install_command(package)
        raise ValueError(f"the agent needs the package {name}: {command} ({error})") from error


def _existing(path: str) -> Path:
    if not Path(path).is_file():
        raise ValueError(f"there is no file {path!r}")
    return Path(path)


def _first_line(error: BaseException) -> str:
    """Return the message of a library in one line of at most 200 characters."""
    text = " ".join(str(error).split())
    return text if len(text) <= 200 else f"{text[:199]}…"


def _is_same_choice(trained: Space[Any], given: Space[Any], *, ignores_bounds: bool) -> bool:
    """Return whether a model that was trained on one action space can act in another."""
    from gymnasium.spaces import Box

    if not isinstance(trained, Box) or not isinstance(given, Box):
        return is_equal(trained, given)
    if trained.shape != given.shape:
        return False
    bounds = ((trained.low, given.low), (trained.high, given.high))
    return ignores_bounds or all(np.allclose(one, other, rtol=1e-5, atol=0.0) for one, other in bounds)


def _count(space: Space[object] | None) -> int:
    """Return the size of the network's output: one number for each discrete action, or the continuous action."""
    from gymnasium.spaces import Discrete

    return int(space.n) if isinstance(space, Discrete) else math.prod(space.shape or () if space is not None else ())


# A small trained policy: a multi-layer perceptron in plain NumPy.

_META_ACTIONS = ("LANE_LEFT", "IDLE", "LANE_RIGHT", "FASTER", "SLOWER")


class NumpyPolicy:
    """Drives by a network that was trained elsewhere, such as the network of the shipped scenario highway-policy.

    The weights are an ``.npz`` file with these arrays:

    - ``weight_0``, ``bias_0``, ``weight_1``, …: the layers, with rectified linear units between them. The last layer
      returns a value for each of highway-env's five meta-actions.
    - ``columns`` and ``scale``: the columns of the observation that the network sees, and their factors.
    - ``rows``: the number of rows that the network receives.
    - ``period_s``: the time between two decisions, in s.
    - ``target_speeds``: the target speeds of FASTER and SLOWER, in m/s.

    The distance that the vehicle itself has driven is replaced by 0 in the network's input.

    If actions are (target speed, lane change), FASTER and SLOWER select the next of the target speeds.

    Args:
        path: path of the file with the weights.
        step_length_s: step length of the simulation, in s.
        observation_space: observation space of the vehicle.
        action_space: action space of the vehicle.

    Raises:
        UsageError: the observation does not have the default columns.
        ValueError: the file does not contain such weights.
    """

    actions = SPEED_OR_META

    def __init__(
        self,
        path: Annotated[str, Argument("path", help="of the weights, an .npz file")],
        step_length_s: float = 1.0,
        observation_space: Space[object] | None = None,
        action_space: Space[object] | None = None,
    ) -> None:
        check_layout(observation_space)
        self._meta = meta_actions(action_space)
        try:
            # Opened here: NumPy would leave a broken file open.
            with Path(path).open("rb") as stream, np.load(stream, allow_pickle=False) as file:
                data = {name: file[name] for name in file.files}
            count = max(1, sum(name.startswith("weight_") for name in data))
            self._layers = [(data[f"weight_{n}"], data[f"bias_{n}"]) for n in range(count)]
            self._rows, self._columns, self._scale = int(data["rows"]), data["columns"], data["scale"]
            self._target_speeds = data["target_speeds"].tolist()
            self._hold = max(1, round(float(data["period_s"]) / step_length_s))
            values = self.evaluate(np.zeros(self._rows * len(self._columns), np.float32))
            if values.shape != (len(_META_ACTIONS),):
                raise ValueError(f"the weights compute values of the shape {values.shape}, not ({len(_META_ACTIONS)},)")
        except (OSError, ValueError, KeyError, TypeError, EOFError, BadZipFile) as error:
            raise ValueError(f"{path!r} does not contain the weights of a policy: {error}") from error
        self.reset(0)

    def reset(self, seed: int) -> None:
        """Begin an episode without a pending decision."""
        self._left = 0
        self._target = -1.0
        self.values = np.zeros(len(_META_ACTIONS), np.float32)

    def act(self, observation: NDArray[np.float32]) -> object:
        """Return the meta-action of the greatest value, or (target speed, lane change)."""
        decision = "IDLE"
        if self._left == 0:
            self._left = self._hold
            self.values = self.evaluate(self.features(observation, self._rows, self._columns, self._scale))
            decision = _META_ACTIONS[int(self.values.argmax())]
        self._left -= 1
        if self._meta is not None:
            return self._meta[decision]
        return self._continuous(decision, observation)

    @staticmethod
    def features(
        observation: NDArray[np.float32], rows: int, columns: NDArray[np.int64], scale: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Return the input of the network, float32, shape (rows * columns,), from -1 to 1."""
        seen = np.zeros((rows, len(columns)), np.float32)
        part = observation[:rows][:, columns]
        seen[: len(part)] = np.clip(part / scale, -1.0, 1.0)
        seen[0, columns == 1] = 0.0
        return seen.reshape(-1)

    def evaluate(self, features: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the network's value of each meta-action."""
        found = features
        for number, (weight, bias) in enumerate(self._layers):
            found = weight @ found + bias
            if number < len(self._layers) - 1:
                found = np.maximum(found, 0.0)
        return found

    def panels(self) -> object:
        """Return a panel with the value of each action."""
        from crashhunt import panels

        names = [name.removeprefix("LANE_") for name in _META_ACTIONS]
        return {"values": panels.Bar(dict(zip(names, self.values.tolist(), strict=True)))}

    def _continuous(self, decision: str, observation: NDArray[np.float32]) -> tuple[float, int]:
        speed = float(observation[0, VX])
        speeds = self._target_speeds
        nearest = min(range(len(speeds)), key=lambda number: abs(speeds[number] - speed))
        if self._target < 0 or decision in ("FASTER", "SLOWER"):
            shift = {"FASTER": 1, "SLOWER": -1}.get(decision, 0)
            self._target = speeds[max(0, min(len(speeds) - 1, nearest + shift))]
        change = {"LANE_LEFT": 1, "LANE_RIGHT": -1}.get(decision, 0)
        if change == 1 and observation[0, Y] < 1.0:  # there is no lane to the left
            change = 0
        return self._target, change
