"""Tools for tests: `assert_survives`, and suites that check the contracts of agents, simulators and other plugins.

Derive a test class from a suite in a test module, define the fixtures of the suite, and let pytest collect the class::

    class TestMySimulator(SimulatorContract):
        @pytest.fixture
        def make(self, tmp_path):
            return lambda: MySimulator(scenario, tmp_path)

The suites of tests, such as `SimulatorContract`, need the package pytest.
"""

from typing import TYPE_CHECKING

from crashhunt.base.doors import offer_lazily

if TYPE_CHECKING:
    from ._agent_contract import AgentContract as AgentContract
    from ._backend_contract import BackendContract as BackendContract
    from ._disturbance_contract import DisturbanceContract as DisturbanceContract
    from ._executor_contract import ExecutorContract as ExecutorContract
    from ._last_avoidable_step_check import EscapeCheck as EscapeCheck, check_escape as check_escape
    from ._oracle_contract import OracleContract as OracleContract, drive as drive
    from ._sampler_contract import SamplerContract as SamplerContract
    from ._simulator_contract import SimulatorContract as SimulatorContract
    from ._survives import Example as Example, assert_survives as assert_survives

offer_lazily(__name__)
