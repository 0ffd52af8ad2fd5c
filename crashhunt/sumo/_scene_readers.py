"""Readers of parts that follow from outlines and centre lines: predictions, ranges, grids and pictures."""

from __future__ import annotations

import math
from math import cos, sin
from typing import TYPE_CHECKING

import libsumo
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
    with_range_noise,
)
from crashhunt.sumo._lane_paths import LanePath, NearLanes, Sampling
from crashhunt.sumo._reader_protocol import AgentMoment, Reader, ReaderSetup
from crashhunt.world import is_person

if TYPE_CHECKING:
    from numpy.typing import NDArray

_MAX_SPEED_MPS, _MAX_PREDICTED_M = 60.0, 1000.0  # longer paths along lanes are straight at their end
_SPACING_M = 1.0  # of the points of these paths
_ALONG_COSINE = 0.5  # of the angle between an actor and its lane, below which it does not follow the lane
_MAX_HALF_WIDTH_M = 10.0  # of a lane, and half the distance of two points of its centre line


class PredictionsReader(Reader):
    """Predicts the actors at constant speed, straight on or along lanes."""

    def __init__(self, setup: ReaderSetup) -> None:
        super().__init__(setup)
        horizon_s = setup.settings["interval"] * setup.shape[1]
        reach_m = min(_MAX_PREDICTED_M, _MAX_SPEED_MPS * horizon_s)
        self._sampling = Sampling(_SPACING_M, math.ceil(reach_m / _SPACING_M) + 1, 0)
        self._times = setup.settings["interval"] * np.arange(1.0, setup.shape[1] + 1.0)
        self._lanes: dict[str, NearLanes] = {}

    def observe(self, moment: AgentMoment) -> NDArray[np.float64]:
        """Return the columns of ``predictions``."""
        settings, near = self._setup.settings, self._actors_near(moment)
        share, interval, scene = self._setup.reference_share, settings["interval"], moment.scene
        found = predictions_of(scene, near, shape=self._setup.shape, interval=interval, reference_share=share)
        for place, one in enumerate(near if settings["along"] else ()):
            actor, heading = scene.roster.actors[one.row], scene.headings[one.row]
            path = self._path(actor.id, actor.kind)
            if path is None:
                continue
            ahead, speed = share * actor.length, scene.speeds[one.row]
            along = _along(path, one.x, one.y, heading, ahead=ahead, distances=speed * self._times)
            if along is not None:
                found[place, :, :3] = along
        return found

    def _path(self, actor: str, kind: str) -> LanePath | None:
        """Return the path from an actor's lane on; None for a person, or off the lanes of the network file."""
        try:
            lane = None if is_person(actor) else self._setup.graph.lanes.get(sumo.vehicle_getLaneID(actor))
        except libsumo.TraCIException:  # an actor of a recording that is played back
            return None
        if lane is None:
            return None
        lanes = self._lanes.get(kind)
        if lanes is None:
            lanes = self._lanes[kind] = NearLanes(self._setup.graph, self._sampling, kind)
        return lanes.paths.path(lane)


def _along(
    path: LanePath, x: float, y: float, heading: float, *, ahead: float, distances: NDArray[np.floating]
) -> NDArray[np.float64] | None:
    """Return the positions and the heading of an actor that drives some distances along a path, shape (N, 3).

    The result is None for an actor that drives across the path or against it. Beyond its end, the path is straight. The
    heading is in rad, and all distances are in m. The reference point is ``ahead`` of the centre.
    """
    points = path.rows[path.begin :, 1:3]
    if len(points) < 2:
        return None
    steps = np.diff(points, axis=0)
    lengths = np.sqrt((steps * steps).sum(axis=1))
    known = path.last + 1 - path.begin
    nearest = min(int(((points[:known] - (x, y)) ** 2).sum(axis=1).argmin()), len(steps) - 1)
    units = steps / np.maximum(lengths, 1e-9)[:, None]
    if nearest and (units[nearest] @ (x - points[nearest, 0], y - points[nearest, 1])) < 0.0:
        nearest -= 1
    dx, dy = x - points[nearest, 0], y - points[nearest, 1]
    ux, uy = units[nearest]
    if ux * cos(heading) + uy * sin(heading) < _ALONG_COSINE:
        return None
    starts = np.append(0.0, np.cumsum(lengths))
    at = starts[nearest] + dx * ux + dy * uy + distances
    segment = np.clip(np.searchsorted(starts, at, side="right") - 1, 0, len(steps) - 1)
    left = dy * ux - dx * uy
    rest = at - starts[segment] + ahead
    ux, uy = units[segment].T
    place = points[segment] + np.stack((rest * ux - left * uy, rest * uy + left * ux), axis=1)
    return np.column_stack((place, path.rows[path.begin + segment, 3]))


class CovarianceReader(Reader):
    """Reads the part ``prediction_covariance``."""

    def observe(self, moment: AgentMoment) -> NDArray[np.float64]:
        """Return the columns of ``prediction_covariance``."""
        return covariances_of(moment.scene, self._actors_near(moment), self._setup.settings, shape=self._setup.shape)


class ActorIdsReader(Reader):
    """Numbers the actors."""

    def __init__(self, setup: ReaderSetup) -> None:
        super().__init__(setup)
        self._numbers = ActorNumbers()

    def observe(self, moment: AgentMoment) -> NDArray[np.int64]:
        """Return the values of ``actor_ids``."""
        return self._numbers.of(moment.scene, self._actors_near(moment), self._setup.limit)


class RangesReader(Reader):
    """Casts rays to the outlines of actors and obstacles."""

    def __init__(self, setup: ReaderSetup) -> None:
        super().__init__(setup)
        self._reach_m = setup.settings["range"]
        self._caster = RayCaster(int(setup.settings["rays"]), self._reach_m, setup.obstacles)

    def observe(self, moment: AgentMoment) -> NDArray[np.float64]:
        """Return the values of ``lidar2d``."""
        scene, row = moment.scene, moment.row
        longest = max(scene.roster.lengths)
        near = nearest_actors(scene, row, hidden=moment.hidden, radius=self._reach_m + longest)
        ranges, setup = self._caster.cast(scene, row, [one.row for one in near]), self._setup
        step = round((scene.time_s - setup.start_s) / setup.step_length_s)
        return with_range_noise(ranges, setup.settings, seed=setup.seed, agent=setup.agent, step=step)


class _RasterReader(Reader):
    """Finds the cells around the vehicle that are on lanes or inside outlines."""

    def __init__(self, setup: ReaderSetup) -> None:
        super().__init__(setup)
        settings = setup.settings
        self._graph, self._vehicle_class = setup.graph, sumo.vehicle_getVehicleClass(setup.agent)
        shape = int(settings["rows"]), int(settings["columns"])
        self._raster = Raster(*shape, settings["resolution"])
        self._nothing = np.zeros(shape, bool)

    def _road(self, moment: AgentMoment) -> NDArray[np.bool_]:
        x, y = center_of(moment.scene, moment.row)
        reach = self._raster.reach_m + _MAX_HALF_WIDTH_M
        near = [self._graph.lanes[name] for _, name in self._graph.near(x, y, reach, self._vehicle_class)]
        lanes = [(self._graph.lines(lane).center, lane.data.width_m) for lane in near]
        return self._raster.on_lanes(moment.scene, moment.row, lanes)

    def _actors(self, moment: AgentMoment) -> NDArray[np.bool_]:
        scene, row = moment.scene, moment.row
        reach = self._raster.reach_m + max(scene.roster.lengths)
        near = nearest_actors(scene, row, hidden=moment.hidden, radius=reach)
        return self._raster.occupied(scene, row, [one.row for one in near])

    def _obstacles(self, moment: AgentMoment) -> NDArray[np.bool_]:
        known = self._setup.obstacles
        if known is None:
            return self._nothing
        return self._raster.obstructed(moment.scene, moment.row, known)


class GridReader(_RasterReader):
    """Reads the part ``grid``."""

    def observe(self, moment: AgentMoment) -> NDArray[np.uint8]:
        """Return the layers of ``grid``."""
        return np.stack((self._actors(moment) | self._obstacles(moment), self._road(moment))).astype(np.uint8)


class ImageReader(_RasterReader):
    """Reads the part ``image``."""

    def observe(self, moment: AgentMoment) -> NDArray[np.uint8]:
        """Return the picture of ``image``."""
        own = self._raster.occupied(moment.scene, moment.row, [moment.row])
        return picture(self._road(moment), self._obstacles(moment), self._actors(moment), own)
