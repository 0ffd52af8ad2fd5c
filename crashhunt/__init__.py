"""A parallel crash-hunting fuzzer for traffic agents.

``crashhunt.run``, ``prepare``, ``replay``, ``what_if``, ``judge``, ``shrink``, ``load``, ``compare``, ``Hunt`` and
``Suite`` provide the functions of the command line. ``accelerate`` speeds up highway-env in your own process.
``make_training_env`` returns an environment to train an agent on crashes.

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

import sys
from typing import TYPE_CHECKING, Any

from crashhunt.base.doors import offer_lazily
from crashhunt.base.version import __version__ as __version__

if TYPE_CHECKING:
    from crashhunt.api import prepare as prepare, run as run
    from crashhunt.crash_api import judge as judge, replay as replay, shrink as shrink, what_if as what_if
    from crashhunt.highway.accelerator import accelerate as accelerate
    from crashhunt.hunts import Hunt as Hunt
    from crashhunt.results import load as load
    from crashhunt.statistics import compare as compare
    from crashhunt.suites import Suite as Suite
    from crashhunt.training import make_training_env as make_training_env

offer_lazily(__name__)

_ENVIRONMENTS = {
    "crashhunt/SUMO-v0": "crashhunt.envs:SumoEnv",
    "crashhunt/Crashes-v0": "crashhunt.training:CrashEnv",
}


def _register_environments() -> None:
    """Register the environments with Gymnasium; their modules are imported when an environment is created."""
    from gymnasium.envs.registration import register, registry

    for name, entry_point in _ENVIRONMENTS.items():
        if name not in registry:
            register(id=name, entry_point=entry_point)


class _GymnasiumFinder:
    """Import finder that registers the environments if Gymnasium is imported after crashhunt; it finds no modules.

    ``gymnasium.make("crashhunt:…")`` imports this module, which has no effect if the module was already imported.
    """

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> Any:
        """Return the spec of Gymnasium's registry module, with a loader that also registers; None for other modules."""
        if name != _REGISTRY or self not in sys.meta_path:
            return None
        sys.meta_path.remove(self)
        from importlib.util import find_spec

        spec = find_spec(name)
        if spec is not None and spec.loader is not None:
            loader: Any = spec.loader
            execute = loader.exec_module

            def execute_and_register(module: Any) -> None:
                execute(module)
                _register_environments()

            loader.exec_module = execute_and_register
        return spec


_REGISTRY = "gymnasium.envs.registration"

# gymnasium.make("crashhunt:crashhunt/SUMO-v0") imports this module. Other users must not wait for Gymnasium's import,
# the command line least of all.
if _REGISTRY in sys.modules:
    _register_environments()
else:
    sys.meta_path.insert(0, _GymnasiumFinder())
