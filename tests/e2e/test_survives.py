"""A test of somebody's own suite: what it prints can be pasted."""

from __future__ import annotations

import re

import pytest

from crashhunt.errors import CrashhuntError
from crashhunt.testing import assert_survives


def test_what_crashes_fails_and_what_is_printed_can_be_pasted(toy, monkeypatch):
    monkeypatch.chdir(toy.folder)
    words = {"max_steps": 80, "parallel": 1}
    assert_survives("keep-lane", "toy", trials=2, arguments={"speed": "4:6"}, **words)
    with pytest.raises(AssertionError, match="ego drove into leader at step") as raised:
        assert_survives("keep-lane", "toy", trials=3, arguments={"speed": "12.25:14"}, directory="kept", **words)
    shown = re.search(r"crashhunt (show kept --crash \S+)", str(raised.value))
    assert "drove into leader" in toy.crashhunt(*shown[1].split()).out
    (call,) = re.findall(r"^    (assert_survives\(.*\))$", str(raised.value), re.MULTILINE)
    with pytest.raises(AssertionError, match="ego drove into leader at step") as again:
        exec(call, {"assert_survives": assert_survives})
    assert call in str(again.value)
    assert str(again.value).splitlines()[1] == str(raised.value).splitlines()[1]
    with pytest.raises(CrashhuntError, match="not one trial was valid"):
        assert_survives("keep-lane", "toy", trials=1, scenario_arguments={"fail_reset": True}, **words)
