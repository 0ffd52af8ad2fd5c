from ._anytime_interval import (
    Bets as Bets,
    Interval as Interval,
    RateTest as RateTest,
)
from ._paired_rates import (
    difference_of_rates as difference_of_rates,
)
from ._paired_test import (
    Pair as Pair,
    PairSequence as PairSequence,
    PairTest as PairTest,
    PairVerdict as PairVerdict,
    PairWatch as PairWatch,
    SideCounts as SideCounts,
)
from ._rare import (
    BLOCK as BLOCK,
    TRIALS_PER_ROOT as TRIALS_PER_ROOT,
    Estimated as Estimated,
    RareCounter as RareCounter,
    RareEstimate as RareEstimate,
    Root as Root,
    is_root as is_root,
    learn_forcing as learn_forcing,
    rare_estimate as rare_estimate,
    root_of as root_of,
    with_plain as with_plain,
)
from ._rate import (
    CrashRate as CrashRate,
    RatePart as RatePart,
    check_confidence as check_confidence,
    make_rate as make_rate,
)
from ._running import (
    WHY_NOT_UNTIL_RATE as WHY_NOT_UNTIL_RATE,
    BarWatch as BarWatch,
    Paced as Paced,
    RateWatch as RateWatch,
)
from ._splitting import (
    PILOT_ROOTS as PILOT_ROOTS,
    choose_levels as choose_levels,
    crash_shares as crash_shares,
    tree_of as tree_of,
    why_unfit as why_unfit,
)
from ._units import (
    MAX_INVALID_SHARE as MAX_INVALID_SHARE,
    PER_WORDS as PER_WORDS,
    PERS as PERS,
    CountingRule as CountingRule,
    Per as Per,
    RateCounter as RateCounter,
    TrialFacts as TrialFacts,
    Unit as Unit,
    UnitSequence as UnitSequence,
    facts_of as facts_of,
    facts_of_plain as facts_of_plain,
)
