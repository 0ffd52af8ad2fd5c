"""Tools for tests: `assert_survives`, and suites that check the contracts of agents, simulators and other plugins.

Derive a test class from a suite in a test module, define the fixtures of the suite, and let pytest collect the class::

    class TestMySimulator(SimulatorContract):
        @pytest.fixture
        def make(self, tmp_path):
            return lambda: MySimulator(scenario, tmp_path)

The suites of tests, such as `SimulatorContract`, need the package pytest.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
