"""The reference of the Python interface, generated from signatures and docstrings.

The sources are read and not imported, so that a page is available at once and optional packages need not be installed.
Only functions whose arguments are generated at import are imported and inspected.
"""

from __future__ import annotations

import argparse
import ast
import functools
import importlib
import inspect
import json
import re
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from crashhunt.base.codec import JsonObject
    from crashhunt.report import ListingEntry


_PUBLIC_MODULES = {
    "crashhunt": "",
    "crashhunt.hunts": "HuntReport",
    "crashhunt.results": "HuntResults SuiteResults",
    "crashhunt.crashes": "Bundle",
    "crashhunt.recording": "Recording Divergence",
    "crashhunt.replays": "ReplayReport",
    "crashhunt.statistics": "Comparison HuntFigures",
    "crashhunt.snapshots": "SnapshotOptions",
    "crashhunt.trial": "Outcome TrialSpec TrialResult Collision Escape Failure",
    "crashhunt.space": "",
    "crashhunt.agents": "",
    "crashhunt.world": "Scene Roster Actor Contact Lane Event ClosestApproach outlines_overlap rectangle_gap "
    "time_to_contact closest_approach",
    "crashhunt.scenario": "load_scenario Scenario AgentSetup ObservationSetup Backend Configuration Accelerator",
    "crashhunt.simulators": "Simulator ActionForm FullBraking SpeedAndLaneChange MetaAction SpaceAction Kinematics",
    "crashhunt.oracles": "Oracle Finding SeesMap BringsOutcomes ReportedCollision Overlap OffRoad TooClose",
    "crashhunt.requirements": "parse Requirement Violation",
    "crashhunt.samplers": "",
    "crashhunt.executors": "Executor PoolExecutor FreshProcessExecutor",
    "crashhunt.render": "Action ActionDistribution Bar Contour Curve Curve3D Heatmap Picture Text scope",
    "crashhunt.errors": "",
    "crashhunt.testing": "",
}
"""The modules that users import, and what of each is for them; empty for everything."""

_SECTION = re.compile(r"^(Args|Attributes|Example|Returns|Yields|Raises):$")
_SECTION_TITLES = {name: name for name in ("Attributes", "Returns", "Yields", "Raises")} | {"Args": "Arguments"}
_Definition = ast.ClassDef | ast.FunctionDef


def describe_api() -> str:
    """Return the objects that users import, with signatures and docstrings, as Markdown."""
    return "\n".join(line for module, names in _PUBLIC_MODULES.items() for line in _module(module, names.split()))


def _module(name: str, names: list[str]) -> Iterator[str]:
    yield f"## {name}\n"
    yield from _docstring(ast.get_docstring(_parsed(name)))
    for public in names or sorted(_public_names(name), key=str.lower):
        found = definition(name, public)
        if found is not None:
            yield from _described(f"{name}.{public}", found)
        elif names:
            raise LookupError(f"{name} has no class or function {public}; correct the list in {__file__}")


def _described(name: str, found: _Definition) -> Iterator[str]:
    yield f"### {name}\n"
    if any("called_with" in ast.unparse(decorator) for decorator in found.decorator_list):
        made, text = _signature_and_docstring(name)
    else:
        made = _signature(found) if isinstance(found, ast.FunctionDef) else _constructor(found)
        text = ast.get_docstring(found)
    if made:
        yield f"```python\n{found.name}{made}\n```\n"
    yield from _docstring(text)
    if isinstance(found, ast.ClassDef):
        if not made:
            yield from _attributes(found)
        yield from _methods(found)


def _signature_and_docstring(name: str) -> tuple[str, str | None]:
    """Return the signature and the docstring of an imported function."""
    module, _, attribute = name.rpartition(".")
    function = getattr(importlib.import_module(module), attribute)
    known = inspect.signature(function)
    parts = []
    for parameter in known.parameters.values():
        if parameter.kind is parameter.KEYWORD_ONLY and "*" not in parts:
            parts.append("*")
        default = "" if parameter.default is parameter.empty else f" = {_default_text(parameter.default)}"
        parts.append(f"{parameter.name}: {_type(parameter.annotation)}{default}")
    return f"{_call(parts)} -> {_type(known.return_annotation)}", inspect.getdoc(function)


def _type(annotation: object) -> str:
    said = annotation if isinstance(annotation, str) else inspect.formatannotation(annotation)
    return re.sub(r"\b(collections\.abc|pathlib|typing)\.", "", said)


def _default_text(value: object) -> str:
    """Return a default value as source text; members of an enumeration become their values."""
    return re.sub(r"<\w+\.\w+: ('\w+')>", r"\1", repr(value))


def _attributes(found: ast.ClassDef) -> Iterator[str]:
    """Return the attributes of a protocol, each with the text of the string below it."""
    for item, after in zip(found.body, [*found.body[1:], ast.Pass()], strict=True):
        if isinstance(item, ast.AnnAssign):
            yield f"**`{ast.unparse(item.target)}: {ast.unparse(item.annotation)}`**\n"
            is_text = isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
            yield from _docstring(str(ast.literal_eval(after.value)) if is_text else "")  # type: ignore[attr-defined]


def _methods(found: ast.ClassDef) -> Iterator[str]:
    for method in found.body:
        if isinstance(method, ast.FunctionDef) and not method.name.startswith("_"):
            decorators = {ast.unparse(decorator) for decorator in method.decorator_list}
            if {"property", "cached_property"} & decorators:
                shown = f": {ast.unparse(method.returns)}" if method.returns else ""
            else:
                shown = _signature(method, bound="staticmethod" not in decorators)
            yield f"**`{method.name}{shown}`**\n"
            yield from _docstring(ast.get_docstring(method))


def _constructor(found: ast.ClassDef) -> str:
    """Return the signature of a constructor; empty for protocols, errors and enumerations."""
    for method in found.body:
        if isinstance(method, ast.FunctionDef) and method.name == "__init__":
            return _signature(method, bound=True).removesuffix(" -> None")
    if not any("dataclass" in ast.unparse(decorator) for decorator in found.decorator_list):
        return ""
    fields = [item for item in found.body if isinstance(item, ast.AnnAssign) and not _is_private(item)]
    return _call([f"{ast.unparse(item.target)}: {ast.unparse(item.annotation)}{_default(item)}" for item in fields])


def _is_private(field: ast.AnnAssign) -> bool:
    return ast.unparse(field.target).startswith("_")


def _default(field: ast.AnnAssign) -> str:
    if field.value is None:
        return ""
    said = ast.unparse(field.value)
    made = re.fullmatch(r"field\(default_factory=(\w+)\)", said)
    return f" = {made[1]}()" if made else f" = {said}"


def _signature(function: ast.FunctionDef, *, bound: bool = False) -> str:
    given = function.args
    if bound:
        given = ast.arguments(**{name: getattr(given, name) for name in given._fields} | {"args": given.args[1:]})
    parts = _parameters(given)
    answer = f" -> {ast.unparse(function.returns)}" if function.returns else ""
    return _call(parts) + answer


def _parameters(given: ast.arguments) -> list[str]:
    """Return the parameters of a function as they are written in the source."""
    plain = [*given.posonlyargs, *given.args]
    defaults = [None] * (len(plain) - len(given.defaults)) + list(given.defaults)
    parts = [_parameter(name, default) for name, default in zip(plain, defaults, strict=True)]
    if given.vararg:
        parts.append(f"*{_parameter(given.vararg, None)}")
    elif given.kwonlyargs:
        parts.append("*")
    parts += [_parameter(*pair) for pair in zip(given.kwonlyargs, given.kw_defaults, strict=True)]
    return [*parts, f"**{_parameter(given.kwarg, None)}"] if given.kwarg else parts


def _parameter(name: ast.arg, default: ast.expr | None) -> str:
    said = f"{name.arg}: {ast.unparse(name.annotation)}" if name.annotation else name.arg
    equals = " = " if name.annotation else "="
    return said if default is None else f"{said}{equals}{ast.unparse(default)}"


def _call(parts: list[str]) -> str:
    line = f"({', '.join(parts)})"
    return line if len(line) <= 88 else "(\n" + "".join(f"    {part},\n" for part in parts) + ")"


def as_markdown(docstring: str | None) -> str:
    """Return a docstring in Google's style as Markdown."""
    return "\n".join(_docstring(docstring))


def _docstring(text: str | None) -> Iterator[str]:
    """Return a docstring in Google's style as Markdown: sections become lists, and examples become code."""
    section = ""
    for line in inspect.cleandoc(text or "").splitlines():
        begun = _SECTION.match(line)
        if begun or (section and line and not line.startswith("    ")):
            if section == "Example":
                yield "```\n"
            section = begun[1] if begun else ""
        if begun:
            yield "```python" if section == "Example" else f"*{_SECTION_TITLES[section]}*:\n"
        elif section == "Example":
            yield line[4:]
        elif section:
            yield _item(line)
        else:
            yield line if line.startswith("    ") else _prose(line)
    yield "```\n" if section == "Example" else ""


def _item(line: str) -> str:
    """Return a line of a section: the entry of a name, or a continuation line."""
    named = re.match(r" {4}(\*{0,2}\w+): (.*)", line)
    return f"- `{named[1]}`: {_prose(named[2])}" if named else f"  {_prose(line.strip())}".rstrip()


def _prose(line: str) -> str:
    """Return prose for Markdown; blocks after two colons are already indented, so they need no change."""
    return re.sub(r"``([^`]+)``", r"`\1`", re.sub(r"^::$|:(?=:$)", "", line))


def _public_names(module: str) -> dict[str, tuple[str, str]]:
    """Return the public names of a module, each with the module and the name of its definition.

    A module offers its own names without an underscore, and each imported name that it imports *as* that name.
    """
    found: dict[str, tuple[str, str]] = {}
    for node in ast.walk(_parsed(module)):
        if isinstance(node, ast.ImportFrom):
            origin = f"{module}.{node.module}" if node.level else str(node.module)
            found |= {alias.name: (origin, alias.name) for alias in node.names if alias.asname == alias.name}
        elif isinstance(node, _Definition) and node in _parsed(module).body:
            found[node.name] = module, node.name
    return {name: place for name, place in found.items() if not name.startswith("_")}


def definition(module: str, name: str) -> _Definition | None:
    """Return the definition of a class or function, also if another module defines it; None for other objects."""
    origin, known = _public_names(module).get(name, (module, name))
    if (origin, known) != (module, name):
        return definition(origin, known)
    return next((node for node in _parsed(module).body if isinstance(node, _Definition) and node.name == name), None)


@functools.cache
def _parsed(module: str) -> ast.Module:
    return ast.parse(_file(module).read_text(encoding="utf-8"))


def _file(module: str) -> Path:
    place = Path(__file__).parents[1].joinpath(*module.split(".")[1:])
    return place / "__init__.py" if place.is_dir() else place.with_suffix(".py")


# The reference of ``scenario.toml`` and ``suite.toml``, made from the dataclasses that read them.

_SCENARIO = (
    ("At the top", "crashhunt.scenario", "Scenario"),
    ("[observation]", "crashhunt.scenario", "ObservationSetup"),
    ("[arguments.NAME], [agents.ID.arguments.NAME]", "crashhunt.scenario", "ArgumentSetup"),
    ("[agents.ID]", "crashhunt.scenario", "AgentSetup"),
    ("[sumo]", "crashhunt.sumo._options", "SumoSetup"),
    ("[highway]", "crashhunt.highway._descriptor", "HighwaySetup"),
    ("[gym]", "crashhunt.gym._descriptor", "GymSetup"),
    ("crash, in [gym]", "crashhunt.gym._descriptor", "CrashRule"),
)
# Fields of Scenario that no file has, and the one that represents the tables below.
_NO_KEY = re.compile(r"^- `(?:tables|\w+`: .*not part of (?:the file|it)\b).*\n(?:  .*\n)*", re.MULTILINE)


def describe_keys() -> str:
    """Return all tables and keys of both TOML files, as Markdown."""
    return "\n".join((*_scenario(), *_suite()))


def _scenario() -> Iterator[str]:
    yield "## scenario.toml\n"
    for title, module, name in _SCENARIO:
        yield f"### {title}\n"
        yield _NO_KEY.sub("", _keys(module, name))


def _suite() -> Iterator[str]:
    from crashhunt.plans import hunt_options

    yield "## suite.toml\n"
    yield "`[defaults]` and each `[[hunts]]` have the same keys; what a hunt says itself wins.\n"
    own = _keys("crashhunt.suites", "SuiteEntry").rstrip()
    yield own
    options = [option.line.partition(": ") for option in hunt_options()]
    named = [option for option in options if f"- `{option[0]}`" not in own]
    yield from (f"- `{name}`: {as_markdown(meaning).strip()}" for name, _, meaning in named)


def _keys(module: str, name: str) -> str:
    """Return the keys of a table, without the part of the docstring before them."""
    found = definition(module, name)
    text = as_markdown(ast.get_docstring(found) if found else "")
    _, heading, keys = text.partition("*Arguments*:\n\n")
    if not heading:
        raise LookupError(f"{module}.{name} has a docstring that does not describe its keys")
    return keys.partition("\n*")[0].rstrip() + "\n"


# The reference of the command line, made from its parser: so it cannot be out of date.


def describe_commands(parser: argparse.ArgumentParser) -> str:
    """Return every command with its arguments and options, as Markdown."""
    return "\n".join(line for command, _ in _commands(parser) for line in _command(command))


def _commands(parser: argparse.ArgumentParser) -> Iterator[tuple[argparse.ArgumentParser, str]]:
    """Return the commands that can be run, including the subcommands of commands."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for name, inner in action.choices.items():
                if any(isinstance(below, argparse._SubParsersAction) for below in inner._actions):
                    yield from _commands(inner)
                else:
                    yield inner, name


def _command(command: argparse.ArgumentParser) -> Iterator[str]:
    places = " ".join(_group_of(action) for action in command._actions if not action.option_strings)
    yield f"## {command.prog}\n"
    yield f"`{command.prog}{' ' if places else ''}{places}`\n"
    yield f"{_plain(command.description)}\n"
    for group in command._action_groups:
        actions = [action for action in group._group_actions if action.dest not in ("help", "help_all")]
        if not actions:
            continue
        if group.title not in ("positional arguments", "options"):
            yield f"*{_plain(group.title)}*" + (f": {_plain(group.description)}" if group.description else "") + "\n"
        yield from (f"- `{_option_text(action)}`: {_plain(_expanded(command, action))}" for action in actions)
        yield ""
    if command.epilog:
        yield f"```text\n{command.epilog.strip()}\n```\n"


def _group_of(action: argparse.Action) -> str:
    name = str(action.metavar or action.dest)
    return {"?": f"[{name}]", "+": f"{name} [{name} ...]", "*": f"[{name} ...]"}.get(str(action.nargs), name)


def _option_text(action: argparse.Action) -> str:
    if not action.option_strings:
        return str(action.metavar or action.dest)
    value = ""
    if action.nargs != 0:
        choices = "{" + ",".join(map(str, action.choices)) + "}" if action.choices else action.dest.upper()
        value = f" {action.metavar or choices}"
    return ", ".join(f"{option}{value}" for option in action.option_strings)


def _expanded(command: argparse.ArgumentParser, action: argparse.Action) -> str:
    return (action.help or "") % {**vars(action), "prog": command.prog}


def _plain(text: str | None) -> str:
    """Return a text in which characters with a meaning in Markdown are escaped; ``names`` become code."""
    said = " ".join((text or "").split())
    return re.sub(r"``([^`]+)``|[*<[`]", lambda found: f"`{found[1]}`" if found[1] else f"\\{found[0]}", said)


# The keys of each `--json` output, made from the JSON Schema files that tests compare with all outputs.

_SCHEMA_FOLDER = Path(__file__).parent / "reference" / "schemas"
_MIN_REPEATED_KEYS = 4  # an object with fewer keys is shorter than a reference to it
_MIN_BROKEN_VALUES = 10  # a list with more values may continue in the next line


def describe_json() -> str:
    """Return the keys of the ``--json`` output of each command, as Markdown."""
    return "\n".join(line for file in sorted(_SCHEMA_FOLDER.glob("*.json")) for line in _output(file))


def _output(file: Path) -> Iterator[str]:
    shape = _shape(json.loads(file.read_text(encoding="utf-8")), "", {})
    yield f"`{file.stem.replace('-', ' ', 1)}` ([JSON Schema](schemas/{file.name})):\n"
    yield "```text"
    yield textwrap.fill(shape, 100, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False)
    yield "```\n"


def _shape(schema: JsonObject, key: str, shown: dict[str, str]) -> str:
    """Return the keys of a JSON Schema in one line; empty for a plain value.

    Args:
        schema: the schema of a value.
        key: the key of the value.
        shown: the objects with many keys that were shown, each with its key. Such an object is not shown again.
    """
    if "enum" in schema:
        separator = "|" if len(schema["enum"]) < _MIN_BROKEN_VALUES else " | "
        return separator.join(json.dumps(value) for value in schema["enum"])
    if "anyOf" in schema:
        return "|".join(_shape(option, key, shown) or str(option.get("type", "…")) for option in schema["anyOf"])
    if properties := schema.get("properties"):
        first = shown.setdefault(json.dumps(schema, sort_keys=True), key)
        if first != key and len(properties) >= _MIN_REPEATED_KEYS:
            return f'{{as "{first}"}}'
        required = schema.get("required", ())
        members = [
            (name if name in required else f"{name}?", _shape(properties[name], name, shown)) for name in properties
        ]
        return "{" + ", ".join(f'"{name}": {shape}' if shape else f'"{name}"' for name, shape in members) + "}"
    types = [schema["type"]] if isinstance(schema.get("type"), str) else schema.get("type", [])
    if "array" in types:
        return f"[{_shape(schema.get('items') or {}, key, shown)}]"
    if "object" in types:
        values = schema.get("additionalProperties")
        values = _shape(values, key, shown) if isinstance(values, dict) else ""
        return f"{{…: {values}}}" if values else "{…}"
    return "|".join(types) if "null" in types else ""


# The list of all modules: what each is about, made from what it says first of itself, and its numbers.

_PACKAGE_FOLDER = Path(__file__).parents[1]
_SUBJECTS = {
    ".py": re.compile(r'\A"""(.+?)(?:\n\n|""")', re.DOTALL),
    ".cpp": re.compile(r"\A// (.+?)\n"),
    ".hpp": re.compile(r"\A// (.+?)\n"),
    ".html": re.compile(r"\A(?:<!DOCTYPE html>\n)?<!-- (.+?) -->"),
    ".css": re.compile(r"\A/\* (.+?) \*/"),
    ".js": re.compile(r"\A/\* (.+?) \*/"),
}
"""What a file says first of itself; read as text, since importing everything would take seconds."""
_NUMBERS = re.compile(
    r"^(?P<names>_?[A-Z][A-Z0-9_]*(?:, _?[A-Z][A-Z0-9_]*)*)(?:: Final)? = (?P<values>[-(]?[\d.][^#\n\"'\[{]*?)"
    r"(?:  # (?P<comment>.+))?$",
    re.MULTILINE,
)
"""The limits and other numbers of a module in Python: constants at the beginning of a line."""


def describe_signals() -> str:
    """Return the signals of scenes with actors, as a table in Markdown."""
    from crashhunt.episode import SIGNALS  # it imports NumPy, which the help does not need
    from crashhunt.world import EVENT_WORDS

    rows = [f"| `{name}` | {known.unit} | {known.meaning} |" for name, known in SIGNALS.items()]
    rows += [f"| `{kind}` | | true in the steps with this event: {words[0]} |" for kind, words in EVENT_WORDS.items()]
    return "\n".join(["| signal | unit | meaning |", "| --- | --- | --- |", *rows]) + "\n"


def describe_observations() -> str:
    """Return the parts of observations with their columns and settings, as Markdown."""
    from crashhunt.report import list_observations  # it imports the descriptors of simulators

    return "\n".join(_described_entries(list_observations()))


def describe_actions() -> str:
    """Return the forms of actions with their components, as Markdown."""
    from crashhunt.report import list_actions

    return "\n".join(_described_entries(list_actions()))


def _described_entries(entries: Iterable[ListingEntry]) -> Iterator[str]:
    """Yield a section for each observation or action: its title, its shape, and tables of values and settings."""
    for entry in entries:
        where = entry["locator"] if "shape" in entry else f"`{entry['locator']}`"
        yield f"### {entry['name']}\n\n{_plain(entry['title'])}\n"
        shape = entry.get("shape")
        yield f"{f'Simulators: {where}.' if 'shape' in entry else where}{f' Shape: {tuple(shape)}.' if shape else ''}\n"
        if components := entry.get("components"):
            yield "| column | unit | range | meaning |\n| --- | --- | --- | --- |"
            for one in components:
                limits = one["range"].replace("|", "\\|")
                yield f"| `{one['name']}` | {one['unit']} | {limits} | {_plain(one['help'])} |"
            yield ""
        if entry["arguments"]:
            yield "| setting | unit | range | default | meaning |\n| --- | --- | --- | --- | --- |"
            for given in entry["arguments"]:
                facts = given["unit"], given["range"], given["default"], _plain(given["help"])
                cells = (str(fact).replace("|", "\\|") for fact in facts)
                yield f"| `{given['name']}` | {' | '.join(cells)} |"
            yield ""


def describe_modules() -> str:
    """Return every package with its modules and their numbers, as Markdown."""
    return "\n".join(_lines())


def _lines() -> Iterator[str]:
    yield "## crashhunt\n"
    yield from _members(_PACKAGE_FOLDER)
    for door in sorted(_PACKAGE_FOLDER.rglob("*/__init__.py")):
        folder = door.parent
        yield f"\n## {folder.relative_to(_PACKAGE_FOLDER.parent).as_posix()}\n"
        yield f"{_subject_of(door)}\n"
        yield from _members(folder)


def _members(folder: Path) -> Iterator[str]:
    for file in sorted(folder.iterdir()):
        if file.suffix in _SUBJECTS and file.name != "__init__.py":
            yield f"- `{file.name}`: {_subject_of(file)}"
            for found in _NUMBERS.finditer(file.read_text(encoding="utf-8")) if file.suffix == ".py" else ():
                comment = f": {found['comment']}" if found["comment"] else ""
                yield f"    - `{found['names']}` = {found['values']} in `{file.relative_to(_PACKAGE_FOLDER)}`{comment}"
        elif file.is_dir() and not (file / "__init__.py").exists():  # pages and scripts, which are no package
            yield from (line.replace("- `", f"- `{file.name}/", 1) for line in _members(file))


def _subject_of(file: Path) -> str:
    found = _SUBJECTS[file.suffix].match(file.read_text(encoding="utf-8"))
    if found is None:
        raise LookupError(f"{file} does not begin with a docstring")
    return " ".join(found[1].replace("``", "`").split())
