"""The errors of crashhunt, which users may catch or raise."""

from crashhunt.base import errors as _errors
from crashhunt.base.errors import *  # noqa: F403 - every one of them

__all__ = [name for name in _errors.__all__ if not name.isupper()]  # but no sets of error numbers
