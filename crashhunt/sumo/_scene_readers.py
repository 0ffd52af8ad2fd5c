"""Readers of parts that follow from the scene: predictions and ranges."""

from __future__ import annotations

from typing import TYPE_CHECKING

from crashhunt.simulators import RayCaster, nearest_actors, predictions_of

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from crashhunt.sumo._reader_protocol import Moment, ReaderSetup


class PredictionsReader:
    """Predicts the actors at constant velocity.

    Args:
        setup: The part.
    """

    def __init__(self, setup: ReaderSetup) -> None:
        self._setup = setup

    def observe(self, moment: Moment) -> NDArray[np.float64]:
        """Return the columns of ``predictions``."""
        settings = self._setup.settings
        near = nearest_actors(
            moment.scene, moment.row, hidden=moment.hidden, radius=settings["radius"], limit=self._setup.limit
        )
        return predictions_of(moment.scene, near, shape=self._setup.shape, interval=settings["interval"])


class RangesReader:
    """Casts rays to the outlines of the actors.

    Args:
        setup: The part.
    """

    def __init__(self, setup: ReaderSetup) -> None:
        self._reach_m = setup.settings["range"]
        self._caster = RayCaster(int(setup.settings["rays"]), self._reach_m)

    def observe(self, moment: Moment) -> NDArray[np.float64]:
        """Return the values of ``lidar2d``."""
        scene, row = moment.scene, moment.row
        longest = max(scene.roster.lengths)
        near = nearest_actors(scene, row, hidden=moment.hidden, radius=self._reach_m + longest)
        return self._caster.cast(scene, row, [one.row for one in near])
