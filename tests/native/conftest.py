"""A core that was compiled from other sources than those that are tested is told in one line."""

from __future__ import annotations

import importlib
import importlib.util

import pytest

from crashhunt.native import _core


@pytest.fixture(autouse=True, scope="session")
def _fits():
    if importlib.util.find_spec(_core._MODULE) is None:
        return
    built = importlib.import_module(_core._MODULE).INTERFACE
    if built != _core._INTERFACE:
        what = f"the compiled core of this environment is of another version ({built} instead of {_core._INTERFACE})"
        pytest.fail(f"{what}: build it again with `pip install --no-deps --editable .`", pytrace=False)
