"""The tables of a ``scenario.toml``."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

from crashhunt.trial import Argument, Kind, kind_of, parse_spec

__all__ = [
    "AgentSetup",
    "ArgumentSetup",
    "CrashRule",
    "GymSetup",
    "HighwaySetup",
    "ObservationSetup",
    "SumoSetup",
]

DEFAULT_AGENT = "crashhunt.agents:KeepLaneWithSpeed"


@dataclass(frozen=True, kw_only=True)
class ArgumentSetup:
    """``[arguments.NAME]`` or ``[agents.ID.arguments.NAME]``.

    Args:
        range: what a hunt tries, as a specification such as ``5:40``; empty where it stays at the default.
        default: the value when nobody asks for another.
        unit: for people.
        help: for people.
        option: of a scenario argument, what it sets: an option of SUMO such as ``scale``, or a dotted entry of the
            configuration or the keywords of an environment such as ``observation.vehicles_count``. Where there
            is none, it fills ``${NAME}`` in SUMO's route and additional files, or sets the entry of its own name.
    """

    range: str = ""
    default: bool | int | float | str | None = None
    unit: str = ""
    help: str = ""
    option: str = ""

    def argument(self, name: str, where: str) -> Argument:
        """Return what this says about the argument ``name``."""
        kind: Kind | None = kind_of(self.default) if self.default is not None else None
        distribution = parse_spec(self.range, kind, where=f"{where}.{name}.range") if self.range else None
        return Argument(name, kind, self.default, distribution, self.unit, self.help)


@dataclass(frozen=True, kw_only=True)
class AgentSetup:
    """``[agents.ID]``: one controlled vehicle and who drives it. All but the first and the last are SUMO's.

    Args:
        agent: ``module:attribute``, or the name of a registered agent.
        existing: take over the vehicle ID of the traffic; otherwise one with that id is added.
        type: the vehicle type of the added one.
        route: the route of the added one, by its id.
        edges: or the edges that it drives along (two: the way between them is looked up).
        depart_s: when it enters, in s of simulation time; the end of the warm-up by default.
        depart_lane: as SUMO's departLane.
        depart_pos: as SUMO's departPos.
        depart_speed: as SUMO's departSpeed.
        action: ``continuous`` is (target speed, lane change); ``meta`` is highway-env's DiscreteMetaAction.
        target_speeds: the speeds that FASTER and SLOWER of ``meta`` step through, in m/s.
        speed_mode: SUMO's speed mode bits; 6 keeps physical limits and ignores the safe speed.
        arguments: what is known about the agent's arguments here.
    """

    agent: str = DEFAULT_AGENT
    existing: bool = False
    type: str = "DEFAULT_VEHTYPE"
    route: str = ""
    edges: tuple[str, ...] = ()
    depart_s: float | None = None
    depart_lane: str = "best"
    depart_pos: str = "base"
    depart_speed: str = "max"
    action: Literal["continuous", "meta"] = "continuous"
    target_speeds: tuple[float, ...] = (0.0, 5.0, 10.0, 15.0, 20.0, 25.0, 30.0)
    speed_mode: int = 6
    arguments: dict[str, ArgumentSetup] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class ObservationSetup:
    """``[observation]``: what an agent is shown; the layout is highway-env's Kinematics.

    Args:
        vehicles: rows: the controlled vehicle and its nearest actors.
        features: columns; ``kind`` says what a row is: 1 a motor vehicle, 2 a two-wheeler, 3 a person on foot, 4 what
            runs on rails, 5 an obstacle.
        normalize: scale to [-1, 1] by highway-env's ranges.
    """

    vehicles: int = 8
    features: tuple[Literal["presence", "x", "y", "vx", "vy", "heading", "cos_h", "sin_h", "kind"], ...] = (
        "presence",
        "x",
        "y",
        "vx",
        "vy",
        "cos_h",
        "sin_h",
    )
    normalize: bool = False


@dataclass(frozen=True, kw_only=True)
class SumoSetup:
    """``[sumo]``: files, relative to the scenario's folder, and further options of SUMO.

    Args:
        net: the network.
        routes: route files.
        additional: additional files.
        options: further options of SUMO without their dashes, such as ``lateral-resolution``. Where there is no
            ``time-to-teleport``, it is -1: nobody is taken away, and a jam stays one. What they would have SUMO write
            is not written.
        literal: whether ``${NAME}`` in a route or additional file is left as it is, instead of being filled in.
    """

    net: str
    routes: tuple[str, ...] = ()
    additional: tuple[str, ...] = ()
    options: dict[str, bool | int | float | str] = field(default_factory=dict)
    literal: bool | None = None


@dataclass(frozen=True, kw_only=True)
class HighwaySetup:
    """``[highway]``: an environment of highway-env.

    Args:
        id: as `gymnasium.make` takes it, such as ``highway-fast-v0``; ``module:ID`` imports a module of your own first.
        config: what differs from the environment's own configuration; tables are merged, but one with another
            ``type`` replaces.
        off_road: whether leaving the lanes is a crash; by default everywhere but in car parks, where they are bays.
        accelerate: whether the accelerator is used; it changes no bit.
    """

    id: str
    config: dict[str, Any] = field(default_factory=dict)
    off_road: bool | None = None
    accelerate: bool = True


@dataclass(frozen=True, kw_only=True)
class CrashRule:
    """``[gym.crash]``: when a step of a Gymnasium environment is a crash; any of these.

    Args:
        info: a key of the info that is true.
        termination: the environment terminates; what it truncates is no crash.
        reward_below: the reward of the step is below this.
        function: ``module:function``, called with observation, reward, terminated, truncated, info; what it returns is
            taken as true or false, and a text as what happened.
    """

    info: str = ""
    termination: bool = False
    reward_below: float | None = None
    function: str = ""


@dataclass(frozen=True, kw_only=True)
class GymSetup:
    """``[gym]``: any environment of Gymnasium.

    Args:
        id: as `gymnasium.make` takes it, or ``module:factory``, which is called with ``kwargs``.
        kwargs: of the environment.
        crash: what counts as a crash.
    """

    id: str
    kwargs: dict[str, Any] = field(default_factory=dict)
    crash: CrashRule = field(default_factory=CrashRule)
