"""The dashboard: a live web page that shows many hunts."""

from typing import TYPE_CHECKING

from crashhunt.base.doors import offer_lazily

if TYPE_CHECKING:
    from ._server import Address as Address, has_dashboard as has_dashboard, serve as serve

offer_lazily(__name__)
