from ._comparison import (
    Comparison as Comparison,
    HuntFigures as HuntFigures,
    compare as compare,
    held_out_by_seed as held_out_by_seed,
)
from ._hunt_pairs import (
    GateCase as GateCase,
    GateReport as GateReport,
    PairedHunts as PairedHunts,
    ScenarioCounts as ScenarioCounts,
)
from ._hunt_rate import (
    counts_suffice as counts_suffice,
    measure_rates as measure_rates,
    rate_of_counts as rate_of_counts,
    rate_of_trials as rate_of_trials,
)
