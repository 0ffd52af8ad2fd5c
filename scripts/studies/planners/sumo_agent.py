"""SUMO's own driver as an agent: the baseline."""


class SumoDriver:
    """Leaves every step to SUMO."""

    action = "sumo"

    def reset(self, seed): ...

    def act(self, observation):
        return None
