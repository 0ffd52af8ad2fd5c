"""Agents in C: a step and a start of a program, an echo, against bare pipes; a library that does nothing."""

from __future__ import annotations

import os
import subprocess
import time
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from crashhunt.agents import ProgramAgent

_ECHO = r"""
#include <string.h>
#include <unistd.h>

static char line[1 << 20];

int main(void) {
    for (;;) {
        long size = 0;
        do {
            long got = read(0, line + size, sizeof line - size);
            if (got <= 0) return 0;
            size += got;
        } while (line[size - 1] != '\n');
        const char *answer = line[9] == 'h' ? "{\"type\":\"ready\"}\n"
                             : line[9] == 'r' ? "{\"type\":\"ok\"}\n"
                                              : "{\"type\":\"act\",\"action\":[12.5,0]}\n";
        if (line[9] == 'c' || write(1, answer, strlen(answer)) < 0) return 0;
    }
}
"""
_LIBRARY = r"""
#include "crashhunt_agent.h"
CRASHHUNT_AGENT()
const char *crashhunt_create(const struct crashhunt_setup *setup, void **agent) { return 0; }
const char *crashhunt_reset(void *agent, uint64_t seed) { return 0; }
const char *crashhunt_act(void *agent, const struct crashhunt_observation *observation, double *action) {
    action[0] = 8.0;
    action[1] = 0.0;
    return 0;
}
void crashhunt_destroy(void *agent) {}
"""
_STEPS, _STARTS, _ROUNDS = 2000, 50, 9


class _Simulated:
    """The facts of a simulator that a program receives, with the default observation of a vehicle."""

    step_length_s = 0.1

    def __init__(self) -> None:
        from crashhunt.scenario import ObservationSetup
        from crashhunt.simulators import Kinematics, SpeedAndLaneChange

        kinematics = Kinematics(ObservationSetup())
        self.observation_names = kinematics.features
        self.observation_spaces = {"ego": kinematics.space}
        self.actions = {"ego": SpeedAndLaneChange()}


def measure(folder: Path) -> dict[str, float]:
    """Return the time of a step through pipes alone, and of a step and a start of an agent, in s; the least of nine."""
    from crashhunt.agents import ProgramFactory

    (folder / "echo.c").write_text(_ECHO)
    subprocess.run(["cc", "-O2", "-o", "echo", "echo.c"], cwd=folder, check=True)
    simulator = _Simulated()
    seen = np.random.default_rng(1).uniform(-30, 30, simulator.observation_spaces["ego"].shape).astype(np.float32)
    factory = ProgramFactory(f"exec:{folder}/echo")

    def made() -> ProgramAgent:
        agent = factory.agent("ego", simulator, {}, folder=folder, files={})  # type: ignore[arg-type]
        agent.reset(1)
        return agent

    def start() -> None:
        agent = made()
        agent.act(seen)
        agent.close()

    agent = made()
    agent.act(seen)
    message = f'{{"type":"observe","step":1,"time_s":0.1,"observation":{seen.tolist()}}}\n'.encode()
    bare = subprocess.Popen([f"{folder}/echo"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0)
    assert bare.stdin is not None
    assert bare.stdout is not None
    sent, received = bare.stdin.fileno(), bare.stdout.fileno()

    def exchange() -> None:
        os.write(sent, message)
        os.read(received, 1 << 16)

    try:
        return {
            "pipes_s": _least(exchange, _STEPS), "step_s": _least(lambda: agent.act(seen), _STEPS),
            "start_s": _least(start, _STARTS),
        }  # fmt: skip
    finally:
        agent.close()
        bare.stdin.close()
        bare.wait()


def build_library(folder: Path) -> str:
    """Compile a library that drives at 8 m/s into a folder, and return the locator of the agent."""
    import crashhunt.agents

    (folder / "nothing.c").write_text(_LIBRARY)
    words = ["-O2", "-shared", "-fPIC", f"-I{crashhunt.agents.__path__[0]}", "-o", "libnothing.so", "nothing.c"]
    subprocess.run(["cc", *words], cwd=folder, check=True)
    return f"lib:{folder}/libnothing.so"


def _least(call: Callable[[], object], times: int) -> float:
    """Return the time of a call, in s: the least average of several rounds."""
    found = []
    for _ in range(_ROUNDS):
        begin = time.perf_counter()
        for _ in range(times):
            call()
        found.append((time.perf_counter() - begin) / times)
    return min(found)
