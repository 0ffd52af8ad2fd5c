"""``crashhunt export``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.cli._common import add_crash, add_json, say
from crashhunt.cli._progress import shown_progress

if TYPE_CHECKING:
    import argparse

    from crashhunt.cli._common import Commands

__all__ = ["add_export"]


def add_export(commands: Commands) -> None:
    """Add the command."""
    export = commands.add_parser(
        "export",
        help="write a crash into one file, for another machine",
        description="Write a crash with its snapshot into one zip file. crashhunt replay, show and report take the "
        "file wherever they take a DIR.",
    )
    add_crash(export)
    export.add_argument("file", metavar="FILE", type=Path, help="the zip file to write")
    add_json(export)
    export.set_defaults(command=_export)


def _export(options: argparse.Namespace, _words: list[str]) -> int:
    from crashhunt.crashes import export_crash, find_bundle

    bundle = find_bundle(options.directory, options.crash)
    with shown_progress(f"writing {options.file}", as_json=options.json) as watch:
        size = export_crash(bundle, options.file, watch=watch)
    say(f"{bundle.id} is in {options.file} ({size / 1e6:.2f} MB)", as_json=options.json)
    if options.json:
        print(json.dumps({"crash": bundle.id, "file": str(options.file), "bytes": size}))
    return 0
