"""Executors: where trials run."""

from crashhunt.executors._fresh import FreshProcessExecutor, fresh_environment
from crashhunt.executors._parts import Parts, seal
from crashhunt.executors._pool import PoolExecutor
from crashhunt.executors._protocol import Executor, WorkerSettings, scratch_of
from crashhunt.executors._worker import BLACK_BOX, OUTPUT, STACK, read_map, worker_environment

__all__ = [
    "BLACK_BOX",
    "OUTPUT",
    "STACK",
    "Executor",
    "FreshProcessExecutor",
    "Parts",
    "PoolExecutor",
    "WorkerSettings",
    "fresh_environment",
    "read_map",
    "scratch_of",
    "seal",
    "worker_environment",
]
