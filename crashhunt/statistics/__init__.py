"""Crash rates: the trials that count, every interval and every test."""

from typing import TYPE_CHECKING

from crashhunt.base.doors import offer_lazily

if TYPE_CHECKING:
    from ._anytime_interval import Bets as Bets, Interval as Interval, RateTest as RateTest
    from ._comparison import compare as compare, held_out_by_seed as held_out_by_seed
    from ._comparison_report import Comparison as Comparison, HuntFigures as HuntFigures
    from ._counted_pairs import SideCounts as SideCounts
    from ._counted_trials import (
        PER_WORDS as PER_WORDS,
        CountingRule as CountingRule,
        Per as Per,
        TrialFacts as TrialFacts,
    )
    from ._gate_verdict import PairVerdict as PairVerdict, PairWatch as PairWatch
    from ._hunt_pairs import GateCase as GateCase, GateReport as GateReport, PairedHunts as PairedHunts
    from ._hunt_rate import (
        counts_suffice as counts_suffice,
        measure_rates as measure_rates,
        rate_of_counts as rate_of_counts,
        rate_of_trials as rate_of_trials,
    )
    from ._paired_test import PairTest as PairTest
    from ._rare import (
        BLOCK as BLOCK,
        TRIALS_PER_ROOT as TRIALS_PER_ROOT,
        Estimated as Estimated,
        RareCounter as RareCounter,
        RareEstimate as RareEstimate,
        learn_forcing as learn_forcing,
        root_of as root_of,
    )
    from ._rate_of_running_hunt import (
        BarWatch as BarWatch,
        Forcings as Forcings,
        RareWatch as RareWatch,
        RateWatch as RateWatch,
        bar_watch as bar_watch,
        crashed_copies as crashed_copies,
        forcings_of as forcings_of,
        rare_watch as rare_watch,
        rate_of_bar as rate_of_bar,
        rate_watch as rate_watch,
        refuse_training_traffic as refuse_training_traffic,
    )
    from ._rate_report import CrashRate as CrashRate, RatePart as RatePart, check_confidence as check_confidence

offer_lazily(__name__)
