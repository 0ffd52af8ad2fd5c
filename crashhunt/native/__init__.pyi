from ._core import (
    ANSWERED as ANSWERED,
    ASK as ASK,
    DONE as DONE,
    REFUSED as REFUSED,
    SIMULATED as SIMULATED,
    Columns as Columns,
    Core as Core,
    Part as Part,
    UsualSteps as UsualSteps,
    Vehicles as Vehicles,
    core_for as core_for,
    why_not as why_not,
)
