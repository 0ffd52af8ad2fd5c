"""The errors of crashhunt, for whoever catches or raises them."""

from crashhunt.base import errors as _errors
from crashhunt.base.errors import *  # noqa: F403 - every one of them

__all__ = _errors.__all__
