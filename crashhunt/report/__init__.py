"""Reports: what people are told."""

from crashhunt.report._compare import comparison_page, describe_comparison
from crashhunt.report._page import report_data, write_report
from crashhunt.report._screen import Watcher, format_arguments, format_seconds
from crashhunt.report._show import Story
from crashhunt.report._summary import describe_hunt, describe_replay
from crashhunt.report._table import check_fields, format_table, steps_table

__all__ = [
    "Story",
    "Watcher",
    "check_fields",
    "comparison_page",
    "describe_comparison",
    "describe_hunt",
    "describe_replay",
    "format_arguments",
    "format_seconds",
    "format_table",
    "report_data",
    "steps_table",
    "write_report",
]
