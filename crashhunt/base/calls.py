"""Calls from Python that cannot be meant: the same clear line as on the command line, not a bare TypeError."""

from __future__ import annotations

import functools
import inspect
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

from crashhunt.base.errors import CallError
from crashhunt.base.names import one_of

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = ["clear_calls"]

P = ParamSpec("P")
R = TypeVar("R")


def clear_calls(*, options_of: Callable[..., Any] | None = None) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Decorate a public function: a keyword that it does not have is a `CallError` that names the likely one.

    Args:
        options_of: the function that receives its ``**options``, whose keywords are its own then.
    """

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        signature = inspect.signature(function)
        known = _keywords(signature) | (_keywords(inspect.signature(options_of)) if options_of is not None else {})

        @functools.wraps(function)
        def call(*args: P.args, **kwargs: P.kwargs) -> R:
            name = function.__name__
            for keyword in kwargs:
                if keyword not in known:
                    fix = one_of(keyword, known, give="it takes", none="no keywords")
                    raise CallError(f"{name}() has no argument {keyword!r}", fix=fix)
            try:
                signature.bind(*args, **kwargs)
            except TypeError as problem:
                raise CallError(f"{name}(): {problem}", fix=f"call {name}{_shown(signature)}") from None
            return function(*args, **kwargs)

        return call

    return decorate


def _keywords(signature: inspect.Signature) -> dict[str, None]:
    kinds = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)
    return dict.fromkeys(name for name, parameter in signature.parameters.items() if parameter.kind in kinds)


def _shown(signature: inspect.Signature) -> str:
    """What has to be given, such as ``(directory, parallel, trials, max_steps, …)``."""
    needed = [
        f"*{name}" if parameter.kind is parameter.VAR_POSITIONAL else name
        for name, parameter in signature.parameters.items()
        if parameter.default is parameter.empty and parameter.kind is not parameter.VAR_KEYWORD
    ]
    more = ", …" if len(needed) < len(signature.parameters) else ""
    return f"({', '.join(needed)}{more})"
