"""Executors: where trials run."""

from crashhunt.executors._fresh import FreshProcessExecutor
from crashhunt.executors._pool import PoolExecutor
from crashhunt.executors._protocol import Executor, WorkerSettings, scratch_of
from crashhunt.executors._worker import BLACK_BOX, OUTPUT, STACK, read_map, worker_environment

__all__ = [
    "BLACK_BOX",
    "Executor",
    "FreshProcessExecutor",
    "OUTPUT",
    "PoolExecutor",
    "read_map",
    "scratch_of",
    "STACK",
    "worker_environment",
    "WorkerSettings",
]
