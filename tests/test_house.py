"""The house rules that no linter knows; import-linter sees to the floors (see pyproject.toml)."""

from __future__ import annotations

import ast
import functools
import gc
import graphlib
import re
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import pytest

import crashhunt
from crashhunt.recording import Tag
from crashhunt.recording.records import RECORD_TYPES

if TYPE_CHECKING:
    from collections.abc import Iterator

ROOT = Path(crashhunt.__file__).parent
Node = TypeVar("Node", bound=ast.AST)


@functools.cache  # several rules read every file, and each is about few kinds of its half a million nodes
def kinds_of(file: Path) -> dict[type[ast.AST], list[Any]]:
    """All of what a file says, by kind."""
    kinds: dict[type[ast.AST], list[Any]] = {}
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        kinds.setdefault(type(node), []).append(node)
    return kinds


def nodes_of(file: Path, kind: type[Node]) -> list[Node]:
    """What of one kind a file says."""
    return kinds_of(file).get(kind, [])


@pytest.fixture(scope="module", autouse=True)
def _forget() -> Iterator[None]:
    gc.disable()  # half a million nodes that all stay: to look through them again and again doubles the time
    yield
    kinds_of.cache_clear()
    names_simulator.cache_clear()
    gc.enable()


def private_imports(file: Path) -> list[str]:
    """The private modules and names that a file imports from outside its own package."""
    package = file.relative_to(ROOT).parts[0]
    found = []
    for node in nodes_of(file, ast.ImportFrom):
        if node.module is None or not node.module.startswith("crashhunt."):
            continue
        _, *parts = node.module.split(".")
        names = [alias.name for alias in node.names if alias.name.startswith("_") and not alias.name.startswith("__")]
        if parts[0] != package and (names or any(part.startswith("_") for part in parts)):
            found.append(f"{file.relative_to(ROOT)}:{node.lineno} imports {node.module} {names}")
    return found


def test_nothing_private_is_imported_from_outside_its_package():
    # `crashhunt.errors` and `crashhunt.space` are names under which users import what lies in a package.
    files = [file for file in ROOT.rglob("*.py") if file.name not in ("errors.py", "space.py")]
    assert [line for file in files for line in private_imports(file)] == []


# What other libraries have in one version and not in another, or in one of their classes.
_OTHERS = ("recording/_foxglove.py", "agents/_policies.py", "highway/")


def asked_by_name(file: Path) -> list[str]:
    """Where a file asks whether something has an attribute, by a name that no type checker sees."""
    found = []
    for node in nodes_of(file, ast.Call):
        if not isinstance(node.func, ast.Name) or len(node.args) < 2:
            continue
        name = node.args[1].value if isinstance(node.args[1], ast.Constant) else None
        if node.func.id in ("getattr", "hasattr") and isinstance(name, str) and not name.startswith("__"):
            found.append(f"{file.relative_to(ROOT)}:{node.lineno} asks for {name!r}")
    return found


def test_optional_faculties_are_protocols():
    """Of simulators and agents see their ``_protocol.py``, and `crashhunt.base.foreign_code`."""
    files = [file for file in ROOT.rglob("*.py") if not str(file.relative_to(ROOT)).startswith(_OTHERS)]
    assert [line for file in files for line in asked_by_name(file)] == []


SIMULATORS = re.compile("sumo|highway|gym(?!nasium)", re.IGNORECASE)  # gymnasium is the library of spaces
HOMES = (
    "gym/",
    "highway/",
    "sumo/",
)
NAMED_ALL_THE_SAME = {
    "scenario/_action_forms.py": "has the name of a form of actions, and says to people what forms mean",
    "scenario/_scenario.py": "knows where the descriptor of each is",
    "__init__.py": "tells Gymnasium of crashhunt/SUMO-v0, which is an id that people write",
    "envs/": "is that environment, which is SUMO and nothing else",
    "base/plugins.py": "knows the names under which dependencies that are not installed are imported",
    "cli/__init__.py": "has an example for people",
    "cli/_init.py": "says to people which maps it takes",
    "cli/_replay.py": "says to people what an option is for",
    "guide/": "has the names of pages",
    "native/": "is compiled for libsumo, and finds its functions by name",
    "plans/_run_options.py": "says to people what an option is for",
    "testing/r157.py": "has an option for people",
}


def simulators_named(file: Path) -> list[str]:
    """The simulators that the code of a file names; what is there for people to read is not code."""
    prose = {id(node.value) for node in nodes_of(file, ast.Expr)}
    found = []
    for kind, nodes in kinds_of(file).items():
        said = [(node, getattr(node, field, None)) for field in kind._fields for node in nodes]
        found += [
            (node.lineno, text)
            for node, text in said
            if isinstance(text, str) and names_simulator(text) and id(node) not in prose
        ]
    return [f"{line}: {text}" for line, text in sorted(found)]


@functools.cache  # few words are said again and again
def names_simulator(text: str) -> bool:
    return SIMULATORS.search(text) is not None


def test_simulators_are_named_in_their_own_homes_only():
    named: dict[str, list[str]] = {}
    for file in sorted(ROOT.rglob("*.py")):
        name = file.relative_to(ROOT).as_posix()
        if not name.startswith(HOMES) and (found := simulators_named(file)):
            named[name] = found
    excused = {name: reason for name in named for reason in NAMED_ALL_THE_SAME if name.startswith(reason)}
    assert {name: found for name, found in named.items() if name not in excused} == {}
    assert set(excused.values()) == set(NAMED_ALL_THE_SAME), "what names none needs no excuse"


def test_a_simulator_that_is_named_in_code_is_found(tmp_path):
    (tmp_path / "m.py").write_text(
        '"""SUMO."""\nimport gymnasium\nif x.sumo:\n    """highway"""\n    f(gym=1, y="a sumo")\n'
    )
    assert [line.partition(":")[0] for line in simulators_named(tmp_path / "m.py")] == ["3", "5", "5"]


def test_a_command_imports_no_library_before_it_knows_that_it_needs_one():
    # A slip costs every command a quarter of a second.
    heavy = "{'numpy', 'gymnasium', 'libsumo', 'mcap', 'pydantic', 'rich', 'PIL', 'sqlite3', 'subprocess'}"
    subprocess.run(
        [sys.executable, "-c", f"import sys, crashhunt.cli; assert not {heavy} & {{*sys.modules}}"], check=True
    )


def test_no_module_is_longer_than_eight_hundred_lines():
    lengths = {file.relative_to(ROOT).as_posix(): len(file.read_text().splitlines()) for file in ROOT.rglob("*.py")}
    assert {name: lines for name, lines in lengths.items() if lines > 800} == {}


def test_there_is_one_conftest():
    # Tests import from it, and a second one would be found in its place, or not, by the order of collection.
    tests = Path(__file__).parent
    assert [*tests.rglob("conftest.py")] == [tests / "conftest.py"]


def test_test_files_have_names_of_their_own():
    # pytest imports two of the same name as one module, and collects neither.
    names = [file.name for file in Path(__file__).parent.rglob("test_*.py")]
    assert sorted(set(names)) == sorted(names)


def uses_of_any(file: Path) -> int:
    """How often a file says `Any`: wherever it is imported, in annotations, and in those that are text."""
    named = sum(node.id == "Any" for node in nodes_of(file, ast.Name))
    imported = sum(node.name == "Any" for node in nodes_of(file, ast.alias))
    texts = [node.value for node in nodes_of(file, ast.Constant) if isinstance(node.value, str)]
    return (
        named + imported + sum(len(re.findall(r"\bAny\b", text)) for text in texts if re.search(r"\[.*\bAny\b", text))
    )


def test_any_is_rare():
    """Of Python's own functions `json.loads` returns it; what it is has a `TypedDict`, so that keys are checked."""
    files = list(ROOT.rglob("*.py"))
    lines = sum(len(file.read_text(encoding="utf-8").splitlines()) for file in files)
    assert sum(map(uses_of_any, files)) / lines * 1000 <= 6


def test_every_use_of_any_is_counted(tmp_path):
    file = tmp_path / "example.py"
    file.write_text('from typing import Any\n"""Any text."""\nx: Any = 1\ny: "dict[str, Any]" = {}\n')
    assert uses_of_any(file) == 3


def test_the_tags_are_those_of_the_types_of_records():
    assert {tag.value for tag in Tag} == RECORD_TYPES.keys()


def modules() -> dict[str, Path]:
    """Every module of crashhunt by its name."""
    named = {
        ".".join(("crashhunt", *file.relative_to(ROOT).with_suffix("").parts)): file for file in files_of_crashhunt()
    }
    return {name.removesuffix(".__init__"): file for name, file in named.items()}


def files_of_crashhunt() -> list[Path]:
    return [file for file in sorted(ROOT.rglob("*.py")) if "__pycache__" not in file.parts]


def names_behind_doors() -> dict[tuple[str, str], tuple[str, str]]:
    """For each name that a package offers, the module that it comes from: doors import lazily."""
    found = {}
    for door in ROOT.rglob("__init__.py"):
        package = ".".join(("crashhunt", *door.parent.relative_to(ROOT).parts))
        for node in nodes_of(door, ast.ImportFrom):
            if node.level:
                for alias in node.names:
                    found[package, alias.name] = (f"{package}.{node.module}", alias.name)
    return found


def imports_of_modules() -> dict[str, set[str]]:
    """The modules that each module imports names from, those for type checking only among them."""
    known, doors = modules(), names_behind_doors()
    graph: dict[str, set[str]] = {}
    for name, file in known.items():
        graph[name] = set()
        for node in nodes_of(file, ast.ImportFrom):
            if (node.module or "").startswith("crashhunt"):
                for alias in node.names:
                    place = (str(node.module), alias.name)
                    while place in doors:
                        place = doors[place]
                    target = ".".join(place) if ".".join(place) in known else place[0]
                    graph[name] |= {target} & known.keys() - {name}
    return graph


def test_no_modules_import_each_other_in_a_circle():
    graph = imports_of_modules()
    assert sum(map(len, graph.values())) > 1000
    try:
        graphlib.TopologicalSorter(graph).prepare()
    except graphlib.CycleError as error:
        pytest.fail(" -> ".join(error.args[1]))


def test_objects_with_many_fields_are_made_by_keywords():
    """A fourth positional argument is where a reader, and a swap of two fields, goes astray."""
    made = [node for file in files_of_crashhunt() for node in nodes_of(file, ast.ClassDef)]
    classes = {node.name for node in made if is_dataclass(node)} - {
        node.name for node in made if not is_dataclass(node)
    }
    assert len(classes) > 150
    found = [
        f"{file.relative_to(ROOT)}:{node.lineno}"
        for file in files_of_crashhunt()
        for node in nodes_of(file, ast.Call)
        if isinstance(node.func, ast.Name)
        and node.func.id in classes
        and len(node.args) > 3
        and not any(isinstance(argument, ast.Starred) for argument in node.args)
    ]
    assert found == []


def is_dataclass(node: ast.ClassDef) -> bool:
    return any("dataclass" in ast.unparse(one) for one in node.decorator_list)


ROLES = frozenset({"_descriptor", "_disturbances", "_protocol", "_scripted", "_simulator", "_surroundings", "errors"})
"""Names of files that several packages have, because a file has the same role in each."""


def test_a_file_name_stands_once():
    """The second file of a name is what a first guess misses."""
    names = Counter(file.stem for file in ROOT.rglob("*.py") if not file.stem.startswith("__"))
    assert {name for name, count in names.items() if count > 1} <= ROLES


def test_a_public_class_name_stands_once():
    """But for the same role in two adapters of simulators, and for the types of what the compiled core returns."""
    files = [file for file in ROOT.rglob("*.py") if file.relative_to(ROOT).parts[0] not in ("highway", "native")]
    classes = Counter(node.name for file in files for node in nodes_of(file, ast.ClassDef))
    assert [name for name, count in classes.items() if count > 1 and name[0] != "_"] == []


def test_private_modules_that_comments_and_pages_name_are_there():
    files = [
        ROOT.parent / "pyproject.toml",
        *(file for kind in ("py", "md", "*pp") for file in ROOT.rglob(f"*.{kind}")),
    ]
    stale = []
    for file in files:
        text = file.read_text()
        paths = re.findall(r"(?<![\w./])(?:crashhunt/)?((?:\w+/)+_\w+\.\w+)", text)
        modules = re.findall(r"\bcrashhunt\.((?:[a-z]\w*\.)*_[a-z]\w*)", text)
        for name in [*paths, *(f"{name.replace('.', '/')}.py" for name in modules)]:
            place = ROOT / name
            is_there = place.exists() or place.with_suffix("").is_dir() or place.parent.with_suffix(".py").exists()
            stale += [] if is_there or "NAME" in name else [f"{file.relative_to(ROOT.parent)}: {name}"]
    assert stale == []
