"""A parallel crash-hunting fuzzer for traffic agents.

``crashhunt.run``, ``prepare``, ``replay``, ``what_if``, ``load``, ``compare``, ``Hunt`` and ``Suite`` do what the
command line does; ``accelerate`` speeds highway-env up in a process of your own.

>>> import crashhunt
>>> report = crashhunt.run(
...     "merge", parallel=2, trials=100, max_steps=400,
...     scenario="merge", seed=1, arguments={"delay_s": 1.0, "max_brake": 3.0},
... )
>>> report.stopped_because
'crash'
>>> [crash.result.outcome.value for crash in crashhunt.load("merge").crashes]
['collision']
>>> crashhunt.replay("merge").verdict
'reproduced'
"""

import importlib
import sys
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from crashhunt.accelerator import accelerate
    from crashhunt.api import prepare, replay, run, what_if
    from crashhunt.estimation import compare
    from crashhunt.hunts import Hunt, load
    from crashhunt.suites import Suite

from crashhunt.base.version import __version__

__all__ = ["Hunt", "Suite", "__version__", "accelerate", "compare", "load", "prepare", "replay", "run", "what_if"]

_HOMES = {
    "Hunt": "crashhunt.hunts",
    "Suite": "crashhunt.suites",
    "accelerate": "crashhunt.accelerator",
    "compare": "crashhunt.estimation",
    "load": "crashhunt.hunts",
}


def __getattr__(name: str) -> Any:
    """Import the functions when they are first asked for: a worker needs none of them."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES.get(name, "crashhunt.api")), name)


def __dir__() -> list[str]:
    return __all__


def _register_environment() -> None:
    """Register ``crashhunt/SUMO-v0`` with Gymnasium, without imports until the environment is made."""
    from gymnasium.envs.registration import register, registry

    if "crashhunt/SUMO-v0" not in registry:
        register(id="crashhunt/SUMO-v0", entry_point="crashhunt.envs:SumoEnv")


# gymnasium.make("crashhunt:crashhunt/SUMO-v0") imports this module. Other users must not wait for Gymnasium's import,
# the command line least of all.
if "gymnasium" in sys.modules:
    _register_environment()
