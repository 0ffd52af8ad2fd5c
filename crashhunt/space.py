"""Spaces of arguments, for annotations of an agent's arguments: ``Annotated[float, Argument(...)]``."""

from crashhunt.trial import _space
from crashhunt.trial._space import *  # noqa: F403 - all of them

__all__ = _space.__all__
