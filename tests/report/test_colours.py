"""The colours of the player can be told apart, also by people who see fewer colours."""

from __future__ import annotations

import re
from importlib import resources

import numpy as np
import pytest

# Machado, Oliveira and Fernandes, A physiologically-based model for simulation of color vision deficiency, 2009;
# severity 1, for linear RGB.
SEEN_BY = {
    "all": [1, 0, 0, 0, 1, 0, 0, 0, 1],
    "without red cones":
        [0.152286, 1.052583, -0.204868, 0.114503, 0.786281, 0.099216, -0.003882, -0.048116, 1.051998],
    "without green cones":
        [0.367322, 0.860646, -0.227968, 0.280085, 0.672501, 0.047413, -0.011820, 0.042940, 0.968881],
    "without blue cones":
        [1.255528, -0.076749, -0.178779, -0.078411, 0.930809, 0.147602, 0.004733, 0.691367, 0.303900],
}  # fmt: skip


def colours():
    """Return the variables of the light and of the dark scheme."""
    style = resources.files("crashhunt.report").joinpath("page.css").read_text(encoding="utf-8")
    light, dark = (dict(re.findall(r"--([\w-]+): (#[0-9a-f]{6});", part)) for part in style.split("@media", 1))
    return {"light": light, "dark": light | {name: dark[name] for name in dark if name in light}}


def luminance(colour, seen_by):
    values = np.array([int(colour[place : place + 2], 16) for place in (1, 3, 5)]) / 255
    linear = np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
    return float(np.clip(np.reshape(seen_by, (3, 3)) @ linear, 0, 1) @ [0.2126, 0.7152, 0.0722])


def contrast(first, second, seen_by):
    """Return the contrast ratio of WCAG 2."""
    low, high = sorted(luminance(colour, seen_by) for colour in (first, second))
    return (high + 0.05) / (low + 0.05)


def test_contrast_of_black_and_white_is_21():
    assert contrast("#000000", "#ffffff", SEEN_BY["all"]) == pytest.approx(21)


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("people", SEEN_BY)
def test_agent_and_collision_partner_differ_by_more_than_their_hue(scheme, people):
    named = colours()[scheme]
    assert contrast(named["ego"], named["partner"], SEEN_BY[people]) >= 3.0
    for line in ("ego-line", "partner", "accent"):  # curves on a card
        assert contrast(named[line], named["card"], SEEN_BY[people]) >= 3.0


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("people", SEEN_BY)
def test_observation_and_plan_differ_from_road_and_ground(scheme, people):
    named = colours()[scheme]
    for line in ("observed", "plan", "text"):
        assert min(contrast(named[line], named[ground], SEEN_BY[people]) for ground in ("road", "page")) >= 3.0, line
