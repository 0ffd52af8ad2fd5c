"""The simulator protocol: Gymnasium's vocabulary, keyed by agent as in PettingZoo's parallel API."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, TypedDict

from numpy.typing import NDArray

if TYPE_CHECKING:
    import numpy as np
    from gymnasium import Space

    from crashhunt.base.foreign_code import Party
    from crashhunt.native import UsualSteps
    from crashhunt.simulators._observation_layout import ObservationLayout
    from crashhunt.trial import Disturbance, Value
    from crashhunt.world import Lane, Motion, Neighbor, Paths, RoadMap, Roster, Scene, Surroundings, VehicleData


class Options(TypedDict, total=False):
    """Options of an episode.

    Args:
        arguments: The values of the scenario arguments, by name.
        only: Identifiers, as in scenes, of the actors that take part in addition to the agents. Without this option all
            actors take part. Only simulators with `SupportsExclusion` get this option.
        script: Recorded paths along which all other actors are moved. Only simulators with `SupportsScripts` get this
            option.
    """

    arguments: Mapping[str, Value]
    only: Sequence[str]
    script: Paths


Observations = dict[str, NDArray[Any]]
Info = Mapping[str, object]
StepResult = tuple[Observations, Mapping[str, float], Mapping[str, bool], Mapping[str, bool], Mapping[str, Info]]


@dataclass(frozen=True, slots=True)
class FullBraking:
    """The action with which a vehicle brakes as hard as it can without leaving its lane.

    Args:
        action: The agent's action in every step.
        how: A description of the braking, for a sentence that begins with "Braking".
        deceleration: The deceleration in m/s²; None if the simulator does not report it.
        choose: Function that returns the agent's action before each step, as for a vehicle that must steer to keep its
            lane; None if ``action`` is the same in every step.
    """

    action: object
    how: str
    deceleration: float | None = None
    choose: Callable[[], object] | None = None


class ActionForm(Protocol):
    """The form of one agent's actions: the space, the names of the elements, and the encoding."""

    @property
    def space(self) -> Space[object]:
        """The Gymnasium space."""

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the elements of an encoded action."""

    def encode(self, action: object) -> NDArray[np.generic]:
        """Return the action as an array of fixed shape and type; encoding an encoded action changes nothing.

        Raises:
            ActionError: The action is not inside the space.
        """


class OfAnyLength(Protocol):
    """An action form whose encoded actions are arrays of bytes, each of its own length."""

    @property
    def encoded_shape(self) -> tuple[int, ...]:
        """The shape of encoded actions in the prologue of a recording: (-1,), which means any length."""


class KnowsEncodedType(Protocol):
    """An action form that reports the type of its encoded actions, because no sample of its space can be encoded."""

    @property
    def encoded_type(self) -> tuple[str, tuple[int, ...]]:
        """The data type, as in ``numpy.dtype.str``, and the shape of encoded actions."""


class Simulator(Protocol):
    """Runs the episodes of a scenario, one after another.

    Contract: after two calls of `reset` with equal arguments, all methods return bit-identical results for equal
    actions. This guarantee holds in the same process and in another process, whatever ran before. The simulator never
    changes an array that it has returned.

    Optional capabilities are protocols: `ReportsNotices`, `FlattensObservations`, `RestoresObservations`,
    `ObservesParts`, `NamesObservations`, `ReportsEvents`, `MasksActions`, `HasMap`, `HasObstacles`, `HasWindow`,
    `SupportsFullBraking`, `ReportsSurroundings`, `ReportsNearestAhead`, `ReportsSpeedLimit`, `SupportsDisturbances`,
    `SupportsHolds`, `SupportsExclusion`, `SupportsScripts`, `SupportsReseeding`, `CountsSetUp`, `RunsForeignCode`,
    `RestoresState` and `PreparesProcess`. A simulator supports a protocol if it has the methods and attributes of the
    protocol. Registration is not needed.
    """

    @property
    def agents(self) -> Sequence[str]:
        """The agents that act in the next step, without the terminated agents."""

    @property
    def observation_spaces(self) -> Mapping[str, Space[object]]:
        """The observation space of every possible agent."""

    @property
    def actions(self) -> Mapping[str, ActionForm]:
        """The action form of every possible agent."""

    @property
    def step_length_s(self) -> float:
        """Simulation time between two steps, in s."""

    def reset(self, *, seed: int, options: Options | None = None) -> tuple[Observations, Info]:
        """Begin an episode; return the first observation of every agent, and infos.

        Args:
            seed: The seed of all random generators of the episode.
            options: The options of the episode, such as ``{"arguments": {name: value}}``.

        Raises:
            InvalidEpisodeError: The episode cannot be set up.
        """

    def step(self, actions: Mapping[str, NDArray[np.generic]]) -> StepResult:
        """Advance one control step.

        Args:
            actions: The action of every agent in `agents`, as ``actions[agent].encode`` returned it.

        Returns:
            Observations, rewards, terminations, truncations and infos of the agents that acted. An agent terminates
            when it arrives or crashes. A simulator never truncates an episode because of its length.

        Raises:
            SimulatorError: The simulator failed and cannot continue.
        """

    def scene(self) -> Scene:
        """Return the state of all actors after the last `reset` or `step`."""

    def close(self) -> None:
        """Release all resources. A second call does nothing."""


class ReportsNotices(Protocol):
    """A simulator that reports notices about the scenario to the user."""

    @property
    def notices(self) -> Iterable[str]:
        """The notices as lines of text. A hunt reads them after each episode and prints each line once.

        A line may begin with a topic and ``base.text.NOTICE_TOPIC``, which are not printed; of each topic, only the
        first line is printed. A line with ``ABSENT_WORDS`` or ``PRESENT_WORDS`` of the same module says whether a name
        in the scenario occurred in this episode. A hunt prints such a notice only if the name was absent from all.
        """


class FlattensObservations(Protocol):
    """A simulator with Dict or Tuple observations, which it flattens into arrays so that they can be recorded."""

    @property
    def shown_spaces(self) -> Mapping[str, Space[object]]:
        """The Dict or Tuple space of each agent with structured observations, available after `Simulator.reset`.

        crashhunt unflattens an observation into this space before the agent receives it.
        """


class RestoresObservations(Protocol):
    """A simulator that restores structured observations from arrays itself, instead of `gymnasium.spaces.unflatten`.

    This protocol is needed if the arrays of agents in `FlattensObservations.shown_spaces` are not flattened values, as
    for texts and graphs.
    """

    def restore_observation(self, agent: str, array: NDArray[Any], /) -> object:
        """Return the observation that an agent receives.

        Args:
            agent: The agent that receives the observation; it is in `shown_spaces`.
            array: An array that `Simulator.reset` or `Simulator.step` has returned in this episode.
        """


class ObservesParts(Protocol):
    """A simulator whose agents may observe parts of the table `PARTS` instead of the simulator's own observation."""

    @property
    def observation_layouts(self) -> Mapping[str, ObservationLayout]:
        """The layout of the observation of each agent that observes parts."""


class NamesObservations(Protocol):
    """A simulator whose observations are tables with one row per actor and named columns."""

    @property
    def observation_names(self) -> Sequence[str]:
        """The names of the columns, which are the last axis of every observation; empty if they are unknown."""


class ReportsEvents(Protocol):
    """A simulator that detects traffic events, such as running a red light, and puts them into its scenes."""

    @property
    def reported_events(self) -> Sequence[str]:
        """The types of events that the simulator detects; results count events of these types."""


class ReportsDanger(Protocol):
    """A simulator that reports the criticality itself, because its scenes have no actors."""

    @property
    def named_danger(self) -> float | None:
        """The highest criticality of the episode until now, from 0 (nothing near) to 1 (contact); None if unknown."""


class ReportsTruncation(Protocol):
    """A simulator whose episodes may end by a time limit of the simulator."""

    was_truncated: bool
    """Whether the last step ended the episode by a limit, and not because an agent crashed or arrived."""


class ReportsCrashCell(Protocol):
    """A simulator that describes the state after a crash in words, because its scenes have no actors."""

    @property
    def crash_cell(self) -> str:
        """The description, equal for similar crashes; empty before a crash, or if the environment names the type."""


class MasksActions(Protocol):
    """A simulator that reports which discrete actions are possible."""

    def action_mask(self, agent: str, /) -> NDArray[np.bool_] | None:
        """Return which actions of an agent are possible in the next step; None if the environment gives no masks.

        The mask has one value per action, and those of several discrete actions in a row, as in sb3-contrib.

        Raises:
            ForeignError: The environment failed.
        """


class HasMap(Protocol):
    """A simulator whose actors drive on lanes."""

    def lanes(self) -> Sequence[Lane]:
        """Return all lanes; crashhunt calls this method after the first `Simulator.reset`.

        A simulator whose map never changes returns the same object each time, so that callers read the map once.
        """


class HasObstacles(Protocol):
    """A simulator with a map (`HasMap`) and with obstacles that do not move and are no actors, such as buildings."""

    def obstacles(self) -> Sequence[Lane]:
        """Return the obstacles of the episode, each as a closed line of the width 0."""


class ProvidesRoadMaps(Protocol):
    """A simulator that gives its agents the map of the roads, and the data of their vehicles."""

    def prepare_road_maps(self) -> None:
        """Read the map; crashhunt calls this method before the first trial if an agent has the parameter ``map``."""

    def road_map(self, agent: str) -> RoadMap:
        """Return the map of the roads, with the route of a vehicle that has entered."""

    def vehicle_data(self, agent: str) -> VehicleData:
        """Return the size and the limits of a vehicle that has entered."""


class HasWindow(Protocol):
    """A simulator that can show episodes in its own window. The window does not change the simulation."""

    def open_window(self) -> None:
        """Show all later episodes; crashhunt calls this method before the first `Simulator.reset`."""

    def follow(self, agent: str, other: str) -> None:
        """Mark two actors, and keep the agent in view.

        Args:
            agent: A controlled vehicle, which may have left the simulation.
            other: Any actor, or an empty string. The actor may have left, or may not have entered yet.
        """

    @property
    def window_open(self) -> bool:
        """Whether the window is still open."""


class SupportsFullBraking(Protocol):
    """A simulator that knows the action for full braking.

    A hunt needs this action to find the last step at which full braking avoids a crash.
    """

    def full_braking(self, agent: str) -> FullBraking | None:
        """Return the action for full braking; None if no action keeps this vehicle in its lane while it brakes.

        crashhunt calls this method after `Simulator.reset`.
        """


class ReportsSurroundings(Protocol):
    """A simulator that reports the surroundings of an agent's vehicle that a careful driver would consider.

    Counterfactual runs with a reference driver need this knowledge. Contract: `surroundings` changes nothing in the
    simulation.
    """

    def surroundings(self, agent: str) -> Surroundings:
        """Return the surroundings of a vehicle after the last `Simulator.reset` or `Simulator.step`.

        Args:
            agent: The identifier of an agent's vehicle that has not left the simulation.
        """


class Lights(NamedTuple):
    """The lights and routes at one step, for the picture of a crash.

    Args:
        signals: for each lane that ends at a traffic light, its colours, one letter per direction: ``g``, ``y``, ``r``,
            or ``o`` if it is off or blinks.
        vehicles: brake light (0 or 1) and indicator of each vehicle, as in the part ``actors`` of observations.
        parts: the parts of observations that concern the way of each agent that has not left, by name of the part, as
            rows of columns.
        routes: the points of the route ahead of each of these agents, in m.
    """

    signals: Mapping[str, str]
    vehicles: Mapping[str, tuple[int, int]]
    parts: Mapping[str, Mapping[str, Sequence[Mapping[str, float]]]]
    routes: Mapping[str, Sequence[tuple[float, float]]]


class ReportsLights(Protocol):
    """A simulator that reports its traffic lights, the lights of vehicles, and the routes of agents.

    The replay that confirms a crash reads them for the picture of the crash. Contract: `lights` changes nothing in the
    simulation.
    """

    def lights(self) -> Lights:
        """Return the lights and routes after the last `Simulator.reset` or `Simulator.step`."""


class ReportsNearestAhead(Protocol):
    """A simulator that reports the nearest object ahead in less time than all of `ReportsSurroundings.surroundings`.

    The signals of requirements read it in every step. Contract: `nearest_ahead` changes nothing in the simulation.
    """

    def nearest_ahead(self, agent: str, kind: str) -> Neighbor | None:
        """Return the nearest object of a kind among ``surroundings(agent).ahead``; None without one.

        Args:
            agent: as in `ReportsSurroundings.surroundings`.
            kind: ``vehicle`` or ``red light``.
        """


class ReportsSpeedLimit(Protocol):
    """A simulator that reports the speed limit of the lane of an agent's vehicle."""

    def speed_limit(self, agent: str) -> float:
        """Return the speed limit after the last step, in m/s.

        Args:
            agent: as in `ReportsSurroundings.surroundings`.
        """


class TranslatesMotion(Protocol):
    """A simulator that translates actions of acceleration and steering into speeds and lane changes.

    Counterfactual runs with a reference driver need this translation if agents act by acceleration and steering.

    Contract: no method changes the simulation. But after `action_with`, the vehicle may not be where the agent's next
    trajectory or pose expects it: the simulator then follows it as well as the vehicle can, instead of refusing it.
    """

    def is_steered(self, agent: str) -> bool:
        """Whether the actions of a vehicle are an acceleration and a steering angle."""

    def motion_of(self, agent: str, action: NDArray[np.generic]) -> Motion:
        """Return what an encoded action does within the next step."""

    def action_with(
        self, agent: str, action: NDArray[np.generic] | None, *, speed_mps: float | None, keeps_lane: bool
    ) -> NDArray[np.generic]:
        """Return an encoded action with another speed or with other steering.

        Args:
            agent: The identifier of an agent's vehicle that has not left the simulation.
            action: The action that is corrected; may be None if both its speed and its steering are replaced.
            speed_mps: The speed after the step, in m/s; None keeps the acceleration of the given action.
            keeps_lane: Whether the vehicle steers to the middle of its lane.
        """


class ActiveDisturbance(Protocol):
    """A disturbance of a vehicle that takes effect with the next step."""

    @property
    def how_strong(self) -> float:
        """The strength that the vehicle can reach, at most the requested strength, in the unit of the disturbance."""

    def keep(self) -> None:
        """Continue for another step; called before every further step. The vehicle may have left the simulation."""

    def end(self) -> None:
        """Let the vehicle drive by itself again from the next step on. The vehicle may have left the simulation."""


class SupportsDisturbances(Protocol):
    """A simulator that can inject faults into vehicles other than the agents.

    Contract: a disturbed vehicle stays within the physical limits of its type, and is never an agent's vehicle. A
    vehicle has at most one disturbance at a time. `Simulator.reset` discards the disturbances that are still active.
    """

    @property
    def disturbing_kinds(self) -> Sequence[str]:
        """The types of disturbances that the simulator supports, such as ``brake``."""

    def resolve_target(self, disturbance: Disturbance) -> str:
        """Return the identifier of the vehicle that the disturbance targets now; empty if no vehicle is there.

        Args:
            disturbance: The disturbance, which names the agent and the place around the agent.
        """

    def disturb(self, vehicle: str, disturbance: Disturbance) -> ActiveDisturbance | None:
        """Disturb a vehicle from the next step on; return None if that is impossible, as without a neighbouring lane.

        Args:
            vehicle: The identifier that `resolve_target` has just returned.
            disturbance: The disturbance to apply.
        """


class SupportsHolds(Protocol):
    """A simulator that can hold the speed or lane of a vehicle, or remove the vehicle, for counterfactual runs."""

    def hold(self, vehicle: str, what: str) -> ActiveDisturbance | None:
        """Apply a hold to a vehicle from the next step on; return None if that is impossible.

        Args:
            vehicle: The identifier of a vehicle that is not an agent's. The vehicle may have left the simulation.
            what: One of `HELD`. ``keep_speed`` keeps the speed even with an obstacle ahead, ``keep_lane`` keeps the
                lane, and ``gone`` removes the vehicle for the rest of the episode.
        """


class SupportsExclusion(Protocol):
    """A simulator that can exclude actors other than the agents from an episode."""

    @property
    def entered(self) -> Sequence[str]:
        """Identifiers of all actors that have entered since `Simulator.reset`, including excluded actors.

        The sequence is empty if `Simulator.reset` got no option ``only``.
        """


class SupportsScripts(Protocol):
    """A simulator that can move all other actors along recorded paths, whatever the agents do."""

    @property
    def scripted(self) -> bool:
        """Whether the other actors of the current episode follow recorded paths."""


class SupportsReseeding(Protocol):
    """A simulator whose random generators can get another seed between two steps.

    Contract: after `reseed`, all later steps depend on the state of the simulation and on this seed only. The numbers
    that the generators returned before have no influence.
    """

    @property
    def why_no_reseeding(self) -> str:
        """Why re-seeding is impossible, as a sentence without its period; empty if it is possible."""

    def reseed(self, seed: int) -> None:
        """Re-seed all random generators, with effect from the next step on.

        Args:
            seed: The seed, from 0 to 2**31 - 1.
        """


class CountsSetUp(Protocol):
    """A simulator that counts the steps before the first step of an episode, such as the warm-up of traffic."""

    setup_steps: int
    """Number of steps that the last `Simulator.reset` simulated, even if it failed.

    A caller that resumes from a suspended copy sets this number to 0, because these steps are already counted.
    """


class RunsForeignCode(Protocol):
    """A simulator of crashhunt that runs foreign code, which may fail without a fault of crashhunt."""

    party: Party
    """Whose code it runs: that of a simulator, or of a user's environment."""
    foreign_packages: Sequence[str]
    """Top-level packages of that code; an exception that has come through them is no fault of crashhunt.

    Empty if the simulator calls that code inside boundaries only (`crashhunt.base.foreign_code`).
    """


class RestoresState(Protocol):
    """A simulator that can restore state outside of the simulator object, such as class attributes of a library."""

    def tidy(self) -> None:
        """Restore the state outside of the simulator as it was at first; called around every episode."""


class PreparesProcess(Protocol):
    """A simulator that can prepare a process once, for example by loading tables that every first episode would load.

    The simulator's `reset` does not sample from the action spaces.
    """

    def ready_process(self) -> None:
        """Prepare the process; called once, before the first `Simulator.reset`, in the process that forks episodes."""


class NamesMetaActions(Protocol):
    """A discrete action space whose numbers have names."""

    @property
    def meanings(self) -> Sequence[str]:
        """The name of each action number, counted from 0, such as ``SLOWER``."""


class FastStepper(Protocol):
    """Runs uneventful steps of an episode with one agent in the compiled core, each in one call.

    The simulator object keeps an older state than the core until `catch_up` is called.
    """

    core: UsualSteps
    """The compiled object that runs a step and returns its outcome."""

    def is_unpatched(self, simulator: Simulator, /) -> bool:
        """Return whether a step of the core equals a step of the simulator: no method of the simulator is wrapped."""

    @property
    def roster(self) -> Roster:
        """The actors in sight; while `core` runs a step, they may already be the actors after this step."""

    def resume(self) -> Scene | None:
        """Bring `core` to the state of the simulator; return the scene, or None if that is not possible yet."""

    def catch_up(self) -> StepResult:
        """Set the simulator to the state of `core`; return the result that its last step would have returned."""

    def apply(self, agent: str, action: NDArray[np.generic], /) -> bool:
        """Apply an encoded action; return whether the step can stay uneventful."""

    def finish(self, actions: Mapping[str, NDArray[np.generic]], /) -> StepResult:
        """Complete an eventful step, which SUMO has already simulated."""


class SupportsFastSteps(Protocol):
    """A simulator whose uneventful steps the compiled core can run in one call each."""

    @property
    def at_once(self) -> FastStepper | None:
        """The object that runs fast steps in this episode; None if the episode has no fast path."""


FACULTIES: tuple[type, ...] = (
    ReportsNotices,
    FlattensObservations,
    RestoresObservations,
    ReportsCrashCell,
    ReportsDanger,
    ObservesParts,
    NamesObservations,
    ReportsEvents,
    MasksActions,
    HasMap,
    HasObstacles,
    ProvidesRoadMaps,
    HasWindow,
    SupportsFullBraking,
    ReportsSurroundings,
    ReportsNearestAhead,
    ReportsSpeedLimit,
    SupportsDisturbances,
    SupportsHolds,
    SupportsExclusion,
    SupportsScripts,
    SupportsReseeding,
    SupportsFastSteps,
    CountsSetUp,
    RunsForeignCode,
    RestoresState,
    PreparesProcess,
)
"""All optional protocols of a simulator."""
