"""The pytest plugin, in which every case of a corpus is a test.

pytest imports this module at every start, so the module imports the rest of crashhunt only when a case runs.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

_CASE_FILE = "crashhunt-case.toml"  # as in crashhunt.base.layout


def pytest_collect_file(file_path: Path, parent: pytest.Collector) -> pytest.Collector | None:
    """Collect a case as a test."""
    return _CaseFile.from_parent(parent, path=file_path) if file_path.name == _CASE_FILE else None


class _CaseFile(pytest.File):
    def collect(self) -> Iterator[pytest.Item]:
        yield _CaseItem.from_parent(self, name=self.path.parent.name)


class _CaseItem(pytest.Item):
    def runtest(self) -> None:
        from crashhunt.corpus import run_cases

        # pytest imports every conftest.py of the folders that it runs, so its user already trusts them.
        (report,) = run_cases([self.path.parent], parallel=1, trusted=True)
        self.user_properties += [("crashhunt_expected", report.expected), ("crashhunt_got", report.got)]
        text = report.describe()
        if not report.ok:
            kept = report.got != "cannot_run"  # otherwise there is no crash to show
            raise _FailedError(f"{text}\n  {_how_to_look(self)}" if kept else text)
        if report.may_be_tightened:
            self.add_report_section("call", "crashhunt", f'{text}\n  {self.path.name} may say: expect = "fixed"')
        elif report.got == "still":
            pytest.xfail(report.line)

    def repr_failure(self, excinfo: pytest.ExceptionInfo[BaseException], style: object = None) -> str:
        """Return the report on a failed case, without a traceback of crashhunt."""
        return str(excinfo.value) if isinstance(excinfo.value, _FailedError) else str(super().repr_failure(excinfo))

    def reportinfo(self) -> tuple[Path, int | None, str]:
        """Return the path and the title of the case."""
        return self.path, None, f"crash {self.name}"


class _FailedError(Exception):
    """The status of a case differs from the expected status."""


def _how_to_look(item: pytest.Item) -> str:
    from crashhunt.base.text import command_line

    case, folder = item.path.parent, item.config.invocation_params.dir
    place = case.relative_to(folder) if case.is_relative_to(folder) else case
    run = command_line("crashhunt", "corpus", "run", place, "--keep", "out")
    return f"look at it: {run} && {command_line('crashhunt', 'show', f'out/{case.name}')}"
