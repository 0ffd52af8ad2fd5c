"""A mark for tests that need the compiled kernel for highway-env."""

from __future__ import annotations

import pytest

from crashhunt.highway.accelerator import _kernel

needs_kernel = pytest.mark.skipif(
    _kernel.why_not() == "it is not built", reason="the kernel for highway-env is not built"
)
