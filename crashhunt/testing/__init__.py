"""For tests: `assert_survives`, and suites that check the contracts of agents, simulators, samplers and other plugins.

Subclass a suite in a test module, give it its fixture, and let pytest collect it::

    class TestMySimulator(SimulatorContract):
        @pytest.fixture
        def make(self, tmp_path):
            return lambda: MySimulator(scenario, tmp_path)

The suites need pytest.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
