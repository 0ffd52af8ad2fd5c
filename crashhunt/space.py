"""Spaces of arguments, for annotations of an agent's arguments: ``Annotated[float, Argument(...)]``."""

from crashhunt.trial._space import (
    FILLED_BY_NAME as FILLED_BY_NAME,
    Argument as Argument,
    Choice as Choice,
    Constant as Constant,
    Distribution as Distribution,
    Kind as Kind,
    Range as Range,
    Signature as Signature,
    Value as Value,
    describe as describe,
    kind_of as kind_of,
    parse_spec as parse_spec,
    signature_of as signature_of,
    without_folder as without_folder,
)
