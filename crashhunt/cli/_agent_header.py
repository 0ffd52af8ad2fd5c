"""``crashhunt agent-header``."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

from crashhunt.base import layout

if TYPE_CHECKING:
    from crashhunt.cli._common import CommandOptions, Commands


def add_agent_header(commands: Commands) -> None:
    """Add the command ``agent-header`` to the parser."""
    header = commands.add_parser(
        "agent-header",
        help="print the C header for agents that are shared libraries",
        description="Print crashhunt_agent.h, the C interface of agents that are shared libraries "
        "(--agent lib:./libplanner.so). You may copy the file into your project.",
    )
    header.set_defaults(command=_print_header)


def _print_header(_options: CommandOptions, _words: list[str]) -> int:
    sys.stdout.write((layout.PACKAGE / "agents" / "crashhunt_agent.h").read_text(encoding="utf-8"))
    return 0
