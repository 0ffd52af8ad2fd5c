"""Panels and scenes look as the golden pictures in ``tests/golden/pictures``.

``CRASHHUNT_GOLDEN=write`` writes the pictures again, after a change that is meant to change them.
"""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import PIL
import pytest
from golden import GOLDEN, WRITE
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from crashhunt.panels import Action, ActionDistribution, Bar, Contour, Curve, Curve3D, Heatmap, Picture, Text
from crashhunt.recording import Prologue, StepRecord
from crashhunt.render import FilmOptions, SceneView, Shot, frames
from crashhunt.trial import Disturbance
from crashhunt.world import Actor, Roster, Scene

_SLOPE = np.add.outer(np.linspace(0, 2, 9), np.linspace(-1, 3, 7))
PANELS = {
    "heatmap": Heatmap([[0.0, 1.0, 2.5], [np.nan, 3.0, -1.0]], annotate=True),
    "heatmap with limits": Heatmap(_SLOPE, low=-3.0, high=4.0),
    "contour": Contour(_SLOPE**2, levels=6),
    "contour with limits": Contour(np.where(_SLOPE > 4, np.nan, _SLOPE), low=0.0, high=6.0),
    "curves": Curve(
        {str(part): np.sin(np.linspace(part, 5 + part, 30)) + 0.2 * part for part in range(8)},
        x=np.linspace(-3, 9, 30),
        cursor=2.0,
    ),
    "curve with gaps": Curve([1.0, 4.0, np.nan, 2.0, np.inf, 300.0, 50.0, 70.0], low=0.0, high=100.0),
    "path": Curve3D([(np.cos(n / 3), np.sin(n / 3), n / 10) for n in range(30)], azimuth=20.0),
    "bars": Bar({"left": 1.0, "idle": -2.5, "right": 4.0, "none": np.nan}),
    "bars with limits": Bar([3.0, 9.0, -9.0], low=-4.0, high=6.0),
    "text": Text("brake\nnow, as the leader does"),
    "number": Action(3),
    "name": Action(1, names=("LEFT", "IDLE")),
    "long name": Action(0, names=("FOLLOW THE LEADER",)),
    "box": Action([0.5, -20.0, 3.0], low=[-1.0, -5.0, 2.0], high=[1.0, 5.0, 6.0], names=("steer", "brake")),
    "unit box": Action([0.25, -0.5]),
    "probabilities": ActionDistribution([0.2, 0.7, 0.1], names=("LEFT", "IDLE")),
    "long names": ActionDistribution([0.2, 0.4, 0.1, 0.3], names=("LANE_LEFT_OR_IDLE", "IDLE", "LANE_RIGHT", "gap")),
    "many names": Bar({f"gap to {place}": place - 4.5 for place in range(12)}),
    "normal": ActionDistribution(mean=[0.0, 2.0], std=[1.0, 0.5], names=("steer", "brake")),
    "picture beyond black and white": Picture([[-2.0, 0.0, 0.25, np.nan], [0.5, 1.0, 1.5, np.inf]]),
    "wide picture": Picture(np.linspace(0, 1, 200).reshape(10, 20)),
    "high picture": Picture((np.arange(1200, dtype=np.uint8) * 7).reshape(20, 20, 3)),
}  # fmt: skip


@pytest.mark.parametrize("name", PANELS)
def test_panel_looks_as_before(name):
    compare_picture(f"panel {name}", PANELS[name].draw(label=name))


def test_label_has_80_characters_at_most():
    longest = Text("").draw(900, 60, label="x" * 80)
    assert np.array_equal(Text("").draw(900, 60, label="x" * 81), longest)
    assert not np.array_equal(Text("").draw(900, 60, label="x" * 79), longest)


@pytest.mark.parametrize("turn", range(4))
def test_scene_shows_every_vehicle_in_its_place_and_direction(turn):
    compare_picture(f"scene {turn}", film(street(turn), panels=False, fps=0.01, size=(320, 200))[-1])


def test_scene_view_marks_no_step_by_default():
    shown = street(0)
    given = {"width": 960, "height": 540, "scale": 8.0, "crash_step": -1, "nearest_step": -1, "other": ""}
    plain, explicit = (SceneView(shown.recording, [], agent="ego", **more) for more in ({}, given))
    for step in (0, 1):
        assert np.array_equal(plain.draw(step), explicit.draw(step))


def test_curves_show_the_last_10_s():
    pictures = film(street(0), fps=0.25, size=(64, 64), last_step_repeats=0)
    assert len(pictures) == 5
    for number in (1, 4):
        compare_picture(f"film {number}", pictures[number])


def test_near_miss_with_no_certain_partner_shows_the_nearest_vehicle():
    compare_picture("near miss", film(street(2, other="", nearest=90), fps=0.05, size=(100, 80))[-1])


def test_trial_without_scene_shows_rewards_and_actions():
    empty = Roster(())
    steps = [
        StepRecord(
            n, Scene(n / 2, empty, [], [], []), actions={"ego": np.array(n % 3)}, rewards={"ego": n**2} if n % 2 else {}
        )
        for n in range(7)
    ]
    shown = Shot(recording(steps, (), 0.5), [], "ego", "", 6, {}, meanings=("LEFT", "IDLE", "RIGHT"))
    compare_picture("no scene", film(shown, size=(320, 200))[-1])


def street(turn: int, other: str = "truck", nearest: int = -1) -> Shot:
    """The ego brakes behind a truck on a bridge, near a person, another agent and a car below; turned by 90° each."""
    sizes = {"ego": (5.0, 2.0), "truck": (12.0, 2.5), "person 1": (0.3, 0.5), "peer": (4.5, 1.8)}
    sizes |= {"gone": (4.0, 2.0), "below": (5.0, 3.0)}
    roster = Roster(tuple(Actor(name, "passenger", *size) for name, size in sizes.items()))
    angle = turn * np.pi / 2 + 0.2
    rotate = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    steps = []
    for n in range(161):
        x = 20.0 * n / 10 - 0.5 * (n / 10) ** 2
        points = np.array([(x, 0.0), (210.0, 0.0), (x + 4, 6.0), (x - 9, -5.0), (x - 500, 0.0), (x - 3, 2.0)]) @ rotate
        headings = [angle, angle, angle + 1.0, angle - 0.4, angle, angle + 1.5]
        speeds = [20.0 - n / 10, 0.0, 1.0, 12.0, 3.0, 9.0]
        scene = Scene(
            20 + n / 10, roster, points.tolist(), headings, speeds, heights=[5, 5, 0, 5, 5, 0], grades=[0] * 6
        )
        action = {"ego": np.array([20 - n / 10, np.sin(n)])} if n else {}
        steps.append(StepRecord(n, scene, actions=action))
    along = np.linspace(-50, 260, 60)
    lanes = [
        tuple(np.stack((along, np.full(60, side)), 1) @ rotate for side in (middle - 1.6, middle + 1.6))
        for middle in (0.0, 3.2, 400.0)
    ]
    disturbances = (
        Disturbance(150, "ahead", "brake", 4.0, 2.0, "ego", "person 1"),
        Disturbance(150, "ahead", "speed", 4.0, 2.0, "ego", "left long ago"),
        Disturbance(10, "ahead", "brake", 4.0, 0.5, "ego", "truck"),
    )
    found = recording(steps, roster.actors, 0.1, agents=["ego", "peer"], disturbances=disturbances)
    return Shot(found, lanes, "ego", other, -1 if nearest >= 0 else 160, {}, nearest=nearest)


def recording(steps, actors, step_length_s, agents=("ego",), disturbances=()):
    return SimpleNamespace(compact=None,
        all_steps=steps, prologue=Prologue((), step_length_s), steps=len(steps) - 1, agents=list(agents),
        actors=list(actors), disturbances=disturbances, scenes=lambda: [step.scene for step in steps],
        scene=lambda n: steps[n].scene,
    )  # fmt: skip


def film(shown: Shot, **options) -> list[np.ndarray]:
    return list(frames([shown], FilmOptions(**options)))


def compare_picture(name: str, found: np.ndarray) -> None:
    """Compare with a golden picture: to some pixels with the Pillow that has drawn it, else roughly."""
    path = GOLDEN / "pictures" / f"{name.replace(' ', '-')}.png"
    if WRITE:
        path.parent.mkdir(exist_ok=True)
        facts = PngInfo()
        facts.add_text("Pillow", PIL.__version__)
        Image.fromarray(found).save(path, pnginfo=facts, optimize=True)
    with Image.open(path) as image:
        same_pillow = image.text["Pillow"] == PIL.__version__
        expected = np.asarray(image.convert("RGB")).astype(int)
    assert found.shape == expected.shape
    # Fonts and edges differ a little between versions; with one version, processors may round a pixel otherwise.
    tolerance, pixels = (0, 4) if same_pillow else (64, found.size // 3 // 50)
    differing = int((np.abs(found - expected) > tolerance).any(axis=2).sum())
    assert differing <= pixels, f"{differing} pixels differ from {path}"
