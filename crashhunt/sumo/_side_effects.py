"""The side effects that SUMO would have for an untrusted scenario; unknown XML elements count as harmful."""

from __future__ import annotations

from typing import TYPE_CHECKING
from xml.parsers import expat

from crashhunt.base.errors import ScenarioError
from crashhunt.sumo._files import READ, WRITTEN, filled_in, read_xml
from crashhunt.sumo._options import HARMLESS, SumoSetup, canonical, is_output, is_shown

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from crashhunt.scenario import Scenario
    from crashhunt.trial import Value


# The elements and attributes of SUMO's networks, routes and additional files that do no more than simulate.

# From the schemas of SUMO 1.28 (data/xsd), without what names a file, which `_xml` knows.
_ELEMENTS = """
WAUT access add additional assignment bidiPredecessor busStop calibrator carFollowing-ACC carFollowing-BKerner
carFollowing-CACC carFollowing-CC carFollowing-Daniel1 carFollowing-EIDM carFollowing-IDM carFollowing-IDMM
carFollowing-Krauss carFollowing-KraussOrig1 carFollowing-KraussPS carFollowing-PWagner2009 carFollowing-SmartSK
carFollowing-W99 carFollowing-Wiedemann chargingStation closingLaneReroute closingReroute condition conflict
connection container containerFlow containerStop deadlock delete destProbReroute detEntry detExit detectors
e1Detector e2Detector e3Detector edge edgeData entryExitDetector flow foeInsertion function genericParameter include
inductionLoop insertionOrder insertionPredecessor instantInductionLoop interval junction lane laneAreaDetector
laneData laneType location meso neigh net overheadWire overheadWireClamp overheadWireSegment overtakingReroute param
parkingArea parkingAreaReroute person personFlow personTrip phase poi poly predecessor preference prohibition
railSignalConstraints request rerouter rerouterValue restriction ride roundabout route route-alternatives
routeDistribution routeProbReroute routeProbe routes space stationReroute step stop stopOffset taz tazSink tazSource
tazs timedEvent tlLogic tlLogics tractionSubstation trainStop tranship transport trip type types vType
vTypeDistribution vTypeProbe vTypes vaporizer variableSpeedSign vehicle viaProbReroute vss walk wautJunction
wautSwitch
"""

_ATTRIBUTES = """
Mbegin Mflatness accel acceleration acceptedBadges actType actionStepLength active actualArrival adaptFactor
adaptTime aggregate allow angle apProb apparentDecel applyDriverState arrival arrivalEdge arrivalLane arrivalPos
arrivalPosLat arrivalSpeed arrived avoidOverlap begin beginLane beginPos beginSpeed bidi bikeLaneWidth
boardingDuration boardingFactor busStop c1 carFollowModel cc1 cc2 cc3 cc4 cc5 cc6 cc7 cc8 cc9 ccAccel ccDecel
ccoolness center changeLeft changeRight chargeDelay chargeInTransit chargeType chargingStation check
checkLaneFoesAll checkLaneFoesRoundabout clamps collision collisionAvoidanceGainGap collisionAvoidanceGainGapDot
collisionAvoidanceGainSpace collisionAvoidanceGainSpeed collisionAvoidanceOverride collisionMinGapFactor color
constSpacing cont contPos containerCapacity containerNumber containerStop containerTriggered containersPerHour
convBoundary cost costs crossingEdges currentLimit curveIntegration curveResistance customShape cycleTime decel
defer delta density depart departEdge departLane departPos departPosLat departSpeed departed desAccelProfile
desiredMaxSpeed detectPersons deterministic dir disallow discard distance duration earliestEnd earlyTarget edge
edgeLength edges efficiency emergencyDecel emissionClass end endOffset endPos ended entered epsilonacc estimation
exceptions excludeEmpty exitTimes expectArrival expected expectedContainers extension fill finalTarget flatbedD
flatbedH flatbedKa flatbedKp flatbedKv flow foes forbiddenInnerLanes freq friction friendlyPos fringe from
fromJunction fromLane fromLonLat fromTaz fromXY function gapClosingControlGainGap gapClosingControlGainGapDot
gapClosingControlGainSpace gapClosingControlGainSpeed gapControlGainGap gapControlGainGapDot gapControlGainSpace
gapControlGainSpeed geo group guiShape hasDriverState height icon id idAfter idBefore idSegmentEndClamp
idSegmentStartClamp impatience incLanes index indirect insertionChecks intLanes intended
internalJunctionsVehicleWidth jamThreshold jerkmax jmAdvance jmAllwayStopWait jmCrossingGap jmDriveAfterRedTime
jmDriveAfterYellowTime jmDriveRedSpeed jmExtraGap jmIgnoreFoeProb jmIgnoreFoeSpeed jmIgnoreJunctionFoeProb
jmIgnoreKeepClearTime jmSigmaMinor jmStopSignWait jmStoplineGap jmStoplineGapMinor jmTimegapMinor join jump
jumpUntil junctionControl junctionCornerDetail junctionHigherSpeed junctionID junctionLinkDetail
junctionsEndpointShape junctionsMinimalShape k keepClear key kp lambda lane laneChangeModel laneChangedFrom
laneChangedTo laneDensity lanes lanesCount last lat latAlignment latestEnd layer lcAccelLat lcAssertive lcContRight
lcCooperative lcCooperativeHelpThreshold lcCooperativeHelpTime lcCooperativeMinSpeed lcCooperativeRoundabout
lcCooperativeSpeed lcImpatience lcKeepRight lcKeepRightAcceptanceTime lcLaneDiscipline lcLookaheadLeft
lcMaxDistLatStanding lcMaxSpeedLatFactor lcMaxSpeedLatStanding lcOpposite lcOvertakeDeltaSpeedFactor lcOvertakeRight
lcPushy lcPushyGap lcSigma lcSpeedGain lcSpeedGainLookahead lcSpeedGainRemainTime lcSpeedGainRight
lcSpeedGainUrgency lcStrategic lcStrategicLookahead lcSublane lcTimeToImpatience lcTurnAlignmentDistance left
lefthand length limit limitTurnSpeed line lineWidth lines linkIndex linkIndex2 loadingDuration local lon main
maneuverAngleTimes mass massFactor maxAccelProfile maxDur maxPower maxSpeed maxSpeedLat maxTraction maxTraveltime
maxWidth maxvehpreview mesoTLS minDur minGap minGapLat minSamples minSaving minWidth minorPenalty modes nArgs name
netOffset next nextEdges node nodes noise numEdges numLanes number occupancy off offset omegaN onDemand onRoad
oneway openEntry optional origBoundary outlineShape overlapDensity overlapTraveltime overtaking parking parkingArea
parkingBadges parkingLength pass perHour period permitted personCapacity personNumber personsPerHour phi ploegH
ploegKd ploegKp pos posLat power prefer priorEdges priorEdgesLength priority probabilities probability procedure
programID prohibited prohibitor projParameter radius reason rectangularLaneCut red refId refTime repeat
replacedAtTime replacedOnEdge replacedOnIndex reroute resCoef_constant resCoef_linear resCoef_quadratic reservable
resistanceTable response rightOfWay roadsideCapacity roeckl_numerator roeckl_numerator_sharp roeckl_offset
roeckl_offset_sharp roeckl_sharp_radius roundabout route routeLength routeProbe routes routingType sampledSeconds
saveConditions saveDetectors savings scale security segments shape show sidewalkWidth siding sigma sigmaStep
sigmaerror sigmagap sigmaleader signals slope source speed speedControlGain speedControlGainCACC speedControlMinGap
speedDev speedFactor speedFactorPremature speedRelative speedTable speedThreshold speedThresholdRelative split
spreadType startPos startProg started startupDelay state stepping substationId synchron tPersDrive tPersEstimate
taccmax targetLanes tau tauCACCToACC tauEngine tauLast tauff taufj taujf taujj teleported time timeLoss
timeThreshold timeToTeleport timeToTeleportBidi tl tlType tlsFlowPenalty tlsIgnoreInternalJunctionJam tlsPenalty
tmp1 tmp2 tmp3 tmp4 tmp5 to toJunction toLane toLonLat toTaz toXY totalPower tpreview trackVehicles tractionTable
trainStop trainType traveltime treaction triggered tripId type uncontrolled until vClass vClasses vTypes value
vaporized vaporizedOnNextEdge vehdynamics vehext vehicle vehicles vehsPerHour version via viaJunctions viaLonLat
viaXY visibility visible voltage voltageSource waitingTime walkFactor walkingareas wautID weight width
widthResolution withInternal writeAttributes x xi xmlns:xsi xsi:noNamespaceSchemaLocation y yellow z
"""

ELEMENTS = frozenset(_ELEMENTS.split())
ATTRIBUTES = frozenset(_ATTRIBUTES.split())

LABELS = frozenset({"origId", "origFrom", "origTo", "ref", "destination", "name"})
"""The parameters that SUMO hands on and does not read, whatever they say."""


class _SideEffectError(Exception):
    """Signals a side effect; the message of the exception describes it."""


def side_effect(scenario: Scenario, values: Mapping[str, Value], _specifications: Iterable[str]) -> str:
    """Return the side effect that SUMO would have with the options and files of a scenario; empty if there is none."""
    sumo = scenario.table(SumoSetup)
    options = [*sumo.options, *(setup.option for setup in scenario.arguments.values() if setup.option)]
    for option in options:
        name = canonical(option)
        if name not in HARMLESS or is_output(name) or is_shown(name):
            return f"it sets SUMO's option {option!r}"
    texts = set(scenario.texts())
    for file in scenario.files():
        try:
            content = read_xml(scenario.folder / file)
            if file in texts and not sumo.literal:
                content = filled_in(content, values)
            _check_text(file, content, reads=file in texts)
        except (ScenarioError, UnicodeDecodeError, KeyError, ValueError) as error:
            return f"{file} cannot be checked: {error}"
        except _SideEffectError as effect:
            return str(effect)
    return ""


def _check_text(file: str, content: bytes, *, reads: bool) -> None:
    """Refuse an XML file with elements other than those known to simulate.

    The contents are those that SUMO reads. With ``reads``, the files that the file names have been checked.
    """
    parser = expat.ParserCreate()

    def start(tag: str, attributes: dict[str, str]) -> None:
        if tag not in ELEMENTS:
            raise _SideEffectError(f"{file} has the element <{tag}>, which has an unknown effect in SUMO")
        for name, value in attributes.items():
            if (tag, name) in READ:
                if not reads or value.startswith("/") or "${" in value:
                    raise _SideEffectError(f"{file} has <{tag} {name}={value!r}>, and SUMO would read that file")
            elif name not in ATTRIBUTES and name not in WRITTEN:  # these are turned away from where they point
                raise _SideEffectError(f"{file} has <{tag} {name}=…>, which has an unknown effect in SUMO")
        key, value = attributes.get("key", ""), attributes.get("value", "")
        if tag == "param" and key not in LABELS and {"/", "\\", ":"}.intersection(value):
            raise _SideEffectError(
                f"{file} has the parameter {key} = {value!r}, which might name a file that SUMO reads or writes"
            )

    def doctype(*_: object) -> None:
        raise _SideEffectError(f"{file} has a document type, which may change its content")

    parser.StartElementHandler = start
    parser.StartDoctypeDeclHandler = doctype
    try:
        parser.Parse(content, True)
    except (expat.ExpatError, LookupError) as error:
        raise _SideEffectError(f"{file} cannot be checked: {error}") from None
