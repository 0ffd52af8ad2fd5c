from ._crashes import OffRoad as OffRoad, Overlap as Overlap, ReportedCollision as ReportedCollision
from ._events import TrafficEvents as TrafficEvents
from ._protocol import Finding as Finding, Oracle as Oracle, merge_findings as merge_findings
