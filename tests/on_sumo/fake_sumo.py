"""Stands for libsumo's extension module: answers what a test says, and notes what is commanded."""

from __future__ import annotations

import libsumo


class FakeSumo:
    """Answers each getter with a value, or with what a function of its arguments returns.

    Args:
        answers: values or functions by the name of the getter, such as ``vehicle_getSpeed``.
    """

    def __init__(self, **answers):
        self.answers = answers
        self.calls = []  # of setters, each with its arguments

    def __getattr__(self, name):
        if name.startswith("__"):
            raise AttributeError(name)

        def call(*given):
            what = name.partition("_")[2]
            if not what.startswith(("get", "is", "convert")):
                self.calls.append((what, *given))
            if name not in self.answers:
                if what.startswith(("get", "is", "convert")):
                    raise AssertionError(f"the test has no answer of {name}")
                return None
            answer = self.answers[name]
            return answer(*given) if callable(answer) else answer

        return call

    def taken(self):
        """Return the commands since the last look."""
        found, self.calls[:] = list(self.calls), []
        return found


def gone(*_):
    """Raise what libsumo raises for an actor that has left."""
    raise libsumo.TraCIException("not known")
