from ._fault import Fault as Fault, FaultData as FaultData, Verdict as Verdict, fault_of as fault_of
from ._frames import Frame as Frame, own_frames as own_frames
from ._groups import (
    Group as Group,
    GroupData as GroupData,
    Groups as Groups,
    group_crashes as group_crashes,
    groups_of as groups_of,
)
from ._lanes import LaneMap as LaneMap
from ._signature import Signature as Signature, signature_of as signature_of, signature_of_fault as signature_of_fault
