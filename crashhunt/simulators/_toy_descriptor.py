"""Descriptor of the toy simulator: it has no table and reads no file."""

from __future__ import annotations

from typing import TYPE_CHECKING

from crashhunt.scenario import Backend, refuse
from crashhunt.simulators._observation_parts import SCENE_PARTS

if TYPE_CHECKING:
    from crashhunt.scenario import Scenario


def _check(scenario: Scenario, where: str) -> None:
    for agent, setup in scenario.agents.items():
        if setup.action_form not in ("speed_and_lane", "meta"):
            refuse(
                where, f"agents.{agent}.action", setup.action, "is no form of the toy", "give speed_and_lane or meta"
            )


BACKEND: Backend = Backend(
    title="the toy",
    check=_check,
    reported_events=(),
    disturbances=("brake", "stop", "unseen"),
    observations=SCENE_PARTS,
    side_effect=lambda *_: "",
    forkable=True,
)
