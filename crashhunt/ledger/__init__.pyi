from ._file import Row as Row, damaged as damaged
from ._reader import (
    Facts as Facts,
    KindData as KindData,
    Noted as Noted,
    Owner as Owner,
    Turn as Turn,
    UntilRate as UntilRate,
)
from ._writer import Ledger as Ledger, has_begun as has_begun
