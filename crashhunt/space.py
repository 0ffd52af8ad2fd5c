"""Spaces of arguments, for annotations of an agent's arguments: ``Annotated[float, Argument(...)]``."""

from crashhunt.trial._argument_distributions import (
    Argument as Argument,
    Choice as Choice,
    Constant as Constant,
    Distribution as Distribution,
    Kind as Kind,
    Range as Range,
    Value as Value,
    describe as describe,
    kind_of as kind_of,
    parse_spec as parse_spec,
    without_folder as without_folder,
)
from crashhunt.trial._call_signature import (
    FILLED_BY_NAME as FILLED_BY_NAME,
    CallSignature as CallSignature,
    signature_of as signature_of,
)

Signature = CallSignature
"""The name of `CallSignature` in earlier versions."""
