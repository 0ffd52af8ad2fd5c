"""Contract suites that run inside a test, with what stands for an agent, a simulator or another plugin."""

from __future__ import annotations

import pytest


def names_of_tests(suite):
    """Return the names of the tests of a contract suite."""
    return [name for name in dir(suite) if name.startswith("test_")]


def run_test(suite, name, fixtures):
    """Run a test of a contract suite with those of the given fixtures that it takes."""
    method = getattr(suite(), name)
    code = method.__func__.__code__
    wanted = code.co_varnames[1 : code.co_argcount]
    given = {key: value for key, value in fixtures.items() if key in wanted}
    if "simulator" in wanted:  # as the fixture of the suite does
        given["simulator"] = fixtures["make"]()
    method(**given)
    if "simulator" in wanted:
        given["simulator"].close()


def failing(suite, fixtures):
    """Return the tests of a contract suite that fail with what a function returns as their fixtures."""
    found = set()
    for name in names_of_tests(suite):
        try:
            run_test(suite, name, fixtures())
        except (AssertionError, pytest.fail.Exception):
            found.add(name)
    return found
