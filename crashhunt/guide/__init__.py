"""The guide: Markdown pages, with parts that are generated from the code when a page is read."""

from crashhunt.guide._pages import (
    SECTIONS as SECTIONS,
    Page as Page,
    completed as completed,
    find_page as find_page,
    for_terminal as for_terminal,
    list_pages as list_pages,
)
from crashhunt.guide._reference import (
    describe_api as describe_api,
    describe_commands as describe_commands,
    describe_json as describe_json,
    describe_keys as describe_keys,
    describe_modules as describe_modules,
)
from crashhunt.guide._search import FoundPage as FoundPage, search_pages as search_pages
