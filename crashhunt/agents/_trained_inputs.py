"""The observations that a trained policy received in its training: normalised by `VecNormalize`, and stacked.

A wrapper of Stable-Baselines3 changes observations between environment and policy, and no saved model contains its
wrappers. So a policy gets its wrappers here, and a policy whose wrappers are missing is refused: it would drive, but
not as it was trained.
"""

from __future__ import annotations

import pickle
from collections import OrderedDict
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping

    from gymnasium import Space
    from numpy.typing import NDArray

NOT_NORMALIZED: Final = "none"
"""The value of ``normalize`` for a model whose observations were not normalised."""
_VEC_NORMALIZE: Final = ("stable_baselines3.common.vec_env.vec_normalize", "VecNormalize")
_NUMPY_MODULES: Final = ("numpy", "numpy.core.multiarray", "numpy._core.multiarray", "numpy._core.numeric")
_NUMPY_NAMES: Final = ("ndarray", "dtype", "scalar", "_reconstruct", "_frombuffer")


class _Inert:
    """Replaces an object of a class that statistics do not need, so that no code of the class runs."""

    def __init__(self, *args: object, **kwargs: object) -> None: ...

    def __setstate__(self, state: object) -> None:
        if isinstance(state, dict):
            vars(self).update(state)

    def append(self, *args: object) -> None: ...

    extend = __setitem__ = append


class _NumbersReader(pickle.Unpickler):
    """Reads a pickle without running code: arrays are read, and objects of all other classes are inert."""

    def find_class(self, module: str, name: str) -> Any:
        if module in _NUMPY_MODULES and name in _NUMPY_NAMES:
            return super().find_class(module, name)
        return OrderedDict if name == "OrderedDict" else type(name, (_Inert,), {"__module__": module})


class Statistics:
    """The running statistics of a `VecNormalize`, with which it normalises observations.

    Args:
        path: The path of the file, for messages.
        clip: The limit of normalised values.
        epsilon: The number that is added to each variance.
        moments: Mean and variance of each normalised part of a dictionary; the key of a plain array is ``""``.
    """

    def __init__(
        self, path: str, clip: float, epsilon: float, moments: Mapping[str, tuple[NDArray[Any], NDArray[Any]]]
    ) -> None:
        self.path = path
        self.clip = clip
        self.moments = {name: (mean, np.sqrt(variance + epsilon)) for name, (mean, variance) in moments.items()}
        self.notices: list[str] = []

    def apply(self, part: str, value: NDArray[np.generic]) -> NDArray[np.float32]:
        """Return a normalised observation, bit-identical to that of `VecNormalize.normalize_obs`."""
        mean, deviation = self.moments[part]
        normalized = (value - mean) / deviation
        if not self.notices and (np.abs(normalized) > self.clip).any():
            self.notices.append(
                f"normalize: observations are more than {self.clip:g} standard deviations from the mean of the "
                "training, and were clipped; check that the file belongs to this policy and this scenario"
            )
        clipped: NDArray[np.float32] = np.clip(normalized, -self.clip, self.clip).astype(np.float32)
        return clipped


def read_statistics(path: str | None) -> Statistics | None:
    """Return the statistics that `VecNormalize.save` has written; None if it did not normalise observations.

    Raises:
        ValueError: The file does not exist, or is not a file of `VecNormalize.save`.
    """
    if not path or path == NOT_NORMALIZED:
        return None
    if not Path(path).is_file():
        raise ValueError(f"normalize: there is no file {path!r}")
    try:
        with Path(path).open("rb") as file:
            saved = _NumbersReader(file).load()
    except Exception as error:
        raise ValueError(f"normalize: {path!r} is not a file of VecNormalize.save ({error})") from error
    kind = type(saved)
    if (kind.__module__, kind.__name__) != _VEC_NORMALIZE:
        raise ValueError(
            f"normalize: {path!r} contains {kind.__module__}.{kind.__name__} (allowed: VecNormalize of "
            "Stable-Baselines3, saved by VecNormalize.save)"
        )
    state = vars(saved)
    try:
        if not state["norm_obs"]:
            return None
        found = state["obs_rms"]
        kept = found if isinstance(found, dict) else {"": found}
        names = state.get("norm_obs_keys") or list(kept)
        moments = {name: (np.asarray(kept[name].mean), np.asarray(kept[name].var)) for name in names}
        return Statistics(path, float(state["clip_obs"]), float(state["epsilon"]), moments)
    except (KeyError, AttributeError, TypeError, ValueError) as error:
        raise ValueError(f"normalize: {path!r} lacks statistics of VecNormalize ({error!r})") from error


class TrainedInputs:
    """Converts observations of the scenario into those that a model received in its training.

    Args:
        path: The path of the model, for messages.
        trained: The observation space of the model.
        shown: The observation space of the vehicle.
        statistics: The statistics of `VecNormalize`; None if observations are not normalised.
        frames: The number of observations that `VecFrameStack` stacks; 1 without `VecFrameStack`.
        ignores_bounds: Whether the bounds of both spaces may differ.

    Raises:
        ValueError: The observations cannot be those of the training.
    """

    def __init__(
        self,
        path: str,
        trained: Space[Any],
        shown: Space[Any],
        *,
        statistics: Statistics | None = None,
        frames: int = 1,
        ignores_bounds: bool = False,
    ) -> None:
        self._path, self._frames, self._ignores_bounds = path, frames, ignores_bounds
        self._statistics = statistics
        ours, theirs = _parts_of(shown), _parts_of(trained)
        if set(ours) != set(theirs):
            raise self._refusal(trained, shown)
        self._whole = list(ours) == [""]
        if statistics is not None and (unknown := set(statistics.moments) - set(ours)):
            raise ValueError(f"normalize: {statistics.path!r} has statistics of {', '.join(map(repr, unknown))}, "
                             f"which observations of this scenario lack")  # fmt: skip
        self._parts = {name: self._part(name, theirs[name], space) for name, space in ours.items()}
        self.reset()

    def reset(self) -> None:
        """Begin an episode: the earlier observations of a stack are zeros."""
        self._stacks: dict[str, NDArray[np.generic]] = {}

    def convert(self, observation: Any) -> Any:
        """Return the observation for the model."""
        if self._whole:
            return self._parts[""].convert(observation, self._stacks)
        return {name: part.convert(observation[name], self._stacks) for name, part in self._parts.items()}

    def _part(self, name: str, trained: Space[Any], shown: Space[Any]) -> _Part:
        """Return how one array of observations is converted."""
        from gymnasium.spaces import Box

        if not isinstance(shown, Box) or not isinstance(trained, Box):
            if not is_equal(trained, shown):
                raise self._refusal(trained, shown)
            return _Part(name)
        statistics = self._statistics if self._statistics is not None and name in self._statistics.moments else None
        axis = _stack_axis(shown, trained, self._frames)
        low, high = (_stacked(bounds, axis, self._frames) for bounds in (shown.low, shown.high))
        is_image = _is_image(shown)
        if statistics is not None and is_image:
            low, high = np.full_like(low, -statistics.clip, np.float32), np.full_like(high, statistics.clip, np.float32)
        if trained.shape != low.shape and not (_is_image(trained) and trained.shape == _channels_first(low.shape)):
            raise self._refusal(trained, shown)
        if (low.dtype.kind == "f") != (np.dtype(trained.dtype).kind == "f"):
            raise self._refusal(trained, shown)
        compares = not self._ignores_bounds and trained.shape == low.shape
        if compares and not (_equal(low, trained.low) and _equal(high, trained.high)):
            raise self._refusal(trained, shown)
        stacks_last = statistics is None or statistics.moments[name][0].shape == shown.shape
        if statistics is not None and statistics.moments[name][0].shape not in (shown.shape, low.shape):
            shape = statistics.moments[name][0].shape
            raise ValueError(
                f"normalize: {statistics.path!r} has statistics of the shape {shape}, but observations of this "
                f"scenario have shape {shown.shape}"
            )
        return _Part(name, statistics, axis, self._frames, stacks_last=stacks_last)

    def _refusal(self, trained: Space[Any], shown: Space[Any]) -> ValueError:
        """Return the error for observations other than those of the training, with the fix."""
        ours, theirs = _shape(shown), _shape(trained)
        if self._frames > 1:
            what = f"observations of shape {theirs}, which are not {self._frames} stacked observations of shape {ours}"
        elif ours == theirs:
            what = f"observations in {_words(trained)}, but those of this scenario are in {_words(shown)}"
        else:
            what = f"observations of shape {theirs}, but those of this scenario have shape {ours}"
        fix = "name an environment with all observation wrappers of the training"
        if (frames := _frames_between(shown, trained)) > 1 and self._frames == 1:
            fix = f"give frame_stack={frames} if VecFrameStack stacked the observations, or {fix}"
        elif self._frames > 1:
            fix = f"correct frame_stack={self._frames}, or {fix}"
        elif ours == theirs:
            fix += ", or give ignore_bounds=true if their values have the same meaning"
        return ValueError(f"{self._path!r} was trained on {what}. Fix: {fix}")


class _Part:
    """Converts one array of observations.

    Args:
        name: The key of the array in a dictionary; empty for a plain array.
        statistics: The statistics with which the array is normalised, or None.
        axis: The axis of the stack.
        frames: The number of stacked observations.
        stacks_last: Whether observations are normalised before they are stacked.
    """

    def __init__(
        self,
        name: str,
        statistics: Statistics | None = None,
        axis: int = -1,
        frames: int = 1,
        *,
        stacks_last: bool = True,
    ) -> None:
        self._name, self._statistics, self._axis, self._frames = name, statistics, axis, frames
        self._stacks_last = stacks_last

    def convert(self, value: Any, stacks: dict[str, NDArray[np.generic]]) -> Any:
        """Return the array for the model, and update the stack."""
        if self._statistics is not None and self._stacks_last:
            value = self._statistics.apply(self._name, value)
        if self._frames > 1:
            value = np.asarray(value)
            older = stacks.get(self._name)
            if older is None:
                older = np.zeros_like(_stacked(value, self._axis, self._frames))
            dropped = np.delete(older, np.s_[: value.shape[self._axis]], axis=self._axis)
            value = stacks[self._name] = np.concatenate((dropped, value), axis=self._axis)
        if self._statistics is not None and not self._stacks_last:
            value = self._statistics.apply(self._name, value)
        return value


def is_equal(one: Space[Any], other: Space[Any]) -> bool:
    """Return whether two spaces have the same values, maybe of different types of numbers."""
    from gymnasium.spaces import Discrete, MultiDiscrete

    for kind, what in ((Discrete, "n"), (MultiDiscrete, "nvec")):
        if isinstance(one, kind) and isinstance(other, kind):
            return all(np.array_equal(getattr(one, name), getattr(other, name)) for name in (what, "start"))
    return bool(one == other)


def _parts_of(space: Space[Any]) -> dict[str, Space[Any]]:
    from gymnasium.spaces import Dict

    return dict(space.spaces) if isinstance(space, Dict) else {"": space}


def _stacked(array: NDArray[Any], axis: int, frames: int) -> NDArray[Any]:
    return array if frames == 1 else np.repeat(array, frames, axis=axis)


def _stack_axis(shown: Space[Any], trained: Space[Any], frames: int) -> int:
    """Return the axis on which `VecFrameStack` has stacked: the last, or the first where only this gives the shape."""
    first, last = (_times(shown.shape or (), axis, frames) for axis in (0, -1))
    is_last = last in (trained.shape, ()) or _channels_first(last) == trained.shape
    return 0 if first == trained.shape and not is_last else -1


def _times(shape: tuple[int, ...], axis: int, frames: int) -> tuple[int, ...]:
    sizes = list(shape)
    if sizes:
        sizes[axis] *= frames
    return tuple(sizes)


def _frames_between(shown: Space[Any], trained: Space[Any]) -> int:
    """Return the number of stacked observations that would explain the shapes of two spaces; 1 if none would."""
    ours, theirs = _parts_of(shown), _parts_of(trained)
    found = set()
    for name in ours.keys() & theirs.keys():
        one, other = (np.prod(space.shape or (0,), dtype=int) for space in (ours[name], theirs[name]))
        frames = int(other // one) if one else 0
        shape = ours[name].shape or ()
        shapes = [_times(shape, axis, frames) for axis in (0, -1)]
        fits = theirs[name].shape in (*shapes, *map(_channels_first, shapes))
        found.add(frames if fits else 0)
    return found.pop() if len(found) == 1 and ours.keys() == theirs.keys() else 1


def _is_image(space: Space[Any]) -> bool:
    """Return whether Stable-Baselines3 regards a space as images, whose channels it puts first."""
    from gymnasium.spaces import Box

    if not isinstance(space, Box) or space.dtype != np.uint8 or len(space.shape) != 3:
        return False
    return not (space.low != 0).any() and not (space.high != 255).any()


def _channels_first(shape: tuple[int, ...]) -> tuple[int, ...]:
    return (shape[2], *shape[:2]) if len(shape) == 3 else ()


def _equal(one: NDArray[np.generic], other: NDArray[np.generic]) -> bool:
    return bool(np.allclose(one, other, rtol=1e-5, atol=0.0))  # a space of another type rounds its bounds


def _shape(space: Space[Any]) -> object:
    from gymnasium.spaces import Dict, Tuple

    if isinstance(space, Dict):
        return {name: _shape(inner) for name, inner in space.spaces.items()}
    return [_shape(inner) for inner in space.spaces] if isinstance(space, Tuple) else space.shape


def _words(space: Space[Any]) -> str:
    """Return a space in one line of at most 160 characters."""
    text = " ".join(str(space).split())
    return text if len(text) <= 160 else f"{text[:159]}…"
