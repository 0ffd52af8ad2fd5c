"""The native calls of a process that died: what it writes itself, and the functions and lines that are found later."""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
import types
from pathlib import Path

import pytest

from crashhunt.executors import _native_stack
from crashhunt.executors._native_stack import split_native_calls

ROOT = Path(__file__).parents[2]
COMPILER = shutil.which("cc")

pytestmark = pytest.mark.skipif(
    COMPILER is None or shutil.which("c++") is None, reason="there is no compiler for C and C++"
)

LINES = r"""
#include <stdlib.h>
static int deeper(volatile int *n) { return *n ? deeper(n) + *n : 0; }
__attribute__((noinline)) static int harm(int kind) {
    volatile int one = 1;
    void (*volatile nothing)(void) = 0;
    if (kind == 0) *(volatile int *)8 = 1;
    if (kind == 1) abort();
    if (kind == 2) return deeper(&one);
    nothing();
    return 1;
}
__attribute__((visibility("default"))) int act(int kind) {
    return harm(kind) + 1;
}
"""
DIES = """
import ctypes, faulthandler, sys
from crashhunt.executors._native_stack import record_native_stack
stack = open(sys.argv[1], "w")
faulthandler.enable(stack)
record_native_stack(stack.fileno())
ctypes.CDLL(sys.argv[2]).act(int(sys.argv[3]))
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with the compiled library of crashhunt, and with two libraries of a user."""
    folder = tmp_path_factory.mktemp("native")
    interface = types.ModuleType("interface")
    interface.BuildHookInterface = object
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "hatchling.builders.hooks.plugin.interface", interface)
        specification = importlib.util.spec_from_file_location("build_core", ROOT / "scripts" / "build_core.py")
        module = importlib.util.module_from_spec(specification)
        specification.loader.exec_module(module)
        with module.build_native_stack(ROOT, folder) as compilation:
            compilation.finish()
    (folder / "lines.c").write_text(LINES, encoding="utf-8")
    for name, word in (("libdebug.so", "-g"), ("libstripped.so", "-s")):
        words = ["-shared", "-fPIC", "-O0", "-fvisibility=hidden", "-o", name, "lines.c"]
        subprocess.run([COMPILER, word, *words], cwd=folder, check=True)
    return folder


def stack_of(folder, library, kind):
    """The stack that a process leaves that dies in a library."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join((str(folder), str(ROOT)))}
    command = [sys.executable, "-c", DIES, str(folder / "stack"), str(folder / library), str(kind)]
    done = subprocess.run(command, env=environment, check=False, capture_output=True)
    assert done.returncode == (-6 if kind == 1 else -11)
    return (folder / "stack").read_text(encoding="utf-8")


@pytest.mark.skipif(shutil.which("addr2line") is None, reason="the binutils are not installed")
@pytest.mark.parametrize(("kind", "line"), [(0, 7), (1, 8), (3, 10)])
def test_function_and_line_of_each_native_call_precede_the_calls_of_python(folder, kind, line):
    native, rest = split_native_calls(stack_of(folder, "libdebug.so", kind))
    source = folder / "lines.c"
    expected = [f'  File "{source}", line {line} in harm', f'  File "{source}", line 14 in act']
    if kind == 3:  # the frame of a function without code cannot be unwound, so only its caller is known
        native = native.replace(f"{expected[1]}\n", "")
        del expected[1]
    assert native.splitlines() == ["Native stack (most recent call first):", *expected, ""]
    assert rest.startswith("Fatal Python error: ")
    assert 'File "<string>", line 7 in <module>' in rest


@pytest.mark.skipif(shutil.which("addr2line") is None, reason="the binutils are not installed")
def test_an_endless_recursion_is_written_although_no_stack_is_left(folder):
    native, rest = split_native_calls(stack_of(folder, "libdebug.so", 2))
    lines = native.splitlines()
    assert set(lines[1:-1]) == {f'  File "{folder / "lines.c"}", line 3 in deeper'}
    assert 20 <= len(lines) <= 40
    assert rest.startswith("Fatal Python error: ")


@pytest.mark.parametrize("tool", [True, False])
def test_without_debug_information_or_tools_the_exported_functions_are_known(folder, monkeypatch, tool):
    stack = stack_of(folder, "libstripped.so", 1)
    if not tool:
        monkeypatch.setattr(_native_stack.shutil, "which", lambda _: None)
    native, _ = split_native_calls(stack)
    assert native.splitlines()[-2] == f'  File "{folder / "libstripped.so"}", line 0 in act'


def test_a_stack_without_native_calls_stays_as_it_is():
    text = "Timeout (0:00:01)!\nThread 0x1 (most recent call first):\n"
    assert split_native_calls(text) == ("", text)
    assert split_native_calls(f"{text}native stack\nend of the native stack\nFatal Python error: Aborted\n") == (
        "",
        text,
    )


def test_the_native_calls_of_a_process_that_was_killed_come_before_its_python_calls(folder):
    stack = stack_of(folder, "libdebug.so", 2)
    native, rest = split_native_calls(f"Timeout (0:00:01)!\n{stack}")
    assert (native, rest) == (split_native_calls(stack)[0], "Timeout (0:00:01)!\n")


def test_names_of_functions_have_neither_parameters_nor_spaces():
    names = {
        "(anonymous namespace)::Planner::plan(std::vector<int> const&)": "Planner::plan",
        "unsigned long read<unsigned long>()": "unsignedlongread<unsignedlong>",
        "": "?",
    }
    assert {name: _native_stack._function(name) for name in names} == names
