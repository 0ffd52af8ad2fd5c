"""The episode: the only place where agent, simulator, oracle and recorder interact."""

from typing import TYPE_CHECKING

from crashhunt.base.doors import offer_lazily

if TYPE_CHECKING:
    from ._action_override import Braking as Braking, HandedOver as HandedOver
    from ._blame import has_users_code as has_users_code, internal_error as internal_error
    from ._branches import Brancher as Brancher
    from ._episode import (
        Episode as Episode,
        FastEpisode as FastEpisode,
        Reset as Reset,
        run_episode as run_episode,
        seed_everything as seed_everything,
    )
    from ._failures import are_functions_replaced as are_functions_replaced
    from ._forced_onsets import OnsetForcer as OnsetForcer
    from ._forks import FirstCopy as FirstCopy, ForkRunner as ForkRunner
    from ._observers import (
        LightRecorder as LightRecorder,
        Nearness as Nearness,
        ObservedEpisode as ObservedEpisode,
        Observer as Observer,
        Recorder as Recorder,
        observation_restorers as observation_restorers,
        options_of as options_of,
        ready_recorder as ready_recorder,
    )
    from ._parts import (
        Parts as Parts,
        overruled_agent as overruled_agent,
        require_origin as require_origin,
        seal as seal,
        stage_of as stage_of,
    )
    from ._probes import BUDGET as BUDGET, BUDGET_BESIDE as BUDGET_BESIDE, Prober as Prober
    from ._reference_driver_correction import ReferenceCorrection as ReferenceCorrection
    from ._reference_driver_takeover import CompetentDriver as CompetentDriver
    from ._trial_signals import INFO_KEY as INFO_KEY, SIGNALS as SIGNALS, TrialSignals as TrialSignals
    from ._worker_settings import WorkerSettings as WorkerSettings, scratch_of as scratch_of

offer_lazily(__name__)
