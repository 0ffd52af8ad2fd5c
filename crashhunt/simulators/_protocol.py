"""The simulator protocol: Gymnasium's vocabulary, keyed by agent as in PettingZoo's parallel API."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, TypedDict

from numpy.typing import NDArray

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    import numpy as np
    from gymnasium import Space

    from crashhunt.native import UsualSteps, Vehicles
    from crashhunt.trial import Disturbance, Value
    from crashhunt.world import Lane, Paths, Roster, Scene

__all__ = [
    "FACULTIES",
    "ActionForm",
    "ActiveDisturbance",
    "AtOnce",
    "BrakesFully",
    "CountsSetUp",
    "FlattensObservations",
    "FullBraking",
    "HasMap",
    "HasMeanings",
    "HasWindow",
    "HoldsBack",
    "Info",
    "LeavesOut",
    "NamesDanger",
    "NamesObservations",
    "Observations",
    "Options",
    "PlaysPaths",
    "Reseeds",
    "Simulator",
    "StepResult",
    "StepsAtOnce",
    "SupportsDisturbances",
    "TellsEvents",
    "TellsNotices",
    "Tidies",
]


class Options(TypedDict, total=False):
    """What an episode is asked for.

    Args:
        arguments: the arguments of the scenario, by name.
        only: those besides the agents that take part, by the names that scenes have for them; everybody where it is
            missing. Only given to one that is `LeavesOut`.
        script: recorded ways along which the others are moved. Only given to one that is `PlaysPaths`.
    """

    arguments: Mapping[str, Value]
    only: Sequence[str]
    script: Paths


Observations = dict[str, NDArray[Any]]
Info = Mapping[str, object]
StepResult = tuple[Observations, Mapping[str, float], Mapping[str, bool], Mapping[str, bool], Mapping[str, Info]]


@dataclass(frozen=True, slots=True)
class FullBraking:
    """How a vehicle brakes as hard as it can without leaving its lane.

    Args:
        action: what the agent answers, in every step.
        how: in words that follow "Braking …".
        deceleration: what that amounts to, in m/s², where the simulator says so.
    """

    action: object
    how: str
    deceleration: float | None = None


class ActionForm(Protocol):
    """How the actions of one agent are written."""

    @property
    def space(self) -> Space[object]:
        """The Gymnasium space."""

    @property
    def names(self) -> tuple[str, ...]:
        """What the elements of an encoded action are."""

    def encode(self, action: object) -> NDArray[np.generic]:
        """Return the action as an array of fixed shape and type; an encoded action is encoded to itself.

        Raises:
            ActionError: it is not inside the space.
        """


class Simulator(Protocol):
    """Runs one episode after another.

    Contract: between two calls of `reset` with equal arguments, everything that any method returns is equal to the
    bit, in this process and in another, whatever ran before. All arrays that are handed out stay as they are.
    What only some simulators can do is a protocol of its own: `TellsNotices`, `FlattensObservations`,
    `NamesObservations`, `TellsEvents`, `HasMap`, `HasWindow`, `BrakesFully`, `SupportsDisturbances`, `HoldsBack`,
    `LeavesOut`, `PlaysPaths`, `Reseeds`, `CountsSetUp`, `Tidies` and `ReadiesProcess`. A simulator supports one
    by having its methods and attributes; there is nothing to register.
    """

    @property
    def agents(self) -> Sequence[str]:
        """The agents that act in the next step; those that have terminated are gone."""

    @property
    def observation_spaces(self) -> Mapping[str, Space[object]]:
        """For every possible agent."""

    @property
    def actions(self) -> Mapping[str, ActionForm]:
        """For every possible agent."""

    @property
    def step_length_s(self) -> float:
        """Simulation time between two steps, in s."""

    def reset(self, *, seed: int, options: Options | None = None) -> tuple[Observations, Info]:
        """Begin an episode; return the first observation of every agent, and infos.

        Args:
            seed: of everything random.
            options: ``{"arguments": {name: value}}``, the scenario arguments.

        Raises:
            InvalidEpisodeError: it cannot be set up.
        """

    def step(self, actions: Mapping[str, NDArray[np.generic]]) -> StepResult:
        """Advance one control step.

        Args:
            actions: of every agent in `agents`, as ``actions[agent].encode`` returned it.

        Returns:
            Observations, rewards, terminations, truncations and infos of the agents that acted. An agent is
            terminated when it has arrived or crashed; a simulator never truncates on its own account of time.

        Raises:
            SimulatorError: the simulator gave up.
        """

    def scene(self) -> Scene:
        """Return the state of all actors after the last `reset` or `step`."""

    def close(self) -> None:
        """Let go of everything. May be called twice."""


class TellsNotices(Protocol):
    """A simulator that wants people to know something about what it runs."""

    @property
    def notices(self) -> Iterable[str]:
        """Lines of text, looked at after each episode; a hunt tells each once."""


class FlattensObservations(Protocol):
    """A simulator whose observations are structured, and that hands out flattened arrays, which can be recorded."""

    @property
    def shown_spaces(self) -> Mapping[str, Space[object]]:
        """The Dict or Tuple space into which an agent's observations are unflattened before it is shown them.

        Only of agents for which that is so; callable after `Simulator.reset`.
        """


class NamesObservations(Protocol):
    """A simulator whose observations are tables: one row an actor, and columns that have names."""

    @property
    def observation_names(self) -> Sequence[str]:
        """What the last axis of every observation holds, for people who read recordings; empty where nobody knows."""


class TellsEvents(Protocol):
    """A simulator that looks for traffic events, such as red lights, and puts them into its scenes."""

    @property
    def told_events(self) -> Sequence[str]:
        """The kinds that it looks for: of those and no others, a result says how often they happened."""


class NamesDanger(Protocol):
    """A simulator without scenes that says itself how near to a crash an episode came."""

    @property
    def named_danger(self) -> float | None:
        """The greatest danger so far, from 0 (nothing near) to 1 (touched); None where nobody knows."""


class HasMap(Protocol):
    """A simulator whose actors drive on lanes."""

    def lanes(self) -> Sequence[Lane]:
        """Return all lanes; called after the first `Simulator.reset`.

        A simulator whose map is always the same returns the same object each time, so that nobody reads it twice.
        """


class HasWindow(Protocol):
    """A simulator with a window of its own, for people to watch. None of this changes what is simulated."""

    def open_window(self) -> None:
        """Show the episodes from now on; called before the first `Simulator.reset`."""

    def follow(self, agent: str, other: str) -> None:
        """Mark two actors, and keep the agent in view.

        Args:
            agent: a controlled vehicle; it may have left.
            other: any actor, or empty for none; it may have left as well, or not yet entered.
        """

    @property
    def window_open(self) -> bool:
        """Whether nobody has closed the window."""


class BrakesFully(Protocol):
    """A simulator that knows how a vehicle brakes as hard as it can.

    With it, a hunt finds out until when a crash could have been avoided.
    """

    def full_braking(self, agent: str) -> FullBraking | None:
        """Return how; None where this vehicle's actions do not keep it in its lane. Called after `Simulator.reset`."""


class ActiveDisturbance(Protocol):
    """A vehicle that errs; it has begun to with the next step."""

    @property
    def how_strong(self) -> float:
        """What the vehicle can do of what was asked for, in the unit of the kind."""

    def keep(self) -> None:
        """Go on; called before every further step. The vehicle may be gone."""

    def end(self) -> None:
        """Let the vehicle drive by itself again from the next step on. It may be gone."""


class SupportsDisturbances(Protocol):
    """A simulator that can have others than the agents err.

    Contract: an erring vehicle does what vehicles of its type can do, and is never one of the agents'. Only one
    disturbance at a time has the same vehicle. Whatever still goes on at the end is forgotten by `Simulator.reset`.
    """

    @property
    def disturbing_kinds(self) -> Sequence[str]:
        """What it can do, such as ``brake``."""

    def resolve_target(self, disturbance: Disturbance) -> str:
        """Return which vehicle is meant, as it is now; empty where there is none.

        Args:
            disturbance: says the agent, and the place around it.
        """

    def disturb(self, vehicle: str, disturbance: Disturbance) -> ActiveDisturbance | None:
        """Have a vehicle err from the next step on; None where it cannot, as where there is no lane to change to.

        Args:
            vehicle: as `resolve_target` has just said.
            disturbance: what it is to do.
        """


class HoldsBack(Protocol):
    """A simulator that can keep one of the others from doing something, to see what hangs on it."""

    def hold(self, vehicle: str, what: str) -> ActiveDisturbance | None:
        """Keep a vehicle from something, from the next step on; None where that cannot be.

        Args:
            vehicle: its name; it may not be there, and is none of the agents'.
            what: one of `HELD`. ``keep_speed`` holds the speed whoever is in its way, ``keep_lane`` the lane, and
                ``gone`` takes it off the road for good.
        """


class LeavesOut(Protocol):
    """A simulator that can leave others than the agents out of an episode, by name."""

    @property
    def entered(self) -> Sequence[str]:
        """Who has entered since `Simulator.reset` was given ``only``, whether it took part or not; else nobody."""


class PlaysPaths(Protocol):
    """A simulator that can move others along recorded ways, so that nothing that anybody does changes them."""

    @property
    def scripted(self) -> bool:
        """Whether the others of this episode are moved along recorded ways."""


class Reseeds(Protocol):
    """A simulator whose random generators can get another seed between two steps.

    Contract: after `reseed`, the steps that follow are a function of the state and of this seed. What the generators
    returned before changes nothing.
    """

    @property
    def why_no_reseeding(self) -> str:
        """Why that is not possible here, as a sentence without its period; empty where it is."""

    def reseed(self, seed: int) -> None:
        """Give all generators another seed, from the next step on.

        Args:
            seed: 0 to 2**31 - 1.
        """


class CountsSetUp(Protocol):
    """A simulator that simulates before the first step, as for traffic to warm up, and says how much."""

    setup_steps: int
    """How many steps the last `Simulator.reset` has simulated, whether or not it set up an episode in the end.

    Whoever goes on from such a place another time sets it to 0: those steps have been counted.
    """


class Tidies(Protocol):
    """A simulator whose episodes change something beyond itself, such as settings in classes of a library."""

    def tidy(self) -> None:
        """Put it back as it was before the first episode. Called after each, and before the first; the next follows."""


class ReadiesProcess(Protocol):
    """A simulator that can do once what the first episode of every process would do again, such as loading tables.

    Its `reset` does not draw from the action spaces.
    """

    def ready_process(self) -> None:
        """Do it. Called once, before the first `Simulator.reset`, in a process whose forks run the episodes."""


class HasMeanings(Protocol):
    """A discrete action space whose numbers stand for something."""

    @property
    def meanings(self) -> Sequence[str]:
        """A word for each number, from 0, such as ``SLOWER``."""


class AtOnce(Protocol):
    """Takes steps of one episode with one agent in which nothing happens, with all that an episode does about them.

    While it goes ahead, the simulator stays where it was, until somebody asks.
    """

    core: UsualSteps
    """What takes a step, and says what has come of it."""

    def is_unpatched(self, simulator: Simulator, /) -> bool:
        """Whether it does what a simulator does: not where somebody has wrapped that, or a method of it."""

    @property
    def roster(self) -> Roster:
        """Who is in sight, or will be after the step that `core` takes."""

    def enter(self, ids: tuple[str, ...], /) -> tuple[Vehicles, tuple[str, ...], int, dict[str, object]] | None:
        """Take note of who is in sight; what it returns is for `core`, None where it cannot go on with them."""

    def resume(self) -> Scene | None:
        """Have `core` go on from where the simulator is; return its scene, None where that has to wait."""

    def catch_up(self) -> StepResult:
        """Bring the simulator to where `core` is; return what its last step would have returned."""

    def apply(self, agent: str, action: NDArray[np.generic], /) -> bool:
        """Apply an encoded action; return whether there is nothing about it to look into."""

    def finish(self, actions: Mapping[str, NDArray[np.generic]], /) -> StepResult:
        """Do what is left of a step that has been simulated."""


class StepsAtOnce(Protocol):
    """A simulator of which most steps may be taken in one call, by the compiled core."""

    @property
    def at_once(self) -> AtOnce | None:
        """What takes them, in this episode; None where nothing can."""


FACULTIES: tuple[type, ...] = (
    TellsNotices,
    FlattensObservations,
    NamesDanger,
    NamesObservations,
    TellsEvents,
    HasMap,
    HasWindow,
    BrakesFully,
    SupportsDisturbances,
    HoldsBack,
    LeavesOut,
    PlaysPaths,
    Reseeds,
    StepsAtOnce,
    CountsSetUp,
    Tidies,
    ReadiesProcess,
)
"""Everything that a simulator may offer."""
