"""A small trained policy: a multi-layer perceptron in plain NumPy."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated
from zipfile import BadZipFile

import numpy as np

from crashhunt.agents._car_following import VX, Y, check_layout
from crashhunt.agents._forms import meta_actions
from crashhunt.trial import Argument

if TYPE_CHECKING:
    from gymnasium import Space
    from numpy.typing import NDArray

__all__ = ["NumpyPolicy"]

_MEANINGS = ("LANE_LEFT", "IDLE", "LANE_RIGHT", "FASTER", "SLOWER")


class NumpyPolicy:
    """Drives by a network that was trained elsewhere, such as the one that ships with the scenario highway-policy.

    The weights are an ``.npz`` file: ``weight_0``, ``bias_0``, ``weight_1``, … of the layers, with rectified linear
    units between them and a value for each of highway-env's five meta-actions at the end; ``columns`` and ``scale`` of
    the observation's columns that it sees, ``rows`` of its rows, ``period_s`` from one decision to the next, and
    ``target_speeds`` in m/s. Its own distance driven, which says nothing, is 0.

    Where actions are (target speed, lane change), FASTER and SLOWER step through the target speeds.

    Args:
        path: of the weights.
        step_length_s: of the simulation, in s.
        observation_space: of the vehicle.
        action_space: of the vehicle.

    Raises:
        ValueError: the file has no such weights, or the observation has other columns than the default ones.
    """

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
            if values.shape != (len(_MEANINGS),):
                raise ValueError(f"they give values of the shape {values.shape}, not ({len(_MEANINGS)},)")
        except (OSError, ValueError, KeyError, TypeError, EOFError, BadZipFile) as error:
            raise ValueError(f"{path!r} has no weights of a policy: {error}") from error
        self.reset(0)

    def reset(self, seed: int) -> None:
        """Be ready to decide."""
        self._left = 0
        self._target = -1.0
        self.values = np.zeros(len(_MEANINGS), np.float32)

    def act(self, observation: NDArray[np.float32]) -> object:
        """Return the meta-action of the greatest value, or (target speed, lane change)."""
        decision = "IDLE"
        if self._left == 0:
            self._left = self._hold
            self.values = self.evaluate(self.features(observation, self._rows, self._columns, self._scale))
            decision = _MEANINGS[int(self.values.argmax())]
        self._left -= 1
        if self._meta is not None:
            return self._meta[decision]
        return self._continuous(decision, observation)

    @staticmethod
    def features(
        observation: NDArray[np.float32], rows: int, columns: NDArray[np.int64], scale: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Return what the network sees, float32, shape (rows * columns,), within -1 and 1."""
        seen = np.zeros((rows, len(columns)), np.float32)
        part = observation[:rows][:, columns]
        seen[: len(part)] = np.clip(part / scale, -1.0, 1.0)
        seen[0, columns == 1] = 0.0
        return seen.reshape(-1)

    def evaluate(self, features: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the value of each meta-action."""
        found = features
        for number, (weight, bias) in enumerate(self._layers):
            found = weight @ found + bias
            if number < len(self._layers) - 1:
                found = np.maximum(found, 0.0)
        return found

    def panels(self) -> object:
        """Show the values."""
        from crashhunt import panels

        names = [name.removeprefix("LANE_") for name in _MEANINGS]
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
