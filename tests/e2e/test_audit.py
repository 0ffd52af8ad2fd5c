"""A sample of the trials without a crash is run again in fresh processes; a difference is told."""

from __future__ import annotations

import pytest

WORDS = ("run", "h", "2", "6", "20", "--scenario", "toy", "--seed", "4", "--json")


def test_trials_that_are_the_same_are_said_to_be(toy):
    done = toy.crashhunt(*WORDS, "--arg", "speed=5", "--audit", "0.5")
    audit = done.json["audit"]
    assert audit["differences"] == []
    assert 0 < audit["trials"] < 6
    assert f"Audit: {audit['trials']} run again in fresh processes, {audit['trials']} the same to the bit." in done.err
    assert not (toy.folder / "h" / "trials").exists()
    again = toy.crashhunt(*WORDS, "--arg", "speed=5", "--audit", "0.5", "--overwrite").json["audit"]
    assert again == audit  # which are chosen depends on the seed only


def test_a_difference_is_told_with_the_first_step_and_field(toy):
    done = toy.crashhunt(*WORDS, "--agent", "faulty:Remembers", "--audit", "1")
    audit = done.json["audit"]
    assert audit["trials"] == 6
    assert audit["differences"]
    for found in audit["differences"]:
        assert found["step"] <= 3
        assert (found["agent"], found["field"]) == ("ego", "action[target_speed]")
        assert found["recorded"] < found["replayed"]
    others = done.json["steps_total"] - 6 * 20  # of runs that ended otherwise, which are as long
    assert others == 20 * len(audit["differences"])
    first = audit["differences"][0]
    line = f"trial {first['trial']} is another one in a fresh process: at step {first['step']}, action[target_speed]"
    assert line in done.err
    assert f"audit: {line}" in toy.crashhunt("logs", "h").out


def test_nobody_pays_who_does_not_ask(toy):
    assert toy.crashhunt(*WORDS, "--arg", "speed=5").json["audit"] is None


@pytest.mark.parametrize("share", ["-0.1", "1.5", "nan"])
def test_a_share_that_cannot_be_meant_is_refused(toy, share):
    done = toy.crashhunt(*WORDS, f"--audit={share}", expect=2)
    assert f"--audit is {float(share):g}" in done.json["error"]["message"]
