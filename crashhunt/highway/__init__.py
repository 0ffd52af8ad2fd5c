"""highway-env: the simulator, the description of its table in a scenario, and its accelerator."""

from typing import TYPE_CHECKING

from crashhunt.base.doors import offer_lazily

if TYPE_CHECKING:
    from ._config import restore_classes as restore_classes
    from ._simulator import HighwaySimulator as HighwaySimulator

offer_lazily(__name__)
