"""Facts about binary files, compared with what binutils and the dynamic linker tell."""

from __future__ import annotations

import platform
import re
import shutil
import subprocess
from pathlib import Path
from types import SimpleNamespace

import pytest
from programs import COMPILER

from crashhunt.base import binaries
from crashhunt.base.agent_locators import libraries_folder, library_path, neighbouring_modules
from crashhunt.base.binaries import describe_binary, own_libraries
from crashhunt.snapshots import program_warnings

pytestmark = pytest.mark.skipif(
    COMPILER is None or shutil.which("ldd") is None, reason="no compiler for C, or no dynamic linker"
)


@pytest.fixture
def program(tmp_path):
    (tmp_path / "top.c").write_text("double top(void) { return 7.5; }\n")
    (tmp_path / "main.c").write_text("double top(void);\nint main(void) { return (int)top(); }\n")
    subprocess.run(["cc", "-shared", "-fPIC", "-o", "libtop.so", "top.c"], cwd=tmp_path, check=True)

    def build(*options):
        words = ["-L.", "-ltop", "-Wl,--build-id", f"-Wl,{','.join([*options, '-rpath', str(tmp_path)])}"]
        subprocess.run(["cc", "-o", "main", "main.c", *words], cwd=tmp_path, check=True)
        return tmp_path / "main"

    return build


def test_a_program_is_identified_as_binutils_identifies_it(program):
    file = program("--enable-new-dtags")
    facts = describe_binary(file)
    assert facts["machine"] == platform.machine()
    assert facts["missing"] == []
    assert any(name.startswith("libc.so") for name in facts["system"])
    if shutil.which("dpkg-query"):
        (name,) = [name for name in facts["system"] if name.startswith("libc.so")]
        package, version = facts["packages"][name].split()
        listed = subprocess.run(["dpkg-query", "-L", package], capture_output=True, text=True, check=True).stdout
        assert any(line.endswith(f"/{name}") for line in listed.splitlines())
        status = subprocess.run(["dpkg-query", "-s", package], capture_output=True, text=True, check=True).stdout
        assert f"\nVersion: {version}\n" in status
    if shutil.which("readelf"):
        notes = subprocess.run(["readelf", "-n", file], capture_output=True, text=True, check=True).stdout
        assert facts["build_id"] == re.search(r"Build ID: (\w+)", notes)[1]


def test_libraries_of_the_system_are_excluded_and_fixed_paths_are_reported(program, tmp_path):
    own = {"libtop.so": tmp_path / "libtop.so"}
    assert own_libraries(program("--enable-new-dtags")) == (own, [])
    assert own_libraries(program("--disable-new-dtags")) == (own, ["libtop.so"])


@pytest.mark.parametrize("content", [b"", b"#!/bin/sh\n", b"\x7fELF", b"\x7fELF\x02\x01" + b"\xff" * 90])
def test_other_files_have_no_facts_or_none_that_matter(tmp_path, content):
    file = tmp_path / "file"
    file.write_bytes(content)
    assert own_libraries(file) == ({}, [])
    assert (describe_binary(file) or {"build_id": ""})["build_id"] == ""


def test_program_of_the_system_has_no_libraries_of_its_own():
    assert own_libraries(Path(shutil.which("sh") or "").resolve()) == ({}, [])


def test_programs_that_cannot_run_here_are_reported_in_one_line_each(program, tmp_path):
    file = program("--enable-new-dtags")
    copies = {"./main": str(file)}
    recorded = {}
    snapshot = SimpleNamespace(argument_files=copies, environment={"programs": recorded})
    assert program_warnings(snapshot, ["exec:./main", "lib:./it's.so", "crashhunt.agents:RandomAgent"]) == []
    for name, package in describe_binary(file).get("packages", {}).items():
        recorded["./main"] = {"packages": {name: "libc 1"}}
        assert program_warnings(snapshot, ["exec:./main"]) == [f"the library {name} was of libc 1 and is of {package}"]
    recorded.clear()
    (tmp_path / "libtop.so").unlink()
    assert program_warnings(snapshot, ["exec:./main"]) == [
        "the program ./main needs the library libtop.so, which this machine lacks"
    ]
    copies["/x/libtop.so"] = f"/snapshot/{libraries_folder('exec:./main')}/libtop.so"
    assert program_warnings(snapshot, ["exec:./main"]) == []
    assert Path(library_path("exec:./main --mode test", copies)).parent == Path("/snapshot")
    assert library_path("exec:./other", copies) == ""
    data = bytearray(file.read_bytes())
    data[18] = 183 if platform.machine() != "aarch64" else 62
    file.write_bytes(data)
    (warning,) = program_warnings(snapshot, ["exec:./main"])
    assert re.fullmatch(r"the program \./main is for \w+, and this machine is \w+, so it cannot run", warning)


LIBC = "/lib/x86_64-linux-gnu/libc.so.6"


@pytest.mark.parametrize(
    ("manager", "answers", "found"),
    [
        ("rpm", {LIBC: ["glibc 2.34-1"], "/opt/libtop.so": []}, {LIBC: "glibc 2.34-1"}),
        (
            "dpkg-query",
            {
                "--search": [f"libc6:i386, libc6:amd64: {LIBC}", "diversion by base from: /x", "other: /elsewhere"],
                "--show": ["libc6:i386\t2.36-9", "no version"],
            },
            {LIBC: "libc6:i386 2.36-9"},
        ),
        ("none", {}, {}),
    ],
)
def test_package_manager_names_the_packages_that_it_knows(monkeypatch, manager, answers, found):
    monkeypatch.setattr(binaries.shutil, "which", lambda name: name if name == manager else None)
    asked = {"rpm": -1, "dpkg-query": 1}.get(manager)
    monkeypatch.setattr(binaries, "_lines", lambda *command: answers[command[asked]])
    assert binaries._packages.__wrapped__((LIBC, "/opt/libtop.so")) == found


@pytest.mark.parametrize(
    ("name", "line", "is_python"),
    [
        ("drive.py", "", True), ("drive", "#!/usr/bin/env python3", True), ("drive", "#!/bin/sh", False),
        ("drive", "python", False), ("drive.sh", "#!/bin/sh", False),
    ],
)  # fmt: skip
def test_modules_next_to_a_python_program_are_its_own(tmp_path, name, line, is_python):
    files = [name, "helper.py", "plan/__init__.py", "plan/deep/costs.py", "data/table.csv", "loose/no_package.py"]
    for path in (tmp_path / file for file in files):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"{line}\n")
    modules = {file: tmp_path / file for file in ("helper.py", "plan/__init__.py", "plan/deep/costs.py")}
    assert neighbouring_modules(tmp_path / name) == (modules if is_python else {})
    assert neighbouring_modules(tmp_path / "missing") == {}
