"""SUMO's options: those set in every trial, their names, and which of them read files, write files or open a port."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from collections.abc import Container, Iterator, Mapping


DEFAULT_OPTIONS = {"time-to-teleport": "-1"}  # otherwise a jam removes vehicles; a scenario may want just that
"""What SUMO gets where a scenario says nothing else."""
FIXED_OPTIONS = {
    "random": "false",
    "threads": "1",  # results depend on it
    "device.rerouting.threads": "0",
    "collision.action": "warn",  # keeps the vehicles and the list; the default teleports
    "collision.check-junctions": "true",  # otherwise crossing traffic never collides
    "collision.mingap-factor": "0",  # otherwise a gap below minGap counts as a crash
    "no-step-log": "true",
    "duration-log.disable": "true",
    "xml-validation": "never",
    # Devices write to the user's working directory by default.
    "device.ssm.file": "/dev/null",
    "device.toc.file": "/dev/null",
}
"""What every trial has, because it means something else with other values."""

RESERVED = frozenset({*FIXED_OPTIONS, "seed", "step-length", "net-file", "route-files", "additional-files"})
RESERVED -= {"device.ssm.file", "device.toc.file"}  # disabled like every other output
"""The options that crashhunt sets itself."""

INPUTS = frozenset({"weight-files", "device.fcd-replay.files", "astar.all-distances", "astar.landmark-distances"})
"""The options, besides those that `SumoSetup` has a key for, whose value is a list of files that SUMO reads."""

# As SUMO 1.28 lists them (sumo --save-template); names after a colon are those of one family.
_HARMLESS = """
begin eager-insert emergency-insert end extrapolate-departpos ignore-accidents ignore-junction-blocker
    ignore-route-errors insertion-checks junction-taz keep-after-arrival lateral-resolution max-depart-delay
    max-num-persons max-num-teleports max-num-vehicles meso-edgelength meso-ignore-lanes-by-vclass
    meso-interpolate-pos meso-jam-threshold meso-junction-control meso-lane-queue meso-ltm meso-minor-penalty
    meso-multi-queue meso-overtaking meso-recheck meso-tauff meso-taufj meso-taujf meso-taujj
    meso-tls-flow-penalty meso-tls-penalty no-internal-links phemlight-temperature phemlight-year
    railsignal-moving-block random-depart-offset replay-rerouting route-steps routing-algorithm scale
    scale-suffix slope-centered sloppy-insert startup-wait-threshold thread-rngs time-to-impatience
    time-to-teleport use-stop-ended use-stop-started waiting-time-memory weight-attribute
collision: check-junctions.mingap stoptime
default: action-step-length carfollowmodel departlane departspeed emergencydecel speeddev
device.battery: track-fuel
device.bluelight: mingapfactor reactiondist
device.btreceiver: all-recognitions offtime range
device.btsender:
device.driverstate: errorNoiseIntensityCoefficient errorTimeScaleCoefficient freeSpeedErrorCoefficient
    headwayChangePerceptionThreshold headwayErrorCoefficient initialAwareness maximalReactionTime minAwareness
    speedDifferenceChangePerceptionThreshold speedDifferenceErrorCoefficient
device.elechybrid:
device.emissions: begin period
device.example: parameter
device.fcd: begin period radius
device.fcd-replay: consistency
device.friction: offset stdDev
device.glosa: add-switchtime ignore-cfmodel max-speedfactor min-speed override-safety range use-queue
device.rerouting: adaptation-interval adaptation-steps adaptation-weight bike-speeds cch-ensemble
    cch-update-threshold.constant cch-update-threshold.factor init-with-loaded-weights invalidation mode
    period pre-period railsignal synchronize threshold.constant threshold.factor with-taz
device.ssm: exclude-conflict-types extratime geo mdrac.prt measures range thresholds trajectories
    write-lane-positions write-na write-positions
device.stationfinder: chargeType chargingStrategy checkEnergyForRoute emptyThreshold maxDistanceToReplacedStop
    maxEuclideanDistance minOpportunityDuration needToChargeLevel opportunisticChargeLevel radius repeat
    replacePlannedStop rescueAction rescueTime reserveFactor saturatedChargeLevel waitForCharge
device.taxi: dispatch-algorithm dispatch-algorithm.params dispatch-keep-unreachable dispatch-period
    idle-algorithm vclasses
device.toc: automatedType dynamicMRMProbability dynamicToCThreshold initialAwareness lcAbstinence manualType
    maxPreparationAccel mrmDecel mrmKeepRight mrmSafeSpot mrmSafeSpotDuration ogChangeRate ogMaxDecel
    ogNewSpaceHeadway ogNewTimeHeadway recoveryRate responseTime useColorScheme
device.tripinfo:
device.vehroute:
emergencydecel: warning-threshold
emissions: volumetric-fuel
intermodal-collision: action stoptime
lanechange: duration overtake-right
mapmatch: distance junctions taz
meso-junction-control: limited
overhead-wire: recuperation solver substation-current-limits
parking: maneuver
pedestrian: jupedsim.exit-tolerance jupedsim.model jupedsim.range-geometry-repulsion
    jupedsim.range-neighbor-repulsion jupedsim.step-length jupedsim.strength-geometry-repulsion
    jupedsim.strength-neighbor-repulsion model striping.dawdling striping.jamfactor striping.jamtime
    striping.jamtime.crossing striping.jamtime.narrow striping.legacy-departposlat striping.mingap-to-vehicle
    striping.reserve-oncoming striping.reserve-oncoming.junctions striping.reserve-oncoming.max
    striping.stripe-width striping.walkingarea-detail timegap-crossing
person-device.btreceiver:
person-device.btsender:
person-device.fcd: period
person-device.rerouting: mode period scope
persontrip: default.group ride-public-line taxi.waiting-time transfer.car-walk transfer.taxi-walk
    transfer.walk-taxi walk-opposite-factor walkfactor
railsignal: default-classes max-block-length moving-block.default-classes moving-block.max-dist
railway: max-train-length
ride: stop-tolerance
step-method: ballistic
time-to-teleport: bidi disconnected highways highways.min-speed railsignal-deadlock remove remove-constraint
    ride
tls: actuated.detector-length actuated.jam-threshold actuated.show-detectors all-off
    delay_based.detector-range yellow.min-decel
weights: minor-penalty priority-factor random-factor random-factor.dynamic reversal-penalty separate-turns
    tls-penalty turnaround-penalty
"""
# Every device has these.
_OF_EACH_DEVICE = ("probability", "explicit", "deterministic")

_SYNONYMS = """
c=configuration-file configuration=configuration-file C=save-configuration save-config=save-configuration
    save-config.relative=save-configuration.relative save-template.commented=save-commented n=net-file
    net=net-file r=route-files routes=route-files a=additional-files additional=additional-files
    w=weight-files weights=weight-files measure=weight-attribute x=weight-attribute H=human-readable-time
    ndump=netstate-dump netstate=netstate-dump netstate-output=netstate-dump
    dump-empty-edges=netstate-dump.empty-edges netstate-output.empty-edges=netstate-dump.empty-edges
    netstate.empty-edges=netstate-dump.empty-edges dump-precision=netstate-dump.precision
    netstate-output.precision=netstate-dump.precision netstate.precision=netstate-dump.precision
    person-fcd=person-fcd-output summary=summary-output tripinfo=tripinfo-output personinfo=personinfo-output
    vehroutes=vehroute-output vehroutes.exit-times=vehroute-output.exit-times
    vehroutes.last-route=vehroute-output.last-route vehroutes.sorted=vehroute-output.sorted
    vehroutes.dua=vehroute-output.dua vehroutes.intended-depart=vehroute-output.intended-depart
    vehroutes.route-length=vehroute-output.route-length personroutes=personroute-output
    statistics-output=statistic-output b=begin e=end s=route-steps
    railsignal.moving-block=railsignal-moving-block carfollow.model=default.carfollowmodel
    device.routing.period=device.rerouting.period device.routing.pre-period=device.rerouting.pre-period
    device.routing.adaptation-weight=device.rerouting.adaptation-weight
    device.routing.adaptation-steps=device.rerouting.adaptation-steps
    device.routing.adaptation-interval=device.rerouting.adaptation-interval
    device.routing.with-taz=device.rerouting.with-taz with-taz=device.rerouting.with-taz
    routing-threads=device.rerouting.threads person-device.routing.period=person-device.rerouting.period
    v=verbose ?=help V=version X=xml-validation W=no-warnings suppress-warnings=no-warnings l=log log-file=log
    no-duration-log=duration-log.disable t=duration-log.statistics taxi.vclasses=device.taxi.vclasses
    device.fcd-replay.file=device.fcd-replay.files meso.ignore-lanes.by-vclass=meso-ignore-lanes-by-vclass
    abs-rand=random srand=seed g=gui-settings-file Q=quit-on-end G=game S=start d=delay B=breakpoints
    data-files=edgedata-files m=edgedata-files N=alternative-net-file D=demo T=disable-textures
    route=route-files
"""

_OUTPUT_OPTIONS = frozenset(
    [
        "netstate-dump",
        "log",
        "message-log",
        "error-log",
        "save-configuration",
        "save-template",
        "save-schema",
        "save-state.files",
        "save-state.prefix",
        "pedestrian.jupedsim.wkt",
        "pedestrian.jupedsim.py",
        "device.ssm.file",
        "device.toc.file",
    ]
)
# Options of output and display; none of them changes the traffic.
_DISPLAY_OPTION_NAMES = """
write-license write-metadata precision human-readable-time verbose print-options help version no-warnings
aggregate-warnings language xml-validation no-step-log remote-port num-clients configuration-file
gui-settings-file quit-on-end start delay breakpoints edgedata-files alternative-net-file selection-file demo
disable-textures registry-viewport window-size window-pos tracker-interval save-commented game osg-view

"""
_DISPLAY_OPTIONS = frozenset(_DISPLAY_OPTION_NAMES.split())
_DISPLAY_FAMILIES = (
    "output-",
    "output.",
    "precision.",
    "save-",
    "log.",
    "duration-log.",
    "step-log.",
    "xml-validation.",
)
_WINDOW_FAMILIES = ("game.", "gui-testing", "device.ssm.filter-edges.")


def _harmless() -> Iterator[str]:
    family = ""
    for word in _HARMLESS.split():
        if word.endswith(":"):
            family = word.replace(":", ".")
            if family.startswith(("device.", "person-device.")):
                yield from (family + name for name in _OF_EACH_DEVICE)
        else:
            yield family + word


HARMLESS = frozenset(_harmless())
"""The options that change the traffic, and neither read nor write a file nor open a port."""

_CANONICAL = dict(pair.split("=") for pair in _SYNONYMS.split())


def canonical(name: str) -> str:
    """Return the name under which SUMO lists an option, given its short name, a synonym or a former name."""
    if name.endswith(".knownveh"):
        return name.removesuffix("knownveh") + "explicit"
    return _CANONICAL.get(name, name)


def writes(name: str) -> bool:
    """Return whether the value of an option is a file that SUMO writes."""
    return name in _OUTPUT_OPTIONS or name.endswith(("-output", ".output"))


def is_output(name: str) -> bool:
    """Return whether an option concerns SUMO's output."""
    family, dot, _ = name.partition(".")
    return writes(name) or (bool(dot) and writes(family))


def is_shown(name: str) -> bool:
    """Return whether an option concerns printing, a window, or a remote control."""
    return name in _DISPLAY_OPTIONS or name.startswith(_DISPLAY_FAMILIES + _WINDOW_FAMILIES)


def is_true(value: object) -> bool:
    """Return whether SUMO reads the value of a Boolean option as true."""
    return str(value).strip().lower() in ("1", "yes", "true", "on", "x", "t")


# The table ``[sumo]``.


Manoeuvre = Literal[
    "cut_in", "cut_out", "deceleration", "lane_keeping", "following", "blocked_lane", "multiple_targets", "pedestrian",
    "detection_range",
]  # fmt: skip
"""The manoeuvres of UN R157."""


@dataclass(frozen=True, kw_only=True)
class SumoSetup:
    """The table ``[sumo]``: files, relative to the scenario's folder, and further options of SUMO.

    Args:
        net: the network file.
        routes: route files.
        additional: additional files.
        options: further options of SUMO without their dashes, such as ``lateral-resolution``. The default of
            ``time-to-teleport`` is -1, so SUMO removes no vehicle from a jam. Output files that options request are not
            written.
        native: whether the compiled core may be used; results are bit-identical with and without it.
        fix_link_order: whether SUMO processes the links of the network in the order of their construction. Otherwise
            SUMO uses the order of the memory addresses of the links, which differs between processes.
        manoeuvre: a manoeuvre of UN R157, such as ``cut_in``: all other road users are moved exactly, as the arguments
            of the scenario say. By default, SUMO simulates the traffic.
        literal: whether ``${NAME}`` in a route or additional file stays unchanged instead of being replaced.
    """

    net: str
    routes: tuple[str, ...] = ()
    additional: tuple[str, ...] = ()
    options: dict[str, bool | int | float | str] = field(default_factory=dict)
    literal: bool | None = None
    native: bool | None = None
    fix_link_order: bool | None = None
    manoeuvre: Manoeuvre | None = None


_MANOEUVRE_ARGUMENTS: Mapping[str, tuple[str, ...]] = {
    "cut_in": ("ego_kmh", "other_kmh", "gap_m", "lateral_mps", "side"),
    "cut_out": ("ego_kmh", "front_m", "lateral_mps", "headway_s", "side"),
    "deceleration": ("ego_kmh", "decel_mps2", "headway_s"),
    "lane_keeping": ("ego_kmh", "headway_s", "swerve_m", "period_s", "beside_m", "side"),
    "following": ("ego_kmh", "headway_s", "offset_m", "slower_kmh", "period_s"),
    "blocked_lane": ("ego_kmh", "distance_m", "offset_m"),
    "multiple_targets": ("ego_kmh", "distance_m", "between_m", "offset_m"),
    "pedestrian": ("ego_kmh", "distance_m", "walk_kmh", "impact_m", "from_side"),
    "detection_range": ("ego_kmh", "seen_m", "distance_m", "offset_m"),
}


SIGNAL_ARGUMENTS: Mapping[str, tuple[str, ...]] = {
    "deceleration": ("decel_mps2",),
    "following": ("slower_kmh",),
    "pedestrian": ("walk_kmh",),
}
"""By manoeuvre, the arguments that may be signals over the time of a trial."""


def arguments_of(manoeuvre: str, given: Container[str]) -> tuple[str, ...]:
    """Return the arguments that a scenario with a manoeuvre must have.

    A cut-in may have ``slower_kmh`` instead of ``other_kmh``.
    """
    names = _MANOEUVRE_ARGUMENTS[manoeuvre]
    if "slower_kmh" in given:
        names = tuple("slower_kmh" if name == "other_kmh" else name for name in names)
    return names
