from ._executor import RayExecutor as RayExecutor
