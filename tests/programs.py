"""The same driver as a program in Python and in C, and as an agent in Python; the program does harm when told."""

from __future__ import annotations

import hashlib
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import crashhunt.agents

COMPILER = shutil.which("cc")
COMPILER_CXX = shutil.which("c++")
HEADER = Path(crashhunt.agents.__path__[0], "crashhunt_agent.h")

DRIVER = """\
class Driver:
    def __init__(self, speed: float = 12.0):
        self.speed = speed

    def reset(self, seed): ...

    def act(self, observation):
        ahead = [float(row[1]) for row in observation[1:] if row[0] and row[1] > 0 and abs(row[2]) < 1.5]
        return (0.0 if ahead and min(ahead) < 12.0 else self.speed), 0
"""

# The first line of a program in Python that needs no packages. What PATH has as `python3` may be a script, as that of
# pyenv is, which takes several times as long as the program; and a path with a space cannot follow "#!".
PYTHON = "#!/usr/bin/env python3\n" if " " in sys.executable else f"#!{sys.executable} -S\n"

# The words of the command line: the harm, and the message at which it is done; none for a driver without harm.
PROGRAM = """\
import json, os, signal, sys, time

kind, when = [*sys.argv[1:], "", ""][:2]
speed, in_trial = 12.0, False


def answer(**message):
    print(json.dumps(message), flush=True)


def harm():
    if kind == "garbage":
        print("thinking", flush=True)
    elif kind == "half":
        os.write(1, b'{"type": "act", "act')
        os._exit(0)
    elif kind == "closes":
        os.close(1)
        time.sleep(100)
    elif kind == "SIGSEGV":
        os.kill(os.getpid(), signal.SIGSEGV)
    elif kind == "exits":
        os._exit(3)
    elif kind == "protocol":
        answer(type="ready", protocol=2)
    elif kind == "format":
        answer(type="ready", format="xml")
    elif kind == "other":
        answer(type="ok")
    elif kind == "without":
        answer(type="act")
    elif kind == "NaN":
        answer(type="act", action=[float("nan"), 0])
    elif kind == "shape":
        answer(type="act", action=[1.0, 0, 5])
    elif kind == "twice":
        os.write(1, b'{"type": "act", "action": [1.0, 0]}\\n' * 2)
    elif kind == "long":
        while True:
            os.write(1, b"x" * 65536)
    elif kind == "flood":
        while True:
            os.write(2, b"x" * 65536)
    elif kind == "late":
        time.sleep(100)
    elif kind == "children":
        import subprocess  # here, because it takes longer to import than the others together

        started = subprocess.Popen(["sleep", "100"], stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
        with open("child", "w") as file:
            file.write(str(started.pid))
        answer(type="act", action=[10.0, 0])
    elif kind == "stays":
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        answer(type="act", action=[10.0, 0])


for line in iter(sys.stdin.readline, ""):
    message = json.loads(line)
    if message["type"] == "hello":
        print("hello", message["agent"], message["arguments"], file=sys.stderr, flush=True)
        in_trial = bool(message["agent"])
        speed = message["arguments"].get("speed", speed)
        kind = message["arguments"].get("kind", kind)
    if in_trial and kind not in ("none", "blind") and message["type"] == when and message.get("step", 3) == 3:
        harm()
    elif message["type"] == "hello":
        answer(type="ready", format="json", arguments={
            "speed": {"range": "8.0:20.0", "unit": "m/s", "default": 12.0}, "kind": {"default": kind},
        }, revision="1.4-3-gabc")
    elif message["type"] == "reset":
        answer(type="ok")
    elif message["type"] == "observe":
        ahead = [row[1] for row in message["observation"][1:] if row[0] and row[1] > 0 and abs(row[2]) < 1.5]
        ahead = [] if kind == "blind" else ahead
        answer(type="act", action=[0.0 if ahead and min(ahead) < 12.0 else speed, 0], panels=None)
    elif kind != "stays":
        break
"""

# The same driver with binary messages.
BINARY = """\
import json, struct, sys
import msgpack

speed = 12.0
line = sys.stdin.buffer.readline()
speed = json.loads(line)["arguments"].get("speed", speed)
kind = [*sys.argv[1:], ""][0]
print(json.dumps({"type": "ready", "format": "msgpack"}), flush=True)
while True:
    (length,) = struct.unpack("<I", sys.stdin.buffer.read(4))
    message = msgpack.unpackb(sys.stdin.buffer.read(length))
    if message["type"] == "close":
        break
    answer = {"type": "ok"}
    if message["type"] == "observe":
        ahead = [row[1] for row in message["observation"][1:] if row[0] and row[1] > 0 and abs(row[2]) < 1.5]
        answer = {"type": "act", "action": [0.0 if ahead and min(ahead) < 12.0 else speed, 0]}
    data = msgpack.packb(answer)
    if message.get("step") == 3 and kind:
        data = {"garbage": bytes([0xc1]), "number": bytes([5])}.get(kind, data)
    frame = struct.pack("<I", len(data)) + data
    if message.get("step") == 3 and kind:
        frame = {"long": struct.pack("<I", 1 << 30), "empty": bytes(4), "half": frame[:9]}.get(kind, frame)
    sys.stdout.buffer.write(frame)
    sys.stdout.buffer.flush()
    if message.get("step") == 3 and kind == "half":
        break
"""

IN_C = r"""
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static char line[1 << 20];

int main(void) {
    double speed = 12.0;
    while (fgets(line, sizeof line, stdin)) {
        if (strstr(line, "\"type\":\"hello\"")) {
            char *found = strstr(line, "\"speed\":");
            if (found) speed = atof(found + 8);
            puts("{\"type\": \"ready\","
                 " \"arguments\": {\"speed\": {\"range\": \"8.0:20.0\", \"unit\": \"m/s\", \"default\": 12.0}}}");
        } else if (strstr(line, "\"type\":\"reset\"")) {
            puts("{\"type\": \"ok\"}");
        } else if (strstr(line, "\"type\":\"observe\"")) {
            char *row = strstr(line, "\"observation\":[[") + 16;
            double nearest = HUGE_VAL;
            while ((row = strchr(row, '['))) {  /* the first row is the vehicle itself */
                double present, x, y;
                if (sscanf(++row, "%lf,%lf,%lf", &present, &x, &y) == 3 && present && x > 0 && fabs(y) < 1.5)
                    nearest = fmin(nearest, x);
            }
            printf("{\"type\": \"act\", \"action\": [%.17g, 0]}\n", nearest < 12.0 ? 0.0 : speed);
        } else {
            return 0;
        }
        fflush(stdout);
    }
    return 0;
}
"""


def write_program(folder: Path, name: str = "planner") -> Path:
    """Write the program in Python into a folder, and return its path."""
    path = folder / name
    path.write_text(f"{PYTHON}{PROGRAM}", encoding="utf-8")
    path.chmod(0o755)
    return path


def write_binary_program(folder: Path, name: str = "binary") -> Path:
    """Write the program with binary messages into a folder, and return its path."""
    path = folder / name
    # As pip starts its scripts: a path with a space cannot follow "#!".
    start = f"#!/bin/sh\n'''exec' {shlex.quote(sys.executable)} \"$0\" \"$@\"\n' '''\n"
    path.write_text(f"{start}{BINARY}", encoding="utf-8")
    path.chmod(0o755)
    return path


def compile_program(folder: Path, name: str = "planner", *, in_cpp: bool = False) -> Path:
    """Compile the program in C, which is also C++, into a folder, and return its path."""
    source = folder / (f"{name}.cpp" if in_cpp else f"{name}.c")
    source.write_text(IN_C, encoding="utf-8")
    compiler = [str(COMPILER_CXX), "-std=c++17"] if in_cpp else [str(COMPILER)]
    return build(source, [*compiler, "-O1", "-o", name, source.name, "-lm"])


def build(source: Path, command: list[str]) -> Path:
    """Run a compiler in the folder of a source, or copy what the same command has made of the same text before.

    The command has ``-o`` before the name of what it makes. All processes of a session share what they have compiled.
    """
    made = source.with_name(command[command.index("-o") + 1])
    text = HEADER.read_bytes() + source.read_bytes()
    key = hashlib.blake2b("\0".join(command).encode() + text, digest_size=16).hexdigest()
    kept = Path(tempfile.gettempdir(), f"compiled-{key}")
    if not kept.exists():
        subprocess.run(command, cwd=source.parent, check=True)
        unfinished = kept.with_name(f"{kept.name}-{os.getpid()}")
        shutil.copy2(made, unfinished)
        unfinished.replace(kept)
    else:
        made.unlink(missing_ok=True)  # a process may have loaded it
        shutil.copy2(kept, made)
    return made
