"""Answers of copies of this process, and why there is none."""

from __future__ import annotations

import json
import os
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

from crashhunt.base.signals import describe_death, is_sent_from_outside

if TYPE_CHECKING:
    from crashhunt.base.plain import Plain

__all__ = ["NoAnswer", "explain_silence", "parse_answer", "took_longer"]

_ENDS_S = 1.0  # wall time in which a process whose pipe is closed has ended
_LOOK_EVERY_S = 0.002


@dataclass(frozen=True, slots=True)
class NoAnswer:
    """Why a copy did not answer.

    Args:
        why: a clause without a subject: "was killed by SIGKILL", "raised ValueError: …".
        is_from_outside: whether another process or the system may be the cause, so that another copy may answer.
    """

    why: str
    is_from_outside: bool = False


def parse_answer(received: bytes | bytearray) -> tuple[Plain | None, str, NoAnswer | None]:
    """Return the answer in what was received, what was raised in its place, and why there is no answer.

    Code of the agent may have written to the same pipe.
    """
    try:
        said = json.loads(received)
        found, raised = said.get("answer"), str(said.get("raised", ""))
    except (ValueError, AttributeError):
        return None, "", NoAnswer("sent data that are no answer")
    if not isinstance(found, dict):
        return None, raised, NoAnswer(f"raised {raised}" if raised else "sent data that are no answer")
    return found, raised, None


def took_longer(timeout_s: float) -> NoAnswer:
    """Return why a copy has no answer that was given so much wall time, in s."""
    return NoAnswer(f"took longer than {timeout_s:g} s")


def explain_silence(pid: int) -> NoAnswer:
    """Return why a copy does not answer whose pipe is closed; its process is still to be ended."""
    deadline = time.monotonic() + _ENDS_S
    try:
        while (end := os.waitid(os.P_PID, pid, os.WEXITED | os.WNOWAIT | os.WNOHANG)) is None:
            if time.monotonic() > deadline:
                return NoAnswer("closed its connection to the trial")
            time.sleep(_LOOK_EVERY_S)
    except ChildProcessError:
        return NoAnswer("ended, and code of the agent has taken its exit code")
    exit_code = end.si_status if end.si_code == os.CLD_EXITED else -end.si_status
    return NoAnswer(describe_death(exit_code), is_sent_from_outside(exit_code))
