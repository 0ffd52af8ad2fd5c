"""Where two recordings first differ."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from crashhunt.recording._recording import AgentChannel, Recording, StepRecord
    from crashhunt.world import Scene

__all__ = ["Divergence", "first_divergence", "values_around"]


@dataclass(frozen=True, slots=True)
class Divergence:
    """The first difference between a recording and its replay.

    Args:
        step: at which step; the observation and the action of step n lead to the scene of step n.
        agent: the agent or actor that it is about; empty where it is about the whole episode.
        field: such as ``observation[1, x]``, ``action[target_speed]``, ``scene.x`` or ``length``.
        recorded: the value in the recording; None where there is none.
        replayed: likewise in the replay.
        place: of the value within the step: ``observation``, ``action`` or a column of the scene, and the index.
    """

    step: int
    agent: str
    field: str
    recorded: Any
    replayed: Any
    place: tuple[str, tuple[int, ...]] | None = None

    def to_json(self) -> dict[str, Any]:
        """Return the shape that ``replay --json`` prints."""
        facts = asdict(self)
        del facts["place"]
        data: dict[str, Any] = json.loads(json.dumps(facts, default=float))
        return data

    def __str__(self) -> str:
        who = f"{self.agent} " if self.agent else ""
        return f"step {self.step}, {who}{self.field}: recorded {self.recorded!r}, replayed {self.replayed!r}"


def first_divergence(recorded: Recording, replayed: Recording) -> Divergence | None:
    """Return the first difference to the bit, or None where the two are equal.

    Within a step, observations come before actions and actions before the scene, as in the episode.
    """
    if recorded.prologue != replayed.prologue:
        return Divergence(0, "", "setup", recorded.prologue.encode().decode(), replayed.prologue.encode().decode())
    for left, right in zip(recorded.all_steps, replayed.all_steps, strict=False):
        found = _in_step(left, right, recorded.prologue.agents)
        if found is not None:
            return found
    if len(recorded.all_steps) != len(replayed.all_steps):
        step = min(len(recorded.all_steps), len(replayed.all_steps))
        return Divergence(step, "", "length", len(recorded.all_steps) - 1, len(replayed.all_steps) - 1)
    if recorded.digest != replayed.digest:
        # Every value of every step agrees, so only the way it was written can differ.
        return Divergence(recorded.steps, "", "digest", recorded.digest, replayed.digest)
    return None


def values_around(
    recorded: Recording, replayed: Recording, divergence: Divergence, *, reach: int = 2
) -> list[tuple[int, Any, Any]]:
    """Return (step, recorded value, replayed value) of the field that diverges, in the steps around.

    Nothing where the divergence is not about one value; None where a recording does not have the step.
    """
    if divergence.place is None:
        return []
    first = max(0, divergence.step - reach)
    return [
        (step, _value(recorded, step, divergence), _value(replayed, step, divergence))
        for step in range(first, divergence.step + reach + 1)
    ]


def _value(recording: Recording, number: int, divergence: Divergence) -> Any:
    if divergence.place is None or number >= len(recording.all_steps):
        return None
    step = recording.all_steps[number]
    kind, index = divergence.place
    if kind == "scene":
        if step.scene is None or divergence.agent not in step.scene.roster.index:
            return None
        return float(step.scene.data[step.scene.roster.index[divergence.agent], index[0]])
    array = (step.observations if kind == "observation" else step.actions).get(divergence.agent)
    return None if array is None else array[index].item()


def _in_step(left: StepRecord, right: StepRecord, agents: tuple[AgentChannel, ...]) -> Divergence | None:
    step = left.step
    for agent in agents:
        for kind, rows in (("observation", agent.observation_names), ("action", agent.action_names)):
            was = (left.observations if kind == "observation" else left.actions).get(agent.id)
            now = (right.observations if kind == "observation" else right.actions).get(agent.id)
            if was is None and now is None:
                continue
            if was is None or now is None:
                return Divergence(step, agent.id, kind, _plain(was), _plain(now))
            if was.tobytes() != now.tobytes():
                where = _first_difference(was, now)
                name = ", ".join((*map(str, where[:-1]), rows[where[-1]] if rows else str(where[-1]))) if where else ""
                field = f"{kind}[{name}]" if name else kind
                return Divergence(step, agent.id, field, was[where].item(), now[where].item(), (kind, where))
    if left.scene is None or right.scene is None:
        if left.scene is right.scene:
            return None
        return Divergence(step, "", "scene", left.scene and "present", right.scene and "present")
    for name in left.rewards:
        if np.float64(left.rewards[name]).tobytes() != np.float64(right.rewards[name]).tobytes():
            return Divergence(step, name, "reward", left.rewards[name], right.rewards[name])
    return _in_scene(step, left.scene, right.scene)


def _in_scene(step: int, left: Scene, right: Scene) -> Divergence | None:
    if left.time_s != right.time_s:
        return Divergence(step, "", "time_s", left.time_s, right.time_s)
    if left.roster.actors != right.roster.actors:
        for was, now in zip(left.roster.actors, right.roster.actors, strict=False):
            if was != now:
                if was.id == now.id:
                    return Divergence(step, was.id, "actor", str(was), str(now))
                break
        missing = [actor.id for actor in left.roster.actors if actor.id not in right.roster.index]
        if missing:
            return Divergence(step, missing[0], "presence", 1, 0)
        extra = [actor.id for actor in right.roster.actors if actor.id not in left.roster.index]
        if extra:
            return Divergence(step, extra[0], "presence", 0, 1)
        return Divergence(step, "", "order of actors", [a.id for a in left.roster.actors][:5], "another")
    was_data, now_data = left.data, right.data
    if was_data.tobytes() != now_data.tobytes():
        row, column = _first_difference(was_data, now_data)
        name = ("x", "y", "heading", "speed")[column]
        was_value, now_value = float(was_data[row, column]), float(now_data[row, column])
        who = left.roster.actors[row].id
        return Divergence(step, who, f"scene.{name}", was_value, now_value, ("scene", (column,)))
    for field in ("contacts", "off_road", "lanes", "heights", "grades", "spines"):
        # As text, in which a speed that nobody knows, NaN, equals itself.
        was_events, now_events = str(getattr(left, field)), str(getattr(right, field))
        if was_events != now_events:
            return Divergence(step, "", f"scene.{field}", was_events, now_events)
    return None


def _first_difference(left: NDArray[Any], right: NDArray[Any]) -> tuple[int, ...]:
    size = left.itemsize
    was, now = left.tobytes(), right.tobytes()
    flat = next(n for n in range(left.size) if was[n * size : (n + 1) * size] != now[n * size : (n + 1) * size])
    return tuple(int(index) for index in np.unravel_index(flat, left.shape))


def _plain(array: NDArray[Any] | None) -> Any:
    return None if array is None else array.tolist()
