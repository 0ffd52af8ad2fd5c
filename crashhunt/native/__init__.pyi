from ._core import (
    Columns as Columns,
    Core as Core,
    Part as Part,
    Vehicles as Vehicles,
    core_for as core_for,
    why_not as why_not,
)
