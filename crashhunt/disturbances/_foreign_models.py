"""Foreign disturbance models, which draw in a separate process."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from crashhunt.base.errors import CrashhuntError, PluginError
from crashhunt.base.exceptions import blamed
from crashhunt.base.isolation import ServerApart
from crashhunt.disturbances._disturbance_rates import draw_checked, locate_model
from crashhunt.disturbances._protocol import Drawn

if TYPE_CHECKING:
    from crashhunt.base.json_types import Plain
    from crashhunt.disturbances._protocol import DisturbanceModel


def described_model(name: str) -> str:
    """Create a model in this process, and return its kind.

    Raises:
        CrashhuntError: the model does not exist, or cannot be created.
    """
    kind: object = locate_model(name).what
    if not isinstance(kind, str):
        message = f"{name!r} is not a disturbance model: its attribute what is a {type(kind).__name__}, not a string"
        raise PluginError(message, fix="set what to the kind of the disturbance, such as 'brake'")
    return str(kind)


class ModelApart:
    """A model that runs in its own process, which starts at the first use.

    Args:
        name: name of the model, or ``module:attribute``.
        kind: kind of the model, if it is known.
        timeout_s: maximum wall time of each draw, in s; the first draw also imports the model.
    """

    def __init__(self, name: str, kind: str = "", *, timeout_s: float) -> None:
        self._name, self._kind, self._timeout_s = name, kind, timeout_s
        self._server: ServerApart | None = None
        self._model: DisturbanceModel | None = None  # only in its process

    @property
    def what(self) -> str:
        """Return the kind of the model."""
        if not self._kind:
            self._kind = self._ask({})["what"]
        return self._kind

    def draw(self, rng: np.random.Generator) -> Drawn:
        """Return a draw of the model. The random generator advances as if the model had drawn in this process."""
        found = self._ask({"generator": rng.bit_generator.state})
        rng.bit_generator.state = found["generator"]
        return Drawn(*found["drawn"])

    def log_likelihood(self, drawn: Drawn) -> float:
        """Return the natural logarithm of the probability with which the model draws this disturbance."""
        likely: float = self._ask({"drawn": [drawn.who, drawn.how_strong, drawn.how_long]})["likely"]
        return likely

    def close(self) -> None:
        """End the process; a second call does nothing."""
        if self._server is not None:
            self._server.close()

    def _ask(self, request: Plain) -> Any:
        if self._server is None:
            task, fix = f"the disturbance {self._name!r} cannot be drawn", "correct the code"
            self._server = ServerApart(self._answer, task=task, fix=fix, timeout_s=self._timeout_s)
        return self._server.ask(request)

    def _answer(self, request: Plain) -> Plain:
        model = self._model = self._model or locate_model(self._name)
        asked: Any = request
        if "generator" in asked:
            rng = np.random.default_rng()
            rng.bit_generator.state = asked["generator"]
            drawn = draw_checked(self._name, model, rng)
            values = [drawn.who, float(drawn.how_strong), float(drawn.how_long)]
            return {"drawn": values, "generator": rng.bit_generator.state}
        if "drawn" in asked:
            try:
                return {"likely": float(model.log_likelihood(Drawn(*asked["drawn"])))}
            except CrashhuntError:
                raise
            except Exception as error:  # of user code
                raise blamed(f"the likelihood of the disturbance {self._name!r} cannot be computed", error) from error
        return {"what": described_model(self._name)}
