"""Contract suites: what every simulator, sampler, executor and agent must do, for yours too.

Subclass a suite in a test module, give it its fixture, and let pytest collect it::

    class TestMySimulator(SimulatorContract):
        @pytest.fixture
        def make(self, tmp_path):
            return lambda: MySimulator(scenario, tmp_path)

Needs pytest.
"""

from crashhunt.testing._agents import AgentContract
from crashhunt.testing._escapes import EscapeCheck, check_escape
from crashhunt.testing._executors import ExecutorContract
from crashhunt.testing._samplers import SamplerContract
from crashhunt.testing._simulators import SimulatorContract

__all__ = [
    "AgentContract",
    "EscapeCheck",
    "ExecutorContract",
    "SamplerContract",
    "SimulatorContract",
    "check_escape",
]
