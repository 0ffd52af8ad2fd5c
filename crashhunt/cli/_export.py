"""``crashhunt export``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from crashhunt.base.errors import UsageError
from crashhunt.base.text import command_line
from crashhunt.cli._common import CommandOptions, Commands, add_crash, add_json, opened_crash, shown_progress

if TYPE_CHECKING:
    from collections.abc import Callable


_FORMATS = {"commonroad": ".xml", "openscenario": ".xosc"}
_WRITTEN_BY = {
    **{suffix: f"add --as {form}" for form, suffix in _FORMATS.items()},
    ".gif": "use crashhunt replay --gif FILE",
    ".html": "use crashhunt report --output FILE",
    ".mcap": "copy the crash's log.mcap",
    ".mp4": "use crashhunt replay --video FILE",
}
"""What writes a file whose name ends like this."""


def add_export(commands: Commands) -> None:
    """Add the command ``export`` to the parser."""
    export = commands.add_parser(
        "export",
        help="write a crash into one file, for another machine or another tool",
        description="Write a crash with its snapshot into one zip file. crashhunt replay, show and report accept the "
        "file in place of a DIR. With --as, write the recorded crash as a scenario for other tools.",
    )
    add_crash(export)
    export.add_argument(
        "file", metavar="FILE", type=Path, help="the file to write: a zip file, or with --as a file in that format"
    )
    export.add_argument(
        "--as",
        dest="form",
        choices=_FORMATS,
        help="the format of the scenario. commonroad: a CommonRoad 2020a scenario (FILE.xml), in which the agent is a "
        "planning problem; openscenario: an OpenSCENARIO 1.0 scenario (FILE.xosc) with its roads (FILE.xodr), in which "
        "the agent starts as recorded",
    )
    export.add_argument(
        "--recorded-agent",
        action="store_true",
        help="with --as: also write the recorded path of the agent, in commonroad as an obstacle, in openscenario as "
        "the path that the agent follows",
    )
    add_json(export)
    export.set_defaults(command=_export)


def _export(options: CommandOptions, _words: list[str]) -> int:
    if options.form:
        return _convert(options)
    if options.recorded_agent:
        raise UsageError("--recorded-agent has no effect without --as", fix=f"add --as {' or '.join(_FORMATS)}")
    if options.file.suffix in _WRITTEN_BY:
        raise UsageError(
            f"{options.file}: without --as, export writes a zip file",
            fix=f"{_WRITTEN_BY[options.file.suffix]}, or name it {options.file.with_suffix('.zip')}",
        )
    from crashhunt.crashes import export_crash

    with (
        opened_crash(options.directory, options.crash) as (bundle, _),
        shown_progress(f"writing {options.file}", as_json=options.json) as watch,
    ):
        size = export_crash(bundle, options.file, watch=watch)
    text = f"{bundle.id} is in {command_line(options.file)} ({size / 1e6:.2f} MB)"
    options.answer(text, {"crash": bundle.id, "file": str(options.file), "bytes": size})
    return 0


def _convert(options: CommandOptions) -> int:
    from crashhunt.formats import write_commonroad, write_openscenario

    suffix = _FORMATS[options.form]
    if options.file.suffix != suffix:
        raise UsageError(
            f"{options.file}: --as {options.form} writes a {suffix} file",
            fix=f"name it {options.file.with_suffix(suffix) if options.file.name else f'crash{suffix}'}",
        )
    write: Callable[..., Any] = write_openscenario if options.form == "openscenario" else write_commonroad
    with opened_crash(options.directory, options.crash) as (bundle, _):
        actors = write(bundle, options.file, with_agents=options.recorded_agent)
    files = [options.file]
    if options.form == "openscenario":
        files.append(options.file.with_suffix(".xodr"))
    size = sum(file.stat().st_size for file in files)
    names = " and ".join(map(command_line, files))
    text = f"{bundle.id} is in {names} ({size / 1e6:.2f} MB), for {options.form}"
    facts = {"crash": bundle.id, "file": str(options.file), "bytes": size, "as": options.form, "actors": actors}
    options.answer(text, facts)
    return 0
