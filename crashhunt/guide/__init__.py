"""The guide: Markdown pages, with parts that are generated from the code when a page is read."""

from crashhunt.guide._pages import (
    SECTIONS,
    Page,
    completed,
    find_page,
    for_terminal,
    list_pages,
    pages_folder,
    search_pages,
)
from crashhunt.guide._reference import describe_api, describe_commands, describe_json, describe_keys, describe_modules

__all__ = [
    "SECTIONS",
    "Page",
    "completed",
    "describe_api",
    "describe_commands",
    "describe_json",
    "describe_keys",
    "describe_modules",
    "find_page",
    "for_terminal",
    "list_pages",
    "pages_folder",
    "search_pages",
]
