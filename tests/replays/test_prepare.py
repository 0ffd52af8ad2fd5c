"""Whose crashhunt a replay runs: that of the snapshot or the current one."""

from __future__ import annotations

from types import SimpleNamespace

from crashhunt.base import layout
from crashhunt.replays._prepare import is_current_code


def rerun(sizes, code=("code",)):
    files = {name: {"size": size} for name, size in sizes.items()}
    return SimpleNamespace(worker=SimpleNamespace(code=code), snapshot=SimpleNamespace(manifest={"files": files}))


def test_code_is_current_where_every_file_of_the_executors_has_its_size():
    name = f"code/{layout.PACKAGE.name}/executors/"
    sizes = {path.name: path.stat().st_size for path in (layout.PACKAGE / "executors").glob("*.py")}
    same = {f"{name}{file}": size for file, size in sizes.items()}
    assert is_current_code(rerun(same))
    assert is_current_code(rerun({**same, "code/planner.py": 7, "scenario/scenario.toml": 9}))
    assert not is_current_code(rerun({**same, f"{name}_pool.py": sizes["_pool.py"] + 1}))
    assert not is_current_code(rerun({**same, f"{name}_of_an_older_version.py": 9}))
    assert not is_current_code(rerun({"code/planner.py": 7}))
    assert is_current_code(rerun({"code/planner.py": 7}, code=()))  # the hunt kept no code
