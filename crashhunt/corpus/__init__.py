"""A corpus: crashes that users keep in their own repository as regression tests."""

from typing import TYPE_CHECKING

from crashhunt.base.doors import offer_lazily

if TYPE_CHECKING:
    from ._bisection import Bisected as Bisected, bisect as bisect
    from ._case_runs import (
        CaseReport as CaseReport,
        Got as Got,
        run_cases as run_cases,
        untrusted_case as untrusted_case,
    )
    from ._cases import (
        Added as Added,
        Case as Case,
        KnownType as KnownType,
        add_case as add_case,
        compare_types as compare_types,
        find_cases as find_cases,
        read_case as read_case,
    )

offer_lazily(__name__)
