from __future__ import annotations

import errno
import os
import shlex
import subprocess
import sys
import zipfile
from pathlib import Path
from types import SimpleNamespace

import pytest

from crashhunt.base.git import query
from crashhunt.base.plugins import ImportedModules
from crashhunt.snapshots._take import Sources, _cannot_make, _program_files, find_sources


def test_crashhunt_comes_along_without_the_pages_of_its_guide():
    kept = find_sources(ImportedModules.here()).files
    assert {"code/crashhunt/__init__.py", "code/crashhunt/guide/__init__.py", "code/crashhunt/py.typed"} <= set(kept)
    pages = "code/crashhunt/guide/"
    assert not [place for place in kept if place.startswith(pages) and place.endswith(".md")]


def test_in_a_hook_of_another_repository_a_folder_is_still_of_its_own(tmp_path, monkeypatch):
    for name in ("here", "elsewhere"):
        subprocess.run(["git", "init", "-q", str(tmp_path / name)], check=True)
    monkeypatch.setenv("GIT_DIR", str(tmp_path / "elsewhere" / ".git"))
    assert query(tmp_path / "here", "rev-parse", "--absolute-git-dir") == f"{tmp_path}/here/.git\n".encode()


def test_git_is_asked_once_for_each_folder_of_a_project(tmp_path, monkeypatch):
    subprocess.run(["git", "init", "-q", str(tmp_path)], check=True)
    for name in ("driver_one", "driver_two"):
        (tmp_path / f"{name}.py").write_text("")
    monkeypatch.syspath_prepend(tmp_path)
    asked = []

    def counting(folder, *arguments):
        if folder == tmp_path:  # other tests have imported modules from their own folders
            asked.append(arguments[0])
        return query(folder, *arguments)

    monkeypatch.setattr("crashhunt.snapshots._take.query", counting)
    monkeypatch.setattr("crashhunt.base.git.query", counting)
    kept = find_sources(ImportedModules.here([], ["driver_one", "driver_two"])).files
    base = f"code/@{tmp_path.name}"
    assert {f"{base}/driver_one.py", f"{base}/driver_two.py"} <= set(kept)
    assert asked == ["rev-parse", "ls-files"]


def test_a_file_that_takes_the_output_of_the_command_is_no_code(tmp_path):
    """Otherwise, the same command with `> hunt.txt` could not resume its hunt, because the file has grown."""
    (tmp_path / "kept.txt").write_text("")
    earlier = os.dup(2)
    try:
        with (tmp_path / "hunt.txt").open("w") as output:
            os.dup2(output.fileno(), 2)
            found = find_sources(ImportedModules.here(), roots=[tmp_path])
    finally:
        os.dup2(earlier, 2)
        os.close(earlier)
    assert [place for place in found.files if place.endswith(".txt")] == [f"code/@{tmp_path.name}/kept.txt"]


def test_files_of_a_pipeline_and_of_the_command_that_started_this_one_are_its_outputs(tmp_path):
    """A suite starts hunts whose own output goes elsewhere; `tee` writes a file that its reader may also have open."""
    program = "from crashhunt.base.opened_files import output_files as f; import sys; print(*f(), file=sys.stderr)"
    (tmp_path / "read.txt").touch()
    inner = f"{shlex.quote(sys.executable)} -c {shlex.quote(program)} 2> errors.txt | cat | tee -a log.txt > /dev/null"
    with (tmp_path / "suite.txt").open("w") as output:
        subprocess.run(["bash", "-c", f"{inner}; true"], stdout=output, cwd=tmp_path, check=True)
    found = {
        Path(name).name for name in (tmp_path / "errors.txt").read_text().split() if name.startswith(f"{tmp_path}/")
    }
    assert found == {"errors.txt", "log.txt", "suite.txt"}


@pytest.mark.nightly
def test_a_name_that_would_be_folders_elsewhere_is_excluded_and_reported(tmp_path):
    """A snapshot is refused that has one, as it might be unpacked anywhere; a hunt is not, as its project has one."""
    for name in ("unit-x2d\\x2d1.service", "kept.txt"):
        (tmp_path / name).write_text("")
    found = find_sources(ImportedModules.here(), roots=[tmp_path])
    assert f"code/@{tmp_path.name}/kept.txt" in found.files
    assert not [place for place in found.files if "\\" in place]
    (said,) = found.excluded
    assert said.endswith("unit-x2d\\x2d1.service: its name has a backslash, which elsewhere parts folders")


def test_installed_package_with_libraries_next_to_it_is_not_copied(tmp_path, monkeypatch):
    installed = tmp_path / "site-packages"
    for name in ("boxed_world", "plain_world"):
        (installed / name).mkdir(parents=True)
        (installed / name / "__init__.py").write_text("")
    (installed / "boxed_world.libs").mkdir()
    monkeypatch.syspath_prepend(installed)
    kept = find_sources(ImportedModules.here([], ["boxed_world", "plain_world"])).files
    for name in ("boxed_world", "plain_world"):
        monkeypatch.delitem(sys.modules, name)
    assert "code/plain_world/__init__.py" in kept
    assert not [place for place in kept if place.startswith("code/boxed_world")]


def test_package_without_init_is_copied_although_two_entries_of_the_path_lead_to_it(tmp_path, monkeypatch):
    (tmp_path / "spaced_planner").mkdir()
    (tmp_path / "spaced_planner" / "plans.py").write_text("")
    for _ in range(2):  # as a planner that appends its own folder
        monkeypatch.syspath_prepend(tmp_path)
    kept = find_sources(ImportedModules.here([], ["spaced_planner.plans"])).files
    for name in ("spaced_planner", "spaced_planner.plans"):
        monkeypatch.delitem(sys.modules, name)
    assert "code/spaced_planner/plans.py" in kept


def test_zip_file_that_holds_a_module_is_copied_and_imported_from(tmp_path, monkeypatch):
    archive = tmp_path / "drivers.zip"
    with zipfile.ZipFile(archive, "w") as packed:
        for name in ("zipped_driver/__init__.py", "zipped_module.py"):
            packed.writestr(name, "")
    monkeypatch.syspath_prepend(archive)
    found = find_sources(ImportedModules.here([], ["zipped_driver", "zipped_module"]))
    for name in ("zipped_driver", "zipped_module"):
        monkeypatch.delitem(sys.modules, name)
    place = f"code/@{tmp_path.name}/drivers.zip"
    assert found.files[place] == str(archive)
    assert found.paths == ["code", place]
    assert not [kept for kept in found.files if "zipped" in kept]


def test_files_of_programs_and_fmus_have_places_whatever_their_names(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("planner.py", "helper.py", "it's.fmu"):
        Path(name).touch(mode=0o755)
    agents = {name: SimpleNamespace(agent=name) for name in ("exec:./planner.py", "fmu:./it's.fmu")}
    places = _program_files(SimpleNamespace(agents=agents), Sources(), False, tmp_path / "h")
    helper = {str(tmp_path / "helper.py"): "files/program-0/helper.py"}
    assert places == {"./planner.py": "files/program-0/planner.py", **helper, "./it's.fmu": "files/program-1/it's.fmu"}


@pytest.mark.parametrize(
    ("number", "fix"),
    [(errno.EMFILE, "raise the limit on open files (ulimit -n)"), (errno.EFBIG, "raise the limit on the size of a"),
     (errno.ENOSPC, "free some space, make the file readable, or give --no-snapshot")],
)  # fmt: skip
def test_error_of_a_snapshot_names_the_fix_for_its_cause(number, fix):
    assert fix in str(_cannot_make(OSError(number, "why", "code/agent.py"), Path("snapshots")))
