"""What `scripts/mutate` relies on: tests for every module, and slips that can still be made."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

SCRIPTS = Path(__file__).parents[1] / "scripts" / "tools"


@pytest.fixture(scope="module")
def mutate():
    with pytest.MonkeyPatch.context() as patch:  # once for all tests: it reads the imports of all tests
        patch.syspath_prepend(str(SCRIPTS))
        import mutate

        yield mutate
    for name in ("mutate", "slips", "copies"):
        sys.modules.pop(name, None)


def test_every_module_has_nearest_tests(mutate):
    files = [file for name in mutate.all_packages() for file in mutate.modules_of(name)]
    assert [str(file) for file in files if not mutate.nearest_tests(file)] == []


def test_tests_elsewhere_exist(mutate):
    for name, patterns in mutate._TESTS_ELSEWHERE.items():
        assert (mutate.ROOT / "crashhunt" / name).exists(), name
        for pattern in patterns:
            assert [*(mutate.ROOT / "tests").glob(pattern)], pattern


def test_listed_equivalent_slips_can_be_made(mutate):
    assert mutate.stale_equivalents(mutate.equivalents()) == []


def test_equivalent_slip_of_changed_code_is_stale(mutate):
    gone = {("crashhunt/no_such_module.py", "-a\n+b"): "reason", ("crashhunt/errors.py", "-a\n+b"): "reason"}
    assert mutate.stale_equivalents(gone) == ["crashhunt/errors.py", "crashhunt/no_such_module.py"]


def test_swap_of_elements_on_neighbouring_lines_can_be_listed(mutate, tmp_path, monkeypatch):
    source = "def pair(a, b):\n    return (\n        a + 1,\n        b,\n        a,\n    )\n"
    (tmp_path / "pair.py").write_text(source)
    monkeypatch.setattr(mutate, "ROOT", tmp_path)
    diffs = [slip.diff(source) for slip in mutate.find_slips(source) if "swapped" in slip.what]
    assert diffs[0] == "+        b,\n-        b,"  # the slip begins at the line above
    for diff in diffs:
        assert mutate.stale_equivalents({("pair.py", diff): "reason"}) == []
    assert mutate.stale_equivalents({("pair.py", "+        a,\n-        b,"): "reason"}) == ["pair.py"]


def test_tests_that_start_processes_run_after_those_that_reach_the_line(mutate):
    source = "def double(x):\n    return 2 * x\n"
    target = mutate.Target(package="p", file=Path("crashhunt/p.py"), source=source, tests=())
    target.reached = {"slow": {2}, "fast": {2}, "other": {1}}
    target.seconds = {"slow": 9.0, "fast": 1.0, "other": 0.5, "starts": 0.1, "starts too": 5.0}
    target.forked = {"starts", "starts too"}
    slips = mutate.find_slips(source)
    assert slips
    assert {tuple(target.tests_of(slip)) for slip in slips} == {("fast", "slow", "starts", "starts too")}
    target.reached = {"fast": {2}, "starts": {2}}  # of which one is seen to reach it
    assert target.tests_of(slips[0]) == ["starts", "fast", "starts too"]


def test_what_no_test_should_notice_is_no_slip(mutate):
    source = 'import json\nTEXT = json.dumps({}, indent=1)\nPAIRS = list(zip((), (), strict=True))\n"""1 + 2"""\n'
    assert [slip.what for slip in mutate.find_slips(source) if "becomes" in slip.what] == []
    assert [slip.what for slip in mutate.find_slips('END = name.endswith((".a", ".b"))\n')] == [
        "endswith becomes startswith"
    ]
    for value, found in (("False", ["False becomes True"]), ("0", ["0 becomes 1", "None is returned"]), ("None", [])):
        slips = mutate.find_slips(f"def f():\n    return {value}\n")
        assert sorted(slip.what for slip in slips) == found


def test_a_module_has_the_tests_of_the_innermost_folder_that_is_listed(mutate):
    ray = {path.name for path in mutate.nearest_tests(Path("crashhunt/executors/ray/_bridge.py"))}
    assert "test_ray_bridge.py" in ray
    assert "test_harms.py" not in ray
    (own,) = mutate.nearest_tests(Path("crashhunt/cli/_list.py"))
    assert own == Path("tests/e2e/test_listing.py")


def test_tests_that_import_a_private_module_are_near_wherever_they_lie(mutate):
    found = mutate.nearest_tests(Path("crashhunt/sumo/_surroundings.py"))
    assert {str(path) for path in found} == {
        "tests/on_sumo/test_surroundings.py", "tests/on_sumo/test_sumo_noticed.py"
    }  # fmt: skip
