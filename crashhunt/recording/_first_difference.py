"""The first difference between a recording and its replay, and the values around it.

How values are compared is in `records`, in one module for each type of record.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from crashhunt.recording._reading import AgentChannel, Divergence
from crashhunt.recording.records import RECORD_TYPES

if TYPE_CHECKING:
    from crashhunt.recording._recording import Recording
    from crashhunt.recording.records._type import Difference


def first_divergence(recorded: Recording, replayed: Recording) -> Divergence | None:
    """Return the first difference between two recordings; None if they are bit-identical.

    Within a step, observations come before actions and actions before the scene, as in the episode. If the first
    recording is compact, the values of its actors and the digest of the complete recording are compared.
    """
    whole, replayed = replayed, replayed.like(recorded)
    if recorded.prologue != replayed.prologue:
        return Divergence(
            step=0,
            agent="",
            field="setup",
            recorded=recorded.prologue.encode().decode(),
            replayed=replayed.prologue.encode().decode(),
        )
    differences = _differences(recorded.prologue.agents)
    for left, right in zip(recorded.all_steps, replayed.all_steps, strict=False):
        for difference, agent in differences:
            found = difference(left, right, agent)
            if found is not None:
                return found
    if len(recorded.all_steps) != len(replayed.all_steps):
        step = min(len(recorded.all_steps), len(replayed.all_steps))
        return Divergence(
            step=step,
            agent="",
            field="length",
            recorded=len(recorded.all_steps) - 1,
            replayed=len(replayed.all_steps) - 1,
        )
    if recorded.compact is not None and not recorded.compact.digest:  # the beginning of one
        whole = replayed.beginning(len(replayed.records))
    if recorded.digest != whole.digest:
        # Every value of every step agrees, so only the way it was written can differ, or an actor that is not kept.
        return Divergence(
            step=recorded.steps, agent="", field="digest", recorded=recorded.digest, replayed=whole.digest
        )
    return None


_STEPS_AROUND = 2  # steps to report before and after the first difference


def values_around(recorded: Recording, replayed: Recording, divergence: Divergence) -> list[tuple[int, object, object]]:
    """Return (step, recorded value, replayed value) of the divergent field in the steps around the divergence.

    The result is empty if the divergence does not concern a single value. A value is None if a recording lacks the
    step.
    """
    if divergence.place is None:
        return []
    steps = range(max(0, divergence.step - _STEPS_AROUND), divergence.step + _STEPS_AROUND + 1)
    return [(step, _value(recorded, step, divergence), _value(replayed, step, divergence)) for step in steps]


def _value(recording: Recording, number: int, divergence: Divergence) -> object:
    if divergence.place is None or number >= len(recording.all_steps):
        return None
    name, index = divergence.place
    kind = next(kind for kind in RECORD_TYPES.values() if kind.name == name)
    return None if kind.value is None else kind.value(recording.all_steps[number], divergence.agent, index)


def _differences(agents: tuple[AgentChannel, ...]) -> list[tuple[Difference, AgentChannel | None]]:
    """Return the comparisons of the steps of two recordings, in the order of the comparison."""
    kinds = [(kind.per_agent, kind.difference) for kind in RECORD_TYPES.values() if kind.difference is not None]
    of_agents = [(difference, agent) for agent in agents for per_agent, difference in kinds if per_agent]
    return [*of_agents, *((difference, None) for per_agent, difference in kinds if not per_agent)]


def has_same_scenes(recorded: Recording, rerun: Recording, step: int) -> bool:
    """Return whether the scenes of a run are bit-identical to the recorded scenes up to and including a step.

    If a change begins after this step, only such a run gives information about the recorded trial. Observations and
    actions are not compared, because other versions may record them in another form. The recorded trial must contain
    the step.
    """
    rerun = rerun.like(recorded)
    return rerun.steps >= step and all(
        recorded.scene(number).data.tobytes() == rerun.scene(number).data.tobytes() for number in range(step + 1)
    )
