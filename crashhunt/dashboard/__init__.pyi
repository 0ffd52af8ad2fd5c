from ._server import Address as Address, has_dashboard as has_dashboard, serve as serve
