"""Drawn panels on their way from the process of the agent to the one that makes the film."""

from __future__ import annotations

import json
import textwrap
from typing import TYPE_CHECKING

import numpy as np

from crashhunt.panels import Text

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from crashhunt.panels import Panel

__all__ = ["explanation", "load_meanings", "load_panels", "save_meanings", "save_panels"]

_SHAPE = (160, 240, 3)  # what a panel draws unless asked for another size
_LINE = 34  # characters that fit


def explanation(error: Exception) -> Text:
    """Return what stands where a panel cannot be."""
    return Text("\n".join(textwrap.wrap(f"cannot be drawn: {type(error).__name__}: {error}", _LINE)[:9]))


def save_panels(folder: Path, step: int, panels: Sequence[tuple[str, Panel]]) -> None:
    """Draw and add the panels of one agent and step; one that cannot be drawn says why."""
    from PIL import Image

    with (folder / "index.jsonl").open("a", encoding="utf-8") as index:
        for number, (label, panel) in enumerate(panels):
            name = f"{step:06d}-{index.tell()}-{number}.png"
            try:
                picture = panel.draw(label=label)
                if picture.shape != _SHAPE or picture.dtype != np.uint8:
                    raise ValueError(f"{picture.dtype}, shape {picture.shape}, not uint8, shape {_SHAPE}")
            except Exception as error:  # an agent may put anything into its panels
                picture = explanation(error).draw(label=label)
            Image.fromarray(picture).save(folder / name, compress_level=1)
            index.write(json.dumps([step, label, name]) + "\n")


def save_meanings(folder: Path, agent: str, meanings: Sequence[str]) -> None:
    """Write down what the numbers of an agent's discrete actions stand for; nothing where nobody says."""
    if meanings:
        with (folder / "meanings.jsonl").open("a", encoding="utf-8") as file:
            file.write(json.dumps([agent, list(map(str, meanings))]) + "\n")


def load_meanings(folder: Path) -> dict[str, tuple[str, ...]]:
    """Return agent to what `save_meanings` was given."""
    try:
        lines = (folder / "meanings.jsonl").read_text(encoding="utf-8").splitlines()
    except OSError:
        return {}
    return {agent: tuple(meanings) for agent, meanings in map(json.loads, lines)}


def load_panels(folder: Path) -> dict[int, dict[str, NDArray[np.uint8]]]:
    """Return step to label to picture, uint8, shape (height, width, 3)."""
    from PIL import Image

    found: dict[int, dict[str, NDArray[np.uint8]]] = {}
    try:
        lines = (folder / "index.jsonl").read_text(encoding="utf-8").splitlines()
    except OSError:
        return found
    for line in lines:
        step, label, name = json.loads(line)
        with Image.open(folder / name) as image:
            found.setdefault(step, {})[label] = np.asarray(image.convert("RGB"))
    return found
