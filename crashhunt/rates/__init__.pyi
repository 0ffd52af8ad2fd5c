from ._betting import (
    Bets as Bets,
    Interval as Interval,
    RateTest as RateTest,
    discordance_evidence as discordance_evidence,
)
from ._rare import (
    BLOCK as BLOCK,
    Estimated as Estimated,
    RareEstimate as RareEstimate,
    Root as Root,
    learn_forcing as learn_forcing,
    rare_estimate as rare_estimate,
    root_of as root_of,
)
from ._rate import CrashRate as CrashRate, RatePart as RatePart, make_rate as make_rate
from ._units import (
    PERS as PERS,
    BarWatch as BarWatch,
    CountingRule as CountingRule,
    Per as Per,
    RateCounter as RateCounter,
    TrialFacts as TrialFacts,
    Unit as Unit,
    UnitSequence as UnitSequence,
    facts_of as facts_of,
    facts_of_plain as facts_of_plain,
)
