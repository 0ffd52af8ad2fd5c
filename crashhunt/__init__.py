"""A parallel crash-hunting fuzzer for traffic agents."""

import sys

__version__ = "0.1.0"
__all__ = ["__version__"]


def _register_environment() -> None:
    """Tell Gymnasium of ``crashhunt/SUMO-v0``, which imports nothing until somebody makes one."""
    from gymnasium.envs.registration import register, registry

    if "crashhunt/SUMO-v0" not in registry:
        register(id="crashhunt/SUMO-v0", entry_point="crashhunt.simulators.gym_env:SumoEnv")


# gymnasium.make("crashhunt:crashhunt/SUMO-v0") imports this module. Nobody else should wait for Gymnasium's import,
# the command line least of all.
if "gymnasium" in sys.modules:
    _register_environment()
