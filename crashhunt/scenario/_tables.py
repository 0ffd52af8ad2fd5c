"""The tables of a ``scenario.toml`` that every simulator has."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from crashhunt.trial import Argument, Kind, kind_of, parse_spec

__all__ = [
    "AgentSetup",
    "ArgumentSetup",
    "ObservationSetup",
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
        replaces: the name of a scenario argument that names a vehicle of the traffic: when that has entered, this one
            drives on in its place.
        type: the vehicle type of the added one.
        route: the route of the added one, by its id.
        edges: or the edges that it drives along (two: the way between them is looked up).
        depart_s: when it enters, in s of simulation time; the end of the warm-up by default. Of one that ``replaces``
            another, the latest time at which that may be expected.
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
    replaces: str = ""
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
