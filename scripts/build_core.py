"""Builds the compiled parts into wheels and editable installations, where that can be done; crashhunt goes without.

They are the compiled core, the kernel for highway-env, the library that fixes the order of SUMO's links, and the
library that writes the native stack of a dying trial. CRASHHUNT_CORE=0 leaves all out; CRASHHUNT_CORE=1, for the wheels
of a release, fails where one of them cannot be built.
"""

from __future__ import annotations

import os
import re
import runpy
import shlex
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

if TYPE_CHECKING:
    from collections.abc import Iterator

# Without contraction every expression rounds as Python's does; sine and cosine are the C library's, each by itself.
FLAGS = ("-std=c++17", "-O2", "-fPIC", "-shared", "-fvisibility=hidden", "-ffp-contract=off",
         "-fno-builtin-sin", "-fno-builtin-cos", "-Wall", "-Wextra")  # fmt: skip
INTERFACE = re.compile(r"^_INTERFACE = (\d+)$", re.MULTILINE)
LINK_ORDER = "_crashhunt_link_order.so"  # a library, not a module, and so of any version of Python
NATIVE_STACK = "_crashhunt_native_stack.so"


class CoreHook(BuildHookInterface):  # type: ignore[type-arg]  # older ones take none
    """Adds the modules ``_crashhunt_core`` and ``_crashhunt_highway`` and two libraries."""

    PLUGIN_NAME = "custom"

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Build it, and say that the wheel is for this Python and machine only."""
        asked = os.environ.get("CRASHHUNT_CORE", "")
        if self.target_name != "wheel" or asked == "0":
            return
        self._folder = Path(tempfile.mkdtemp(prefix="crashhunt-core-"))
        parts = (
            ("compiled core", build),
            ("kernel for highway-env", build_kernel),
            ("fixed order of SUMO's links", build_link_order),
            ("native stacks of dying trials", build_native_stack),
        )
        begun = []
        with ExitStack() as running:
            for what, begin in parts:
                with self._warned(what):
                    begun.append((what, running.enter_context(begin(Path(self.root), self._folder))))
            for what, compilation in begun:
                with self._warned(what):
                    built = compilation.finish()
                    where = "force_include_editable" if version == "editable" else "force_include"
                    build_data[where][str(built)] = built.name
                    build_data["pure_python"] = False
                    build_data["infer_tag"] = True

    @contextmanager
    def _warned(self, what: str) -> Iterator[None]:
        """Return a context in which a part that cannot be built is excluded, with a warning."""
        try:
            yield
        except (OSError, subprocess.SubprocessError, ValueError) as error:
            if os.environ.get("CRASHHUNT_CORE") == "1":
                raise
            self.app.display_warning(f"crashhunt goes without its {what}: {error}")

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Remove what was built."""
        shutil.rmtree(getattr(self, "_folder", ""), ignore_errors=True)


class Compilation:
    """A compiler that runs, while others may run too.

    Args:
        words: the command.
        built: the file that it writes.
    """

    def __init__(self, words: list[str], built: Path) -> None:
        self._built = built
        self._compiler = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        with self._compiler:  # which waits for its end
            self._compiler.kill()

    def finish(self) -> Path:
        """Wait for the end of the compiler; return the file.

        Raises:
            subprocess.SubprocessError: it fails, such as where Python's headers are missing, or takes ten minutes.
        """
        _, said = self._compiler.communicate(timeout=600)
        if self._compiler.returncode:
            raise subprocess.SubprocessError(f"the compiler says: {said.strip()[-2000:]}")
        return self._built


def build(root: Path, folder: Path) -> Compilation:
    """Begin to compile the core into a folder.

    Raises:
        ValueError: it is for Linux and CPython only.
        OSError: there is no compiler.
    """
    return _compile(root / "crashhunt" / "native", "core.cpp", "_core.py", folder / _module("_crashhunt_core"))


def build_kernel(root: Path, folder: Path) -> Compilation:
    """Begin to compile the kernel for highway-env into a folder. Raises as `build` does."""
    source = root / "crashhunt" / "highway" / "accelerator"
    return _compile(source, "kernel.cpp", "_kernel.py", folder / _module("_crashhunt_highway"))


def _module(name: str) -> str:
    """Return the file name of a compiled module for this Python."""
    if sys.implementation.name != "cpython" or sys.byteorder != "little":
        raise ValueError("it is for CPython on Linux")
    return f"{name}{sysconfig.get_config_var('EXT_SUFFIX')}"


def build_link_order(root: Path, folder: Path) -> Compilation:
    """Begin to compile the library that fixes the order of SUMO's links into a folder. Raises as `build` does."""
    return _compile(root / "crashhunt" / "native", "link_order.cpp", "_link_order.py", folder / LINK_ORDER)


def build_native_stack(root: Path, folder: Path) -> Compilation:
    """Begin to compile the library that writes native stacks into a folder. Raises as `build` does."""
    return _compile(root / "crashhunt" / "executors", "native_stack.cpp", "_native_stack.py", folder / NATIVE_STACK)


def _compile(folder: Path, source: str, interface: str, built: Path) -> Compilation:
    if sys.platform != "linux":
        raise ValueError("it is for CPython on Linux")
    compiler = os.environ.get("CXX") or next(filter(None, map(shutil.which, ("c++", "g++", "clang++"))), None)
    if not compiler:
        raise FileNotFoundError("there is no C++ compiler")
    match = INTERFACE.search((folder / interface).read_text())
    if match is None:
        raise ValueError(f"{interface} does not say which interface it has")
    words = [*shlex.split(compiler), *FLAGS, *shlex.split(os.environ.get("CXXFLAGS", ""))]
    build_id = runpy.run_path(str(Path(__file__).parents[1] / "crashhunt" / "native" / "_build_id.py"))["build_id"](
        folder
    )
    words += [f"-DCRASHHUNT_INTERFACE={match[1]}", f"-Wl,--build-id=0x{build_id}"]
    words += [f"-I{sysconfig.get_path('include')}", str(folder / source)]
    return Compilation([*words, "-o", str(built), "-ldl"], built)
