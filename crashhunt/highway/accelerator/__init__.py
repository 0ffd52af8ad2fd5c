"""Acceleration of highway-env without changing a bit of its results."""

from typing import TYPE_CHECKING

from crashhunt.base.doors import offer_lazily

if TYPE_CHECKING:
    from ._acceleration import Acceleration as Acceleration, accelerate as accelerate
    from ._kernel import Poses as Poses, kernel as kernel
    from ._lane_network import Network as Network
    from ._onlooker import Onlooker as Onlooker
    from ._substep_loop import SkippedObservation as SkippedObservation
    from ._supported import kind_of as kind_of, reason_against as reason_against
    from ._switch import (
        switch_off as switch_off,
        switch_on as switch_on,
        why_not as why_not,
    )

offer_lazily(__name__)
