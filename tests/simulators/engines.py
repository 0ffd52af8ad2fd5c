"""Fixtures that run the tests of the accelerator with its compiled kernel, and with Python code on arrays."""

from __future__ import annotations

import pytest

from crashhunt.accelerator import _kernel


def _use(monkeypatch, name):
    if name == "arrays":
        monkeypatch.setattr(_kernel, "_found", lambda: (None, "a test disabled it"))
    elif _kernel.why_not() == "it is not built":
        pytest.skip("the kernel for highway-env is not built")
    return name


@pytest.fixture(params=["kernel", "arrays"])
def both_engines(request, monkeypatch):
    """Every test runs twice."""
    return _use(monkeypatch, request.param)


@pytest.fixture(params=["kernel", pytest.param("arrays", marks=pytest.mark.nightly)])
def engine(request, monkeypatch):
    """Every test runs with the kernel, and at night also with arrays."""
    return _use(monkeypatch, request.param)
