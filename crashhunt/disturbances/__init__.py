"""Disturbances: faults of other actors and of the agent's sensors, which are drawn with a known log-likelihood."""

from typing import TYPE_CHECKING

from crashhunt.base.doors import offer_lazily

if TYPE_CHECKING:
    from ._disturbance_rates import (
        FORM as FORM,
        NONE as NONE,
        DisturbanceSampler as DisturbanceSampler,
        disturber_of as disturber_of,
        is_fixed as is_fixed,
        locate_model as locate_model,
        modules_of_models as modules_of_models,
        parse_fixed as parse_fixed,
        parse_rates as parse_rates,
        signals_of_fixed as signals_of_fixed,
        word_of as word_of,
    )
    from ._models import (
        Choices as Choices,
        ModelApart as ModelApart,
        brake as brake,
        cut_in as cut_in,
        dawdle as dawdle,
        described_model as described_model,
        ignore_priority as ignore_priority,
        late_action as late_action,
        late_merge as late_merge,
        late_observation as late_observation,
        noisy_observation as noisy_observation,
        speed as speed,
        step_out as step_out,
        stop as stop,
        unseen as unseen,
    )
    from ._onsets import (
        COPIES_PER_ROOT as COPIES_PER_ROOT,
        FIRST_STEP as FIRST_STEP,
        SECONDS_PER_COPY as SECONDS_PER_COPY,
        FirstOnsets as FirstOnsets,
        Onset as Onset,
        cell_of as cell_of,
        first_forcing as first_forcing,
    )
    from ._protocol import DisturbanceModel as DisturbanceModel, Drawn as Drawn, Enumerates as Enumerates

offer_lazily(__name__)
