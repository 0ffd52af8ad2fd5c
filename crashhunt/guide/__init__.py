"""The guide: pages of Markdown, and those parts of them that are made from the code when somebody reads them."""

from crashhunt.guide._api import describe_api
from crashhunt.guide._commands import describe_commands
from crashhunt.guide._keys import describe_keys
from crashhunt.guide._modules import describe_modules
from crashhunt.guide._pages import SECTIONS, Page, completed, find_page, for_terminal, list_pages, pages_folder

__all__ = [
    "SECTIONS",
    "Page",
    "completed",
    "describe_api",
    "describe_commands",
    "describe_keys",
    "describe_modules",
    "find_page",
    "for_terminal",
    "list_pages",
    "pages_folder",
]
