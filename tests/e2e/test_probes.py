"""Hunts that ask copies of their trials how little it would take, on the toy."""

from __future__ import annotations

import sys

import pytest

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="forks need Linux")


def test_how_often_has_to_be_a_time(shell):
    for text in ("0", "often"):
        done = shell.crashhunt("run", "h", "1", "3", "60", f"--probe={text}", expect=2)
        assert done.err == f"crashhunt: --probe is {text}; give a time above 0, such as 4s, or omit the option\n"
