"""The ledger of a hunt: facts about its trials in one SQLite file, with schema, writer and reader."""

from typing import TYPE_CHECKING

from crashhunt.base.doors import offer_lazily

if TYPE_CHECKING:
    from ._facts import (
        CodeVersionsData as CodeVersionsData,
        Facts as Facts,
        HuntOwner as HuntOwner,
        KindData as KindData,
        Noted as Noted,
        RateBounds as RateBounds,
        RunningRate as RunningRate,
        UntilRate as UntilRate,
    )
    from ._reader import Turn as Turn
    from ._schema import Row as Row, damaged as damaged, leave_untouched as leave_untouched
    from ._writer import Ledger as Ledger, has_begun as has_begun

offer_lazily(__name__)
