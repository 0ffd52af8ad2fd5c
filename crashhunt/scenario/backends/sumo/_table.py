"""The table ``[sumo]``."""

from __future__ import annotations

from dataclasses import dataclass, field

__all__ = ["SumoSetup"]


@dataclass(frozen=True, kw_only=True)
class SumoSetup:
    """``[sumo]``: files, relative to the scenario's folder, and further options of SUMO.

    Args:
        net: the network.
        routes: route files.
        additional: additional files.
        options: further options of SUMO without their dashes, such as ``lateral-resolution``. Where there is no
            ``time-to-teleport``, it is -1: nobody is taken away, and a jam stays one. What they would have SUMO write
            is not written.
        native: whether the compiled core may be used; it changes no bit.
        fix_link_order: whether SUMO processes the links of the network in the order of their construction when it loads
            it; otherwise in the order of their memory addresses, which differs between processes.
        literal: whether ``${NAME}`` in a route or additional file is left as it is, instead of being filled in.
    """

    net: str
    routes: tuple[str, ...] = ()
    additional: tuple[str, ...] = ()
    options: dict[str, bool | int | float | str] = field(default_factory=dict)
    literal: bool | None = None
    native: bool | None = None
    fix_link_order: bool | None = None
