from ._core import Core as Core, Vehicles as Vehicles, core_for as core_for, why_not as why_not
