from ._bisect import Bisected as Bisected, bisect as bisect
from ._cases import (
    Added as Added,
    Case as Case,
    Expectation as Expectation,
    add_case as add_case,
    find_cases as find_cases,
    known_kinds as known_kinds,
    read_case as read_case,
)
from ._run import (
    CaseReport as CaseReport,
    Got as Got,
    run_cases as run_cases,
    untrusted_case as untrusted_case,
)
