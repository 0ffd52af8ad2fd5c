"""Readers of parts that follow from outlines and centre lines: predictions, ranges, grids and pictures."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from libsumo import _libsumo as sumo

from crashhunt.simulators import (
    ActorNumbers,
    Raster,
    RayCaster,
    center_of,
    covariances_of,
    nearest_actors,
    picture,
    predictions_of,
)
from crashhunt.sumo._reader_protocol import Reader

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from crashhunt.sumo._reader_protocol import Moment, ReaderSetup

_MAX_HALF_WIDTH_M = 10.0  # of a lane, and half the distance of two points of its centre line


class PredictionsReader(Reader):
    """Predicts the actors at constant velocity.

    Args:
        setup: The part.
    """

    def observe(self, moment: Moment) -> NDArray[np.float64]:
        """Return the columns of ``predictions``."""
        settings = self._setup.settings
        near = nearest_actors(
            moment.scene, moment.row, hidden=moment.hidden, radius=settings["radius"], limit=self._setup.limit
        )
        share, interval = self._setup.reference_share, settings["interval"]
        return predictions_of(moment.scene, near, shape=self._setup.shape, interval=interval, reference_share=share)


class CovarianceReader(Reader):
    """Reads the part ``prediction_covariance``."""

    def observe(self, moment: Moment) -> NDArray[np.float64]:
        """Return the columns of ``prediction_covariance``."""
        settings = self._setup.settings
        near = nearest_actors(
            moment.scene, moment.row, hidden=moment.hidden, radius=settings["radius"], limit=self._setup.limit
        )
        return covariances_of(moment.scene, near, settings, shape=self._setup.shape)


class ActorIdsReader(Reader):
    """Numbers the actors.

    Args:
        setup: The part.
    """

    def __init__(self, setup: ReaderSetup) -> None:
        super().__init__(setup)
        self._numbers = ActorNumbers()

    def observe(self, moment: Moment) -> NDArray[np.int64]:
        """Return the values of ``actor_ids``."""
        radius, limit = self._setup.settings["radius"], self._setup.limit
        near = nearest_actors(moment.scene, moment.row, hidden=moment.hidden, radius=radius, limit=limit)
        return self._numbers.of(moment.scene, near, limit)


class RangesReader(Reader):
    """Casts rays to the outlines of the actors.

    Args:
        setup: The part.
    """

    def __init__(self, setup: ReaderSetup) -> None:
        super().__init__(setup)
        self._reach_m = setup.settings["range"]
        self._caster = RayCaster(int(setup.settings["rays"]), self._reach_m)

    def observe(self, moment: Moment) -> NDArray[np.float64]:
        """Return the values of ``lidar2d``."""
        scene, row = moment.scene, moment.row
        longest = max(scene.roster.lengths)
        near = nearest_actors(scene, row, hidden=moment.hidden, radius=self._reach_m + longest)
        return self._caster.cast(scene, row, [one.row for one in near])


class _RasterReader(Reader):
    """Finds the cells around the vehicle that are on lanes or inside outlines.

    Args:
        setup: The part, the vehicle and the lanes.
    """

    def __init__(self, setup: ReaderSetup) -> None:
        super().__init__(setup)
        settings = setup.settings
        self._graph, self._vehicle_class = setup.graph, sumo.vehicle_getVehicleClass(setup.agent)
        self._raster = Raster(int(settings["rows"]), int(settings["columns"]), settings["resolution"])

    def _road(self, moment: Moment) -> NDArray[np.bool_]:
        x, y = center_of(moment.scene, moment.row)
        reach = self._raster.reach_m + _MAX_HALF_WIDTH_M
        near = [self._graph.lanes[name] for _, name in self._graph.near(x, y, reach, self._vehicle_class)]
        lanes = [(self._graph.lines(lane).center, lane.data.width_m) for lane in near]
        return self._raster.on_lanes(moment.scene, moment.row, lanes)

    def _actors(self, moment: Moment) -> NDArray[np.bool_]:
        scene, row = moment.scene, moment.row
        reach = self._raster.reach_m + max(scene.roster.lengths)
        near = nearest_actors(scene, row, hidden=moment.hidden, radius=reach)
        return self._raster.occupied(scene, row, [one.row for one in near])


class GridReader(_RasterReader):
    """Reads the part ``grid``."""

    def observe(self, moment: Moment) -> NDArray[np.uint8]:
        """Return the layers of ``grid``."""
        return np.stack((self._actors(moment), self._road(moment))).astype(np.uint8)


class ImageReader(_RasterReader):
    """Reads the part ``image``."""

    def observe(self, moment: Moment) -> NDArray[np.uint8]:
        """Return the picture of ``image``."""
        own = self._raster.occupied(moment.scene, moment.row, [moment.row])
        return picture(self._road(moment), self._actors(moment), own)
