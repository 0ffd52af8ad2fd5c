"""Oracles: detectors of crashes and traffic events in the scene of a step."""

from typing import TYPE_CHECKING

from crashhunt.base.doors import offer_lazily

if TYPE_CHECKING:
    from ._included_oracles import (
        MAX_BRAKING_MPS2 as MAX_BRAKING_MPS2,
        OffRoad as OffRoad,
        OffRoute as OffRoute,
        Overlap as Overlap,
        RedLight as RedLight,
        ReportedCollision as ReportedCollision,
        Teleport as Teleport,
        TooClose as TooClose,
        TrafficEvents as TrafficEvents,
        WrongWay as WrongWay,
    )
    from ._protocol import (
        DEFAULT_ORACLES as DEFAULT_ORACLES,
        ORACLES_OF_ACTORS as ORACLES_OF_ACTORS,
        REQUIREMENT as REQUIREMENT,
        BringsOutcomes as BringsOutcomes,
        ChecksEnd as ChecksEnd,
        Finding as Finding,
        Oracle as Oracle,
        OracleChoice as OracleChoice,
        ReadsSignals as ReadsSignals,
        SeesMap as SeesMap,
        SignalSource as SignalSource,
        chosen_oracles as chosen_oracles,
        described_oracle as described_oracle,
        merge_findings as merge_findings,
        modules_of as modules_of,
        oracle_name as oracle_name,
        outcomes_brought as outcomes_brought,
        parse_oracle as parse_oracle,
    )
    from ._requirement_oracle import (
        RequirementOracle as RequirementOracle,
        check_requirement as check_requirement,
        requirement_oracles as requirement_oracles,
    )

offer_lazily(__name__)
