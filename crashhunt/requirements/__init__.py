"""Requirements: what must hold in a trial, in signal temporal logic."""

from typing import TYPE_CHECKING

from crashhunt.base.doors import offer_lazily

if TYPE_CHECKING:
    from ._grammar import parse as parse
    from ._monitor import Monitor as Monitor
    from ._requirement import Requirement as Requirement, Violation as Violation
    from ._traffic_rules import TRAFFIC_RULES as TRAFFIC_RULES

offer_lazily(__name__)
