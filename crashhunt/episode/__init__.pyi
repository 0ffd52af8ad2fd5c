from ._branches import Brancher as Brancher
from ._episode import Episode as Episode, MakeAgent as MakeAgent, Reset as Reset
from ._failures import failure_of as failure_of, words_of as words_of
from ._first_copy import FirstCopy as FirstCopy
from ._nearness import Nearness as Nearness
from ._observer import Observer as Observer
from ._overruled import Braking as Braking, Keeping as Keeping, overruled_agent as overruled_agent
from ._parts import Parts as Parts, require_origin as require_origin, seal as seal, stage_of as stage_of
from ._probes import (
    BUDGET as BUDGET,
    BUDGET_BESIDE as BUDGET_BESIDE,
    PROBED as PROBED,
    Probed as Probed,
    Prober as Prober,
)
from ._recorder import Recorder as Recorder, ready_recorder as ready_recorder
from ._run import (
    generators as generators,
    run_episode as run_episode,
    seed_everything as seed_everything,
    set_generators as set_generators,
)
from ._settings import (
    SettingsData as SettingsData,
    WorkerSettings as WorkerSettings,
    answer_file as answer_file,
    scratch_of as scratch_of,
)
from ._wiring import options_of as options_of
