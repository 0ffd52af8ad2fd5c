"""The native calls of a process that died while an agent's shared library ran.

A compiled library writes the addresses when the process dies. Afterwards, ``addr2line`` of the binutils finds function
and line of each call, if it is installed and the agent's library has debug information.
"""

from __future__ import annotations

import ctypes
import faulthandler
import importlib.util
import os
import re
import shutil
import signal
import subprocess
from functools import cache
from pathlib import Path
from typing import Final, TextIO

from crashhunt.base.binaries import is_of_system

_LIBRARY: Final = "_crashhunt_native_stack"  # installed if it could be built; a snapshot of the code does not have it
_INTERFACE = 1
"""Raised whenever a function of the library changes; scripts/build_core.py reads it."""
_BLOCK: Final = re.compile(r"native stack\n(.*?)end of the native stack\n", re.DOTALL)
_SYMBOL_S: Final = 20.0
_CALLERS: Final = ("_ctypes", "libffi")  # parts of Python, which call the agent's library
_PARAMETERS: Final = re.compile(r"\(.*|\[.*")


def record_native_stack(file: int) -> None:
    """Have this process write its native stack to a file when it dies of a signal.

    Does nothing if the compiled library is not installed. Call this function after `faulthandler.enable`, whose output
    then follows.
    """
    library = _load_library()
    if library is not None:
        library.crashhunt_native_stack_write_to(file)


@cache
def _load_library() -> ctypes.CDLL | None:
    found = importlib.util.find_spec(_LIBRARY)
    try:
        library = ctypes.CDLL(str(found.origin)) if found is not None else None
        return library if library is not None and library.crashhunt_native_stack_interface() == _INTERFACE else None
    except (OSError, AttributeError):  # a damaged file, or a foreign library
        return None


def split_native_calls(stack: str) -> tuple[str, str]:
    """Return the native calls of a dead process in the form that Python's calls have, and the rest of its stack."""
    found = _BLOCK.search(stack)
    if found is None:
        return "", stack
    calls = _calls(found[1])
    if found.start() and not calls:  # a process that hung, but not in native code of an agent
        return "", stack[: found.start()]
    lines = [f'  File "{file}", line {line} in {function}\n' for file, line, function in calls]
    native = "".join(["Native stack (most recent call first):\n", *lines, "\n"])
    # A process that hung has written its Python calls before, and writes them again when it is killed.
    return native, stack[: found.start()] or stack[found.end() :]


def _calls(text: str) -> list[tuple[str, int, str]]:
    """Return file, line and function of each call in the agent's libraries, the innermost first; line 0 if unknown."""
    frames: list[tuple[str, str, str]] = []
    for line in text.splitlines():
        path, offset, symbol = ([*line.split("\t"), "", ""])[:3]
        if os.path.basename(path).startswith(_CALLERS):  # noqa: PTH119 - of a text
            break
        if path.startswith(os.sep) and not is_of_system(Path(path)):
            frames.append((path, offset, symbol))
    found: list[tuple[str, int, str]] = []
    for path, offset, symbol in frames:
        found += _sources(path, offset) or [(path, 0, _function(symbol))]
    return found


def _sources(path: str, offset: str) -> list[tuple[str, int, str]]:
    """Return file, line and function of an address, preceded by those of the functions that were inlined there."""
    tool = shutil.which("addr2line")
    if tool is None:
        return []
    try:
        done = subprocess.run(
            [tool, "--exe", path, "--functions", "--demangle", "--inlines", offset], stdin=subprocess.DEVNULL,
            capture_output=True, text=True, errors="replace", timeout=_SYMBOL_S, check=True,
        )  # fmt: skip
    except (OSError, subprocess.SubprocessError):
        return []
    lines, found = done.stdout.splitlines(), []
    for function, place in zip(lines[::2], lines[1::2], strict=False):
        file, _, number = place.partition(" (discriminator")[0].rpartition(":")
        if not number.isdecimal() or file == "??":
            return [] if function == "??" else [(path, 0, _function(function))]
        found.append((file, int(number), _function(function)))
    return found


def _function(name: str) -> str:
    """Return the name of a function without parameters and spaces, as `File … in NAME` has it."""
    short = _PARAMETERS.sub("", name.replace("(anonymous namespace)::", "")).replace(" ", "")
    return short or "?"


_FATAL_SIGNALS = (signal.SIGSEGV, signal.SIGBUS, signal.SIGFPE)


def record_stack(file: TextIO) -> None:
    """Have this process write its Python stack to a file when it dies of a signal, and at each SIGUSR1.

    pygame, which highway-env imports, aborts at fatal signals, so a process would die of SIGABRT instead of SIGSEGV.
    Its handlers are in C, so `signal.getsignal` does not see them. A handler in Python stays.
    """
    faulthandler.disable()
    for number in _FATAL_SIGNALS:
        if signal.getsignal(number) is signal.SIG_DFL:
            signal.signal(number, signal.SIG_DFL)
    faulthandler.enable(file)
    faulthandler.register(signal.SIGUSR1, file)
