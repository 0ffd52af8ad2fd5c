"""Training on crashes: the environment ``crashhunt/Crashes-v0``, the split of seeds, and ``trained_on.json``."""

from typing import TYPE_CHECKING

from crashhunt.base.doors import offer_lazily

if TYPE_CHECKING:
    from ._crash_env import CrashEnv as CrashEnv, make_training_env as make_training_env
    from ._held_out_traffics import (
        HeldOutTraffics as HeldOutTraffics,
        Split as Split,
        TrainedOn as TrainedOn,
        check_test_share as check_test_share,
        held_out_traffics as held_out_traffics,
        split_crashes as split_crashes,
    )

offer_lazily(__name__)
