"""Trials: the spaces of their arguments, their specifications, their possible outcomes, and their results."""

from typing import TYPE_CHECKING

from crashhunt.base.doors import offer_lazily

if TYPE_CHECKING:
    from ._argument_distributions import (
        Argument as Argument,
        Choice as Choice,
        Constant as Constant,
        Distribution as Distribution,
        Kind as Kind,
        Range as Range,
        Value as Value,
        kind_of as kind_of,
        parse_spec as parse_spec,
        without_folder as without_folder,
    )
    from ._call_signature import (
        FILLED_BY_NAME as FILLED_BY_NAME,
        CallSignature as CallSignature,
        DeclaresArguments as DeclaresArguments,
        PrefersAction as PrefersAction,
        ReturnsActions as ReturnsActions,
        signature_of as signature_of,
    )
    from ._disturbance import (
        CELLS as CELLS,
        HOLD_KINDS as HOLD_KINDS,
        KINDS as KINDS,
        SENSOR_KINDS as SENSOR_KINDS,
        STRENGTH_MARK as STRENGTH_MARK,
        Disturbance as Disturbance,
        Manoeuvre as Manoeuvre,
        in_turn as in_turn,
        steps_of as steps_of,
        why_not as why_not,
    )
    from ._input_signal import (
        InputSignal as InputSignal,
        expand_signal as expand_signal,
        fold_signals as fold_signals,
        is_signal as is_signal,
        is_stored_signal as is_stored_signal,
        point_of_signal as point_of_signal,
        with_fewer_points as with_fewer_points,
    )
    from ._outcome import (
        CRASHES as CRASHES,
        EVENTS as EVENTS,
        Category as Category,
        Outcome as Outcome,
        in_order as in_order,
        outcome_of as outcome_of,
    )
    from ._result import (
        BAD_ACTION as BAD_ACTION,
        KILLED as KILLED,
        MAX_ROBUSTNESS as MAX_ROBUSTNESS,
        UNUSABLE_VALUE as UNUSABLE_VALUE,
        Branch as Branch,
        Branches as Branches,
        Collision as Collision,
        Escape as Escape,
        Failure as Failure,
        Forced as Forced,
        ForcedCopy as ForcedCopy,
        Stress as Stress,
        TrialResult as TrialResult,
        check_disturbances as check_disturbances,
        check_parts as check_parts,
        in_effect as in_effect,
    )
    from ._specification import (
        ALL_AGENTS as ALL_AGENTS,
        Forcing as Forcing,
        Handover as Handover,
        Overruled as Overruled,
        Reseeding as Reseeding,
        TrialSpec as TrialSpec,
    )

offer_lazily(__name__)
