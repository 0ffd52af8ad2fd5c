"""Executors: run trials in processes of this machine or on other machines."""

from typing import TYPE_CHECKING

from crashhunt.base.doors import offer_lazily

if TYPE_CHECKING:
    from ._fresh import FreshProcessExecutor as FreshProcessExecutor
    from ._host_conditions import HostConditions as HostConditions
    from ._pool import PoolExecutor as PoolExecutor
    from ._postmortem import read_map as read_map
    from ._protocol import (
        ChoosesParallelism as ChoosesParallelism,
        Executor as Executor,
        HasNodes as HasNodes,
        NodeFigures as NodeFigures,
        make_executor as make_executor,
    )
    from ._supervisor import Supervisor as Supervisor
    from ._trial_process import EXCLUDED_WORDS as EXCLUDED_WORDS
    from ._worker_environment import (
        snapshot_environment as snapshot_environment,
        worker_environment as worker_environment,
    )

offer_lazily(__name__)
