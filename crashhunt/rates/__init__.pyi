from ._betting import (
    Bets as Bets,
    Interval as Interval,
    RateTest as RateTest,
    discordance_evidence as discordance_evidence,
)
