from ._fresh import FreshProcessExecutor as FreshProcessExecutor, fresh_environment as fresh_environment
from ._pool import PoolExecutor as PoolExecutor
from ._protocol import Executor as Executor
from ._worker import (
    Worker as Worker,
    read_map as read_map,
    worker_environment as worker_environment,
)
