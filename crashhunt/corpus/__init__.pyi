from ._bisect import Bisected as Bisected, BisectedData as BisectedData, bisect as bisect
from ._case import (
    Case as Case,
    CaseData as CaseData,
    Expectation as Expectation,
    find_cases as find_cases,
    read_case as read_case,
)
from ._known import known_kinds as known_kinds
from ._run import (
    CaseReport as CaseReport,
    Got as Got,
    ReportData as ReportData,
    run_cases as run_cases,
    untrusted_case as untrusted_case,
)
from ._store import Added as Added, add_case as add_case
