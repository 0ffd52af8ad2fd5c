from ._bisection import Bisected as Bisected, bisect as bisect
from ._case_runs import CaseReport as CaseReport, Got as Got, run_cases as run_cases, untrusted_case as untrusted_case
from ._cases import (
    Added as Added,
    Case as Case,
    Expectation as Expectation,
    KnownType as KnownType,
    add_case as add_case,
    cases_of_type as cases_of_type,
    compare_types as compare_types,
    find_cases as find_cases,
    read_case as read_case,
    signature_today as signature_today,
)
