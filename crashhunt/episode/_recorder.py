"""The observer that records an episode in the black box."""

from __future__ import annotations

import struct
from collections import Counter
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from crashhunt.base.faculties import offers
from crashhunt.episode._observer import Observer
from crashhunt.recording import (
    AgentChannel,
    BlackBox,
    Phase,
    Prologue,
    Tag,
    digest_of,
    encode_actors,
    encode_disturbance,
    encode_events,
    encode_heights,
    encode_notes,
    encode_spines,
)
from crashhunt.simulators import NamesObservations, TellsEvents
from crashhunt.trial import Outcome

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from crashhunt.episode._episode import Episode
    from crashhunt.native import UsualSteps
    from crashhunt.simulators import ActionForm, Simulator
    from crashhunt.trial import Disturbance, TrialResult
    from crashhunt.world import Actor, Roster, Scene

__all__ = ["Recorder", "ready_recorder"]


class Recorder(Observer):
    """Turns what happens into records; adds the digest to the result, and how often which event happened.

    It comes first of all observers: a step is complete when it is recorded.

    Args:
        box: what to write into; `BlackBox.begin` has been called.
        simulator: whose episode it is.
    """

    def __init__(self, box: BlackBox, simulator: Simulator) -> None:
        self._box = box
        self._numbers: dict[Actor, int] = {}
        self._same: dict[int, int] = {}
        self._kept: list[Actor] = []
        self._roster: Roster | None = None
        # Where nobody looks for events, none having happened says nothing.
        self._events: Counter[str] | None = Counter() if offers(simulator, TellsEvents) else None
        # Called in every step: without a call in between.
        self.observation = box.observation  # type: ignore[assignment, method-assign]
        self.action = box.action  # type: ignore[assignment, method-assign]

    def lend(self, steps: UsualSteps, roster: Roster) -> None:
        """Have the core record steps of these actors, who are recorded here."""
        if roster is not self._roster:
            self._note_roster(roster)
        self._box.lend(steps, roster)

    def begin(self, episode: Episode) -> None:
        """Record who takes part."""
        simulator = episode.simulator
        columns = tuple(simulator.observation_names) if offers(simulator, NamesObservations) else ()
        channels = []
        for agent in episode.names:
            space, form = simulator.observation_spaces[agent], simulator.actions[agent]
            sample = _sample_of(form)
            shown = np.dtype(space.dtype).str, tuple(space.shape or ())
            channels.append(AgentChannel(agent, *shown, sample.dtype.str, sample.shape, tuple(form.names), columns))
        self._box.set_up(episode.setup_steps or 0)
        self._box.prologue(Prologue(tuple(channels), simulator.step_length_s).encode(), len(channels))

    def observation(self, number: int, observation: NDArray[np.generic]) -> None:
        """Record what an agent is about to be shown."""
        self._box.observation(number, observation)

    def action(self, number: int, action: NDArray[np.generic]) -> None:
        """Record what an agent answered."""
        self._box.action(number, action)

    def disturbance(self, disturbance: Disturbance) -> None:
        """Record what takes place, and who is meant."""
        self._box.append(Tag.DISTURBANCE, 0, encode_disturbance(disturbance))

    def scene(self, step: int, scene: Scene, rewards: tuple[float, ...]) -> None:
        """Record a scene, and before it whatever is new about it."""
        if scene.roster is not self._roster:
            self._note_roster(scene.roster)
        if scene.lanes:
            self._box.append(Tag.LANES, 0, "\n".join(scene.lanes).encode())
        if scene.contacts or scene.off_road:
            self._box.append(Tag.EVENTS, 0, encode_events(scene))
        if scene.heights:
            self._box.append(Tag.HEIGHTS, 0, encode_heights(scene))
        if scene.spines:
            self._box.append(Tag.SPINES, 0, encode_spines(scene))
        if scene.events:
            self._box.note(encode_notes(scene.events))
            if self._events is not None:
                self._events.update([event.kind for event in scene.events])
        self._box.step(step, scene, rewards)

    def _note_roster(self, roster: Roster) -> None:
        actors = roster.actors
        # Most are the same objects as before: to look for an equal one takes longer than all else about a roster.
        numbers = list(map(self._same.get, map(id, actors)))
        if None in numbers:
            fresh, known = [], self._numbers
            for row, number in enumerate(numbers):
                if number is None:
                    actor, free = actors[row], len(known)
                    numbers[row] = self._same[id(actor)] = known.setdefault(actor, free)
                    self._kept.append(actor)  # so that nobody else gets its identity
                    if len(known) > free:
                        fresh.append(actor)
            if fresh:
                self._box.append(Tag.ACTORS, 0, encode_actors(fresh))
        self._box.append(Tag.ROSTER, 0, struct.pack(f"<{len(numbers)}I", *numbers))
        self._roster = roster

    def copied(self) -> None:
        """Record elsewhere from now on, after a copy of what there is."""
        self._box.copy()

    def end(self, result: TrialResult) -> TrialResult:
        """Say so, and add the digest of what has been recorded."""
        self._box.mark(Phase.DONE)
        digest = digest_of(*self._box.evidence()) if result.outcome is not Outcome.INVALID else ""
        return replace(result, digest=digest, events=None if self._events is None else dict(self._events))


_ready: dict[int, tuple[ActionForm, NDArray[np.generic]]] = {}  # by identity, which holds as long as the form is here


def ready_recorder(simulator: Simulator) -> None:
    """Encode an action of each agent ahead of the first episode, whose recorder then need not.

    Seeding a space takes longer than many steps. A fork inherits the generators of the spaces as this leaves them, so
    an agent that samples from its action space gets the same. Only for simulators whose `reset` leaves them alone.
    """
    for form in simulator.actions.values():
        _ready[id(form)] = form, _encode_any(form)


def _sample_of(form: ActionForm) -> NDArray[np.generic]:
    ready = _ready.pop(id(form), None)  # for one episode: afterwards an agent may have sampled from the space
    return _encode_any(form) if ready is None else ready[1]


def _encode_any(form: ActionForm) -> NDArray[np.generic]:
    # Only the shape and type of the encoded action matter.
    form.space.seed(0)
    return form.encode(form.space.sample())
