from __future__ import annotations

import math

import numpy as np
import pytest

from crashhunt.recording import AgentChannel, Prologue
from crashhunt.recording._foxglove import MESSAGES, to_ns
from crashhunt.recording.records._agent_records import ArrayForm, message_of


@pytest.mark.parametrize(
    ("dtype", "name"),
    [
        ("<f4", "FloatArray"), ("<f8", "DoubleArray"), ("<i8", "IntArray"), ("|u1", "IntArray"), ("|b1", "IntArray"),
        ("<i4", "IntArray"),
    ],
)  # fmt: skip
def test_arrays_keep_every_bit(dtype, name):
    assert MESSAGES[message_of(dtype)].DESCRIPTOR.full_name == f"crashhunt.{name}"


@pytest.mark.parametrize("dtype", ["<f4", "<f8", "<i8", "<u4", "|i1", "|b1"])
def test_an_array_of_every_type_is_the_same_after_its_message(dtype):
    prologue = Prologue((AgentChannel("ego", dtype, (3,), dtype, (3,)),), 0.1)
    payload = np.array([1, 0, 1], dtype).tobytes()
    name, fields = ArrayForm("observation_dtype").to_message(payload, prologue, 0)
    message = MESSAGES[name].FromString(MESSAGES[name](**fields).SerializeToString())
    assert ArrayForm("observation_dtype").to_payload(message, prologue, 0) == payload


@pytest.mark.parametrize("dtype", ["<f2", "<f16", "<c8", "<U2", "|O8"])
def test_arrays_that_would_lose_some_are_refused(dtype):
    with pytest.raises(TypeError, match="cannot be recorded"):
        message_of(dtype)


def test_the_numbers_on_the_wire_stay_what_they_are():
    """Logs that were written before are read by these."""
    step = MESSAGES["Step"](step=3, time_s=1.0, rewards=[0.5], positions=[1.0, 2.0], headings=[3.0], speeds=[4.0])
    assert [(field.name, field.number) for field in step.DESCRIPTOR.fields] == [
        ("step", 1), ("time_s", 2), ("rewards", 3), ("positions", 4), ("headings", 5), ("speeds", 6),
    ]  # fmt: skip
    assert step.DESCRIPTOR.file.name == "crashhunt/log.proto"
    for kind, fields in (
        (MESSAGES["Text"], ["text"]),
        (MESSAGES["Roster"], ["actors"]),
        (MESSAGES["Heights"], ["heights", "grades"]),
        (MESSAGES["Spines"], ["rows", "points", "coordinates"]),
        (MESSAGES["Metrics"], ["speed", "time_to_collision_s", "gap_m", "required_deceleration"]),
        (MESSAGES["FloatArray"], ["values"]),
    ):
        assert [field.name for field in kind.DESCRIPTOR.fields] == fields
        assert [field.number for field in kind.DESCRIPTOR.fields] == list(range(1, len(fields) + 1))
    assert MESSAGES["Text"](text="ä").SerializeToString() == b"\x0a\x02\xc3\xa4"
    assert MESSAGES["Roster"](actors=[1, 300]).SerializeToString() == b"\x0a\x03\x01\xac\x02"
    assert MESSAGES["IntArray"](values=[-1]).SerializeToString() == b"\x0a\x0a" + b"\xff" * 9 + b"\x01"
    assert MESSAGES["DoubleArray"](values=[1.0]).SerializeToString() == b"\x0a\x08" + bytes(6) + b"\xf0\x3f"
    assert MESSAGES["FloatArray"](values=[1.0]).SerializeToString() == b"\x0a\x04\x00\x00\x80\x3f"


def test_times_of_messages_are_never_negative():
    assert to_ns(1.5) == 1_500_000_000
    assert to_ns(1e-9) == 1
    assert [to_ns(value) for value in (0.0, -1.0, math.nan, math.inf, -math.inf)] == [0] * 5
