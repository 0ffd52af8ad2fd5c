"""What the player draws in addition to the actors: observation, plan, lights and stop lines, all from the recording.

The observation and the action of step n belong to the scene of step n - 1, from which the agent made its decision.
"""

from __future__ import annotations

import base64
import math
import statistics
import zlib
from typing import TYPE_CHECKING, TypedDict

import numpy as np

from crashhunt.base.text import count_of
from crashhunt.crashes import read_lights, stop_lines_of, yielding_actor
from crashhunt.recording import is_opaque

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from crashhunt.base.codec import JsonObject
    from crashhunt.crashes import Bundle, ContactRecord
    from crashhunt.recording import AgentChannel, Recording

Rows = list[dict[str, float]]

_MAX_VALUES = 400_000  # of all layers of a crash, the last steps first
_MATCH_M = 0.3  # an observed actor is the actor of the scene whose centre is nearer
_MAX_LANE_STEPS = 100  # steps with the lanes of actors, the last ones
_REACH_M = 60.0  # stop lines are drawn within this distance of the path of the agent
_PREDICTION_STRIDE = 5
_MAX_PICTURE_STEPS, _MAX_PICTURE_BYTES = 100, 4_000_000  # of each kind of observed picture
_COLOURS, _MIN_PICTURE_PIXELS = (1, 3), 16
_ACTOR_SHADE, _LANE_SHADE = 40, 200  # of the cells of a grid, of 255
_PLAN_SHAPE, _POSE_NAMES = 5, ("x", "y", "heading", "time")
_PLAN_START_M, _MAX_ACCELERATION_MPS2 = 3.0, 10.0  # bounds of the place of the first planned pose
_MAX_TABLE_ROWS, _MAX_TABLE_STEPS = 64, 100  # of an observed matrix
_MAX_CURVES = 12  # of observed values
_KM = 1000.0
_STATES = ("green", "yellow", "red", "off or blinking")
_LAYERS: Mapping[str, tuple[str, ...]] = {
    "actors": ("x", "y", "heading", "length", "width"),
    "lanes": ("x", "y"),
    "route": ("x", "y"),
    "predictions": ("x", "y"),
}
"""The columns that the player draws, by part of the observation."""


def packed_floats(array: NDArray[np.float64]) -> str:
    """Return an array as text: little-endian float32, compressed by deflate, encoded as base64."""
    return base64.b64encode(zlib.compress(np.ascontiguousarray(array, "<f4").tobytes(), 6)).decode("ascii")


def player_layers(
    bundle: Bundle, recording: Recording, agent: str, contact: ContactRecord | None, origin: NDArray[np.float64]
) -> dict[str, object]:
    """Return the layers of a crash for the player; a layer whose data are missing is missing as well.

    ``origin`` is the position that becomes (0, 0), in m.
    """
    lights = _checked(read_lights(bundle))
    found: dict[str, object] = {
        "stopLines": [
            (kind, ends, lights["signals"].get(lane, []))
            for lane, kind, ends in _stop_lines(bundle, recording, agent, origin)
        ],
        **_way(lights, agent, origin),
    }
    found["actorLanes"] = [
        [number, dict(zip((actor.id for actor in scene.roster.actors), scene.lanes, strict=True))]
        for number, scene in enumerate(recording.scenes())
        if scene.lanes
    ][-_MAX_LANE_STEPS:]
    if yields := yielding_actor(bundle, contact):
        found["yields"] = yields
    channel = next((one for one in recording.prologue.agents if one.id == agent), None)
    if channel is None:
        return found
    if lights["vehicles"]:
        found["vehicleLights"] = lights["vehicles"]
    plan = _plan(recording, channel, origin)
    pictures = _pictures(recording, channel)
    if seen := _seen(recording, channel):
        found["seen"] = seen
    if table := _seen_table(recording, channel):
        found["seenTable"] = table
    more = {**({"plan": plan} if plan else {}), **({"pictures": pictures} if pictures else {})}
    return {**found, **more, **_observed(recording, channel, origin)}


def _stop_lines(
    bundle: Bundle, recording: Recording, agent: str, origin: NDArray[np.float64]
) -> list[tuple[str, str, list[float]]]:
    """Return the lane, the kind and the ends of each stop line near the path of the agent."""
    scenes = recording.scenes()
    lines = stop_lines_of(bundle) if len(scenes) else ()
    path = np.array([scene.points[scene.roster.index[agent]] for scene in scenes if agent in scene.roster.index])
    if not lines or not len(path):
        return []
    low, high = path.min(axis=0) - _REACH_M, path.max(axis=0) + _REACH_M
    middles = np.array([line.ends.mean(axis=0) for line in lines])
    near = ((middles >= low) & (middles <= high)).all(axis=1)
    return [
        (line.lane, line.kind, np.round(line.ends - origin, 2).ravel().tolist())
        for line, is_near in zip(lines, near.tolist(), strict=True)
        if is_near
    ]


class _Lights(TypedDict):
    """The contents of `layout.LIGHTS`, as `LightRecorder` writes them."""

    signals: dict[str, list[tuple[int, str]]]
    vehicles: dict[str, list[tuple[int, int, int]]]
    parts: dict[str, list[tuple[int, dict[str, Rows]]]]
    routes: dict[str, list[tuple[int, list[float]]]]


def _checked(data: JsonObject) -> _Lights:
    """Return lights and routes; nothing if they have another form, such as in a file of a stranger."""
    try:
        return {
            "signals": {
                str(lane): [(int(step), str(colours)) for step, colours in changes]
                for lane, changes in data["signals"].items()
            },
            "vehicles": {
                str(name): [(int(step), int(brake), int(indicator)) for step, brake, indicator in changes]
                for name, changes in data["vehicles"].items()
            },
            "parts": {
                agent: [
                    (
                        int(step),
                        {name: [{key: float(row[key]) for key in row} for row in parts[name]] for name in parts},
                    )
                    for step, parts in steps
                ]
                for agent, steps in data["parts"].items()
            },
            "routes": {
                agent: [(int(step), [float(value) for value in points]) for step, points in steps]
                for agent, steps in data["routes"].items()
            },
        }
    except (KeyError, TypeError, ValueError, AttributeError):
        return {"signals": {}, "vehicles": {}, "parts": {}, "routes": {}}


def _way(lights: _Lights, agent: str, origin: NDArray[np.float64]) -> dict[str, object]:
    """Return the route of an agent at some steps, and its signals, stop line and goals at each step in words."""
    try:
        words = [(step, _in_words(parts)) for step, parts in lights["parts"].get(agent, [])]
    except (KeyError, ValueError, IndexError, OverflowError):
        return {}
    routes = [
        (step, np.round(np.reshape(points, (-1, 2)) - origin, 1).ravel().tolist())
        for step, points in lights["routes"].get(agent, [])
        if len(points) % 2 == 0
    ]
    return {"way": {"words": words, "routes": routes}} if words or routes else {}


def _plan(recording: Recording, channel: AgentChannel, origin: NDArray[np.float64]) -> dict[str, object]:
    """Return the planned poses at each scene, as packed x and y with their number; empty if the agent plans none."""
    is_pose = channel.action_names == _POSE_NAMES
    is_trajectory = len(channel.action_shape) == 2 and channel.action_shape[1] == _PLAN_SHAPE and not is_pose
    if is_opaque(channel.action_shape) or not (is_pose or (is_trajectory and not channel.action_names)):
        return {}
    count = 1 if is_pose else channel.action_shape[0]
    first = _first_step(recording, 2 * count)
    steps = recording.all_steps
    points = np.full((recording.steps + 1 - first, count, 2), np.nan)
    placed = points.copy()  # if they are in the frame of the vehicle
    in_map, in_frame_of_vehicle = True, True
    for number in range(first, min(recording.steps + 1, len(steps) - 1)):
        action, scene = steps[number + 1].actions.get(channel.id), recording.scene(number)
        row = scene.roster.index.get(channel.id)
        if action is None or row is None:
            continue
        poses = np.asarray(action, float).reshape(count, -1)
        points[number - first] = poses[:, 0:2] if is_pose else poses[:, 1:3]
        time_s, speed = float(poses[0, 3 if is_pose else 0]), scene.speeds[row]
        reach = _PLAN_START_M + (speed + _MAX_ACCELERATION_MPS2 * time_s) * time_s
        center, start = scene.centers[row], points[number - first, 0].copy()
        in_map &= bool(np.hypot(*(start - center)) <= reach)
        in_frame_of_vehicle &= bool(np.hypot(*start) <= reach)
        turn, heading = points[number - first], scene.headings[row]
        placed[number - first] = center + turn @ np.array(
            [[math.cos(heading), math.sin(heading)], [-math.sin(heading), math.cos(heading)]]
        )
    if in_map == in_frame_of_vehicle:
        return {}  # the recording does not state the frame of the action
    points = points if in_map else placed
    repeated = np.zeros(points.shape[:2], bool)
    repeated[:, 1:] = (points[:, 1:] == points[:, :-1]).all(axis=2)  # an encoded trajectory repeats its last point
    points[repeated] = np.nan
    used = int(max(np.flatnonzero(np.isfinite(points[:, :, 0]).any(axis=0)), default=-1)) + 1
    return {"first": first, "size": [used, 2], "values": packed_floats(points[:, :used] - origin)} if used else {}


def _pictures(recording: Recording, channel: AgentChannel) -> dict[str, object]:
    """Return the observed pictures of the last steps, by name: packed bytes, shape (steps, height, width, colours).

    These are the parts ``grid`` and ``image``, or an observation that is a picture as a whole. Of a grid, cells with an
    actor are dark, and cells with a lane are grey.
    """
    shapes = {part.name: part.shape for part in channel.observation_parts if part.name in ("grid", "image")}
    if not channel.observation_parts and _is_picture(channel):
        shapes = {"observation": channel.observation_shape}
    found: dict[str, object] = {}
    for name, shape in shapes.items():
        pixels = math.prod(shape[-3:])
        first = max(0, recording.steps - min(_MAX_PICTURE_STEPS, _MAX_PICTURE_BYTES // pixels))
        drawn = []
        for number in range(first, min(recording.steps + 1, len(recording.all_steps) - 1)):
            observation = recording.all_steps[number + 1].observations.get(channel.id)
            if observation is None:
                break
            values = observation if name == "observation" else channel.part(name, observation)
            assert values is not None
            last = np.asarray(values).reshape(-1, *shape[-3:])[-1]  # of a history
            if name == "grid":
                last = np.where(last[0] > 0, _ACTOR_SHADE, np.where(last[1] > 0, _LANE_SHADE, 255))[..., np.newaxis]
            elif last.shape[-1] not in _COLOURS:  # stacked pictures, the newest last
                last = last[-1][..., np.newaxis]
            drawn.append(last.astype(np.uint8))
        if drawn:
            packed = base64.b64encode(zlib.compress(np.array(drawn).tobytes(), 6)).decode("ascii")
            found[name] = {"first": first, "size": list(drawn[0].shape), "bytes": packed}
    return found


def _seen(recording: Recording, channel: AgentChannel) -> dict[str, object]:
    """Return the observed values of an episode without a scene, for curves; empty if there are too many."""
    size = math.prod(channel.observation_shape)
    if recording.actors or channel.observation_parts or not 0 < size <= _MAX_CURVES or _is_picture(channel):
        return {}
    steps = recording.all_steps
    values = np.full((recording.steps + 1, size), np.nan)
    for number in range(min(recording.steps + 1, len(steps) - 1)):
        observation = steps[number + 1].observations.get(channel.id)
        if observation is not None:
            values[number] = np.asarray(observation, float).ravel()
    names = list(channel.observation_names)
    names = names if len(names) == size else [f"observation[{place}]" for place in range(size)]
    return {"names": names, "values": packed_floats(values)}


def _seen_table(recording: Recording, channel: AgentChannel) -> dict[str, object]:
    """Return an observed matrix with named columns, such as highway-env's Kinematics, at each of the last steps."""
    shape, names = channel.observation_shape, channel.observation_names
    if channel.observation_parts or len(shape) != 2 or len(names) != shape[1] or shape[0] > _MAX_TABLE_ROWS:
        return {}
    first = max(0, recording.steps - _MAX_TABLE_STEPS)
    steps = recording.all_steps[first + 1 : recording.steps + 1]  # a step has the observation of the scene before it
    nothing = np.full(shape, np.nan)
    values = [np.asarray(step.observations.get(channel.id, nothing), float) for step in steps]
    packed = packed_floats(np.array(values).reshape(-1))
    return {"first": first, "names": list(names), "rows": shape[0], "values": packed} if values else {}


def _is_picture(channel: AgentChannel) -> bool:
    shape = channel.observation_shape
    if np.dtype(channel.observation_dtype) != np.uint8 or len(shape) != 3:
        return False
    return (
        min(shape[0], shape[1]) >= _MIN_PICTURE_PIXELS
        if shape[-1] in _COLOURS
        else min(shape[1:]) >= _MIN_PICTURE_PIXELS
    )


def _first_step(recording: Recording, size: int) -> int:
    """Return the first step that is shown, if each step has a number of values."""
    return max(0, recording.steps + 1 - _MAX_VALUES // max(size, 1))


def _observed(recording: Recording, channel: AgentChannel, origin: NDArray[np.float64]) -> dict[str, object]:
    """Return the observed parts that can be drawn, their values in words, and the lights of actors."""
    parts = {part.name: part for part in channel.observation_parts}
    if not parts:
        return {}
    shown = {name: columns for name, columns in _LAYERS.items() if name in parts}
    strides = {name: _PREDICTION_STRIDE if name == "predictions" else 1 for name in shown}
    sizes = {name: parts[name].size // len(parts[name].columns) * len(columns) // strides[name]
             for name, columns in shown.items()}  # fmt: skip
    rays = parts["lidar2d"].shape[-1] if "lidar2d" in parts else 0
    first = _first_step(recording, sum(sizes.values()) + rays + 1)
    layers: dict[str, list[NDArray[np.float64]]] = {name: [] for name in shown}
    lidar: list[NDArray[np.float64]] = []
    words: list[list[tuple[str, str]]] = []
    lights: list[list[tuple[str, int, int]]] = []
    apart: list[float] = []
    steps, nothing = recording.all_steps, np.zeros(channel.observation_shape)
    for number in range(first, min(recording.steps + 1, len(steps) - 1)):
        observation = steps[number + 1].observations.get(channel.id)
        is_missing = observation is None or not observation.any()  # such as of an agent that has left
        seen = {name: _present(channel, name, nothing if observation is None else observation) for name in parts}
        for name, columns in shown.items():
            layers[name].append(_columns_of(seen[name], parts[name].columns, columns, origin)[..., :: strides[name], :])
        if rays:
            lidar.append(np.full(rays, np.nan) if is_missing else seen["lidar2d"].ravel())
        rows = (
            {}
            if is_missing
            else {name: _rows(seen[name], part.columns) for name, part in parts.items() if part.columns}
        )
        words.append(_in_words(rows))
        lights.append(_lights(recording, number, rows.get("actors", []), apart))
    if not recording.disturbances and statistics.median(apart or [0.0]) > _MATCH_M:
        # Positions have another reference point than the centre, so boxes would be next to the actors.
        layers = {name: values for name, values in layers.items() if name not in ("actors", "predictions")}
    packed = {
        name: {"size": list(values[0].shape), "values": packed_floats(np.round(np.array(values, float), 2))}
        for name, values in layers.items()
        if values
    }
    if lidar:
        packed["lidar2d"] = {"size": [rays], "values": packed_floats(np.round(np.array(lidar, float), 2))}
    lit = {"lights": lights} if "actors" in parts else {}
    return {"observed": {"first": first, "layers": packed, "words": words, **lit}}


def _present(channel: AgentChannel, name: str, observation: NDArray[np.generic]) -> NDArray[np.float64]:
    """Return the present values of a part: the last entry of a history."""
    part = next(one for one in channel.observation_parts if one.name == name)
    values = np.asarray(channel.part(name, observation), float)
    usual = {"actors": 2, "lanes": 3, "route": 2, "predictions": 3, "lidar2d": 1, "signals": 2, "right_of_way": 2}
    return values[-1] if len(part.shape) > usual.get(name, 1) else values


def _columns_of(
    values: NDArray[np.float64], names: Sequence[str], columns: Sequence[str], origin: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return some columns of a part; rows without content are NaN, and positions begin at the origin."""
    found = values[..., [names.index(name) for name in columns]].copy()
    found[~values.any(axis=-1)] = np.nan
    found[..., :2] -= origin
    return found


def _rows(values: NDArray[np.float64], columns: Sequence[str]) -> Rows:
    """Return the rows with content as mappings from columns to values."""
    flat = values.reshape(-1, len(columns))
    return [dict(zip(columns, row, strict=True)) for row in flat[flat.any(axis=1)].tolist()]


def _in_words(rows: Mapping[str, Rows]) -> list[tuple[str, str]]:
    """Return what the agent observed of traffic lights, right of way and its route, as pairs of a name and a value."""
    found = []
    for signal in rows.get("signals", [])[:1]:
        state = _STATES[int(signal["state"])]
        found.append(("signal", f"{state} for {signal['time_in_state']:.1f} s, in {_meters(signal['distance'])}"))
    for line in rows.get("stop_line", []):
        if not (line["stop_sign"] or line["must_yield"] or line.get("signal")):
            continue  # no vehicle has to stop there
        rules = [word for key, word in (("stop_sign", "stop sign"), ("must_yield", "must yield")) if line[key]]
        where = "inside the junction" if line["distance"] < 0 else f"in {_meters(line['distance'])}"
        found.append(("stop line", ", ".join([where, *rules])))
    if "right_of_way" in rows:
        first = [row for row in rows["right_of_way"] if row["must_yield"]]
        words = f"must yield to {count_of(len(first), 'actor')}" if first else "no actor to yield to"
        arrival = min((row["other_arrival"] for row in first), default=math.inf)
        found.append(("priority", f"{words}, the next in {arrival:.1f} s" if arrival < 1000 else words))
    for route in rows.get("route_state", []):
        changes = int(route["lane_changes_needed"])
        side = "left" if changes > 0 else "right"
        within = _meters(route["distance_to_lane_change"])
        words = f"{count_of(abs(changes), 'lane')} to the {side} within {within}" if changes else "this lane"
        found += [("lane goal", words), ("goal", f"in {_meters(route['distance_left'])}")]
    return found


def _meters(value: float) -> str:
    return f"{value:.1f} m" if value < _KM else f"{value / _KM:.1f} km"


def _lights(recording: Recording, step: int, actors: Rows, distances: list[float]) -> list[tuple[str, int, int]]:
    """Return the identifier, brake light and indicator of each observed actor; add its distance from an actor."""
    scene = recording.scene(step)
    if not actors or not len(scene.roster):
        return []
    centers, found = scene.centers, []
    for actor in actors:
        apart = np.hypot(*(centers - (actor["x"], actor["y"])).T)
        row = int(apart.argmin())
        distances.append(float(apart[row]))
        if apart[row] < _MATCH_M and (actor["brake_light"] or actor["indicator"]):
            found.append((scene.roster.actors[row].id, int(actor["brake_light"]), int(actor["indicator"])))
    return found
