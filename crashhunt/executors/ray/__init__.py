"""Trials on all machines of a Ray cluster; Ray itself is imported in a separate process."""

from typing import TYPE_CHECKING

from crashhunt.base.doors import offer_lazily

if TYPE_CHECKING:
    from ._executor import RayExecutor as RayExecutor

offer_lazily(__name__)
