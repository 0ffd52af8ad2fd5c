"""The agent of test_usual_steps.py, in a module of its own: what fails in the module of an agent is its fault."""

from __future__ import annotations


class Says:
    """An agent that answers what a function of the step and of what it is shown says."""

    def __init__(self, answer):
        self._answer, self._step = answer, 0

    def reset(self, seed):
        self._step = 0

    def act(self, observation):
        assert not observation.flags.writeable
        self._step += 1
        return self._answer(self._step, observation)
