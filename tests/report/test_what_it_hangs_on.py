"""What a judged collision hangs on, in words."""

from __future__ import annotations

import pytest

from crashhunt.crashes import Factor, LeftOut, Why
from crashhunt.report._why import about_why


@pytest.mark.parametrize("drawn", [(), ("unclear", "unclear")])
def test_a_default_is_told_where_other_values_say_nothing(drawn):
    default = Factor("argument", "ego.speed", "default", was=9.0, runs=(LeftOut(5.0, "none"),))
    others = Factor("argument", "ego.speed", "drawn", was=9.0, runs=tuple(LeftOut(6.0, one) for one in drawn))
    assert about_why(Why((default, others), 100), str)[1:] == ["- ego.speed at its default 5: no crash."]
