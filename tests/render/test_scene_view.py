"""What a picture of a scene shows: where vehicles are, which way they face, persons, trails, scale and marks."""

from __future__ import annotations

import itertools
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("PIL")

from crashhunt.panels import Action, Curve
from crashhunt.recording import Prologue, StepRecord
from crashhunt.render import FilmOptions, Shot, frames
from crashhunt.render._film import BuiltinPanels, _steps, save_panels, shown_steps
from crashhunt.render._scene_from_above import SceneView
from crashhunt.world import PERSON, Actor, Roster, Scene, corners

EGO, PARTNER, AGENT, OTHER, MARK = (255, 179, 26), (143, 15, 63), (46, 158, 91), (154, 165, 179), (170, 180, 192)
CRASH = (198, 40, 40)
WIDTH, HEIGHT, SCALE = 400, 300, 8.0
MIDDLE = np.array([WIDTH / 2, HEIGHT / 2])


def recording(*steps, actors, dt=0.1, agents=("ego",), actions=None, disturbances=()):
    """Each step has x, y, heading and speed of each actor by name; the place is that of the front."""
    records = []
    for number, places in enumerate(steps):
        roster = Roster(tuple(actor for actor in actors if actor.id in places))
        found = [places[actor.id] for actor in roster.actors]
        scene = Scene(number * dt, roster, [(x, y) for x, y, *_ in found], [float(one[2]) for one in found],
                      [float(one[3]) for one in found])  # fmt: skip
        records.append(StepRecord(number, scene, actions=(actions or {}).get(number, {})))
    return SimpleNamespace(compact=None,
        all_steps=records, prologue=Prologue((), dt), steps=len(steps) - 1, agents=[*agents], actors=[*actors],
        disturbances=disturbances, scenes=lambda: [record.scene for record in records],
        scene=lambda n: records[n].scene,
    )  # fmt: skip


CAR, TRUCK = Actor("ego", "passenger", 5.0, 2.0), Actor("other", "truck", 12.0, 2.5)


def view(found, **more):
    return SceneView(found, [], **{"agent": "ego", "width": WIDTH, "height": HEIGHT, "scale": SCALE, **more})


def box(picture, color, tolerance=0):
    """Where a colour is, as middle and size in pixels."""
    near = np.abs(picture.astype(int) - color).max(axis=2) <= tolerance
    near[:110, :150] = False  # the legend
    rows, columns = np.nonzero(near)
    low, high = np.array([columns.min(), rows.min()]), np.array([columns.max(), rows.max()])
    return (low + high + 1) / 2, high - low + 1


@pytest.mark.parametrize(("scale", "radius"), [(8.0, 4.0), (40.0, 10.0)])
def test_a_person_is_a_disc_that_can_be_seen(scale, radius):
    person = Actor(f"{PERSON}a", "pedestrian", 0.5, 0.5)
    places = {"ego": (0.0, 0.0, 0.0, 0.0), person.id: (2.25, -2.0, 0.0, 1.0)}
    picture = view(recording(places, actors=[CAR, person]), scale=scale).draw(0)
    at, size = box(picture, OTHER)
    assert at == pytest.approx(MIDDLE + np.array([2.0 + 2.5, 2.0]) * scale, abs=1.5)
    assert size == pytest.approx([2 * radius] * 2, abs=1.5)


@pytest.mark.parametrize(("scale", "meters"), [(8.0, 10), (2.0, 50), (20.0, 5), (0.5, 200)])
def test_the_scale_is_a_line_of_a_round_length(scale, meters):
    found = recording({"ego": (0.0, 0.0, 0.0, 0.0)}, actors=[CAR])
    picture = view(found, scale=scale, width=640, height=360).draw(0)
    row = (np.abs(picture[360 - 12].astype(int) - (93, 107, 125)).max(axis=1) < 3).nonzero()[0]
    assert (row.min(), row.max()) == (14, pytest.approx(14 + meters * scale, abs=1))


def test_obstacles_in_sight_are_drawn_as_areas():
    found = recording({"ego": (2.5, 0.0, 0.0, 0.0)}, actors=[CAR])
    house = np.array([(5.0, 3.0), (15.0, 3.0), (15.0, 8.0), (5.0, 8.0), (5.0, 3.0)])
    picture = view(found, obstacles=[house, house + np.array((0.0, 500.0)), house[:2]]).draw(0)
    changed = (picture != view(found).draw(0)).any(axis=2).nonzero()
    assert (changed[0].min(), changed[0].max()) == (pytest.approx(150 - 64, abs=1), pytest.approx(150 - 24, abs=1))
    assert (changed[1].min(), changed[1].max()) == (pytest.approx(200 + 40, abs=1), pytest.approx(200 + 120, abs=1))
    assert tuple(picture[150 - 40, 200 + 80]) == (196, 186, 176)


TOP, BELOW = slice(44), slice(55, 110)


def test_a_crash_is_marked_in_its_step_and_a_near_miss_for_a_second():
    steps = [{"ego": (2.5, 0.0, 0.0, 0.0)} for _ in range(14)]
    found = recording(*steps, actors=[CAR], dt=0.25)

    def marked(**more):
        pictures = view(found, width=200, height=160, **more)
        apart = [np.abs(pictures.draw(step).astype(int) - CRASH).max(axis=2) for step in range(14)]
        words = [step for step in range(14) if (apart[step][TOP] < 60).any()]  # small letters are blurred
        ring = [step for step in range(14) if (apart[step][BELOW] == 0).any()]
        assert words == ring
        return words

    assert marked() == []
    assert marked(crash_step=7) == [7]
    assert marked(nearest_step=5) == [5, 6, 7, 8, 9]


@pytest.mark.parametrize("size", [(64, 64), (100, 80), (160, 90), (240, 135), (320, 200), (480, 270), (960, 540)])
def test_texts_of_a_crash_stand_apart_and_within_a_picture_of_any_size(monkeypatch, size):
    boxes = []

    def text(self, at, words, color, letters, anchor, **_):
        boxes.append(self.textbbox(at, words, letters, anchor))

    monkeypatch.setattr("PIL.ImageDraw.ImageDraw.text", text)
    found = recording(*[{"ego": (2.5, 0.0, 0.0, 0.0), "other": (30.0, 0.0, 0.0, 0.0)}] * 8, actors=[CAR, TRUCK])
    view(found, width=size[0], height=size[1], other="other", crash_step=7).draw(7)
    assert len(boxes) >= 2  # the mark and the scale
    boxes = [box for box in boxes if box[2] > box[0]]
    for left, top, right, bottom in boxes:
        assert 0 <= left < right <= size[0]
        assert 0 <= top < bottom <= size[1]
    for one, other in itertools.combinations(boxes, 2):
        assert one[2] <= other[0] or other[2] <= one[0] or one[3] <= other[1] or other[3] <= one[1]


# The panels of every film.


def builtin_panels(shot):
    return BuiltinPanels(shot.recording, agent=shot.agent, other=shot.other, meanings=shot.meanings)


def following(dt=0.1, steps=40, other="other"):
    """Ego comes closer to a standing truck by 1 m in each step, beginning 90 m behind it."""
    places = [{"ego": (float(n), 0.0, 0.0, 1.0 / dt), "other": (102.0, 0.0, 0.0, 0.0)} for n in range(steps + 1)]
    actions = {n: {"ego": np.array([3.0 - n, 0.5])} for n in range(1, steps + 1)}
    found = recording(*places, actors=[CAR, TRUCK], dt=dt, actions=actions)
    return Shot(found, [], "ego", other, -1, {})


@pytest.mark.parametrize("other", ["other", ""])
def test_panels_show_time_to_collision_gap_and_speed_of_the_last_seconds(other):
    shot = following(other=other, steps=120)
    for step in (60, 75):
        panels = dict(builtin_panels(shot).panels(step))
        times, gaps, speeds, pulls, danger = [panel for panel in panels.values() if isinstance(panel, Curve)]
        shown = len(times.x)
        assert times.x[-1] == pytest.approx(step / 10)
        assert np.diff(times.x) == pytest.approx(0.1)
        assert shown == len(times.series) == len(gaps.series) == len(speeds.series["ego"]) == len(danger.series)
        assert shown <= step + 1
        assert gaps.series[-1] == pytest.approx(90.0 - step)
        assert times.series[-1] == pytest.approx((90.0 - step) / 10)
        actors = {"ego": 10.0, "other": 0.0} if other else {"ego": 10.0}
        assert {name: speed[-1] for name, speed in speeds.series.items()} == pytest.approx(actors)
        assert {name: pull[-1] for name, pull in pulls.series.items()} == pytest.approx(dict.fromkeys(actors, 0.0))
        assert (danger.low, danger.high) == (0.0, 1.0)
        (action,) = [panel for panel in panels.values() if isinstance(panel, Action)]
        assert action.value == pytest.approx([3.0 - step, 0.5])
        assert action.low == pytest.approx([-117.0, 0.0])
        assert action.high == pytest.approx([117.0, 1.0])  # with two directions, 0 is in the middle
    assert len(dict(builtin_panels(shot).panels(0))) == 5  # nothing has been decided yet
    beginning = dict(builtin_panels(following(other=other, steps=5)).panels(2))
    assert next(iter(beginning.values())).high == 10.0


def test_lane_change_of_0_is_in_the_middle_of_its_axis():
    found = following(steps=4).recording
    channel = SimpleNamespace(id="ego", action_names=("target_speed", "lane_change"), action_shape=(2,))
    found.prologue = SimpleNamespace(agents=(channel,), step_length_s=0.1)
    panels = BuiltinPanels(found, agent="ego", other="")
    assert (panels._low[1], panels._high[1]) == (-1.0, 1.0)


def test_a_planned_trajectory_is_drawn_as_its_speed_over_time():
    found = following(steps=4).recording
    plan = np.array([[0.1, 1.0, 0.0, 0.0, 9.0], [0.2, 2.0, 0.0, 0.0, 8.0], [0.2, 2.0, 0.0, 0.0, 8.0]])
    for step in found.all_steps[1:]:
        step.actions["ego"] = plan
    panel = dict(BuiltinPanels(found, agent="ego", other="").panels(2))["action"]
    assert np.array_equal(panel.series["planned m/s"], [9.0, 8.0])
    assert np.array_equal(panel.x, [0.1, 0.2])


def ring_of(found):
    """Return the middle of the ring of a crash in the last step, relative to ego, in m."""
    picture = view(found, width=400, height=400, crash_step=1, other="other").draw(1)
    apart = np.abs(picture.astype(int) - CRASH).max(axis=2)
    apart[:60] = 255  # the word above
    rows, columns = np.nonzero(apart < 40)
    return np.array([(columns.min() + columns.max()) / 2 - 200, 200 - (rows.min() + rows.max()) / 2]) / 8.0


def test_words_above_a_crash_are_those_that_are_given():
    step = {"ego": (2.5, 0.0, 0.0, 10.0)}
    found = recording(step, step, actors=[CAR])
    drawn = [view(found, width=400, height=400, crash_step=1, crash_words=words).draw(1) for words in ("", "CRASH")]
    red = [(np.abs(picture[:60].astype(int) - CRASH).max(axis=2) < 40).sum() for picture in drawn]
    assert red[0] == 0 < 100 < red[1]


def test_ring_of_a_crash_is_where_the_outlines_meet():
    # ego, 5 m long and 2 m wide, drives east and touches with its left front corner a truck that crosses ahead.
    step = {"ego": (2.5, 0.0, 0.0, 10.0), "other": (4.0, 0.9, -np.pi / 2, 5.0)}
    found = recording(step, step, actors=[CAR, TRUCK])
    scene = found.scene(1)
    expected = _nearest_middle(*(np.array(corners(scene, scene.roster.index[name])) for name in ("ego", "other")))
    assert ring_of(found) == pytest.approx(expected - scene.centers[scene.roster.index["ego"]], abs=0.2)


@pytest.mark.parametrize("aside", [0.0, 0.8])
def test_ring_of_a_rear_end_is_in_the_middle_of_what_touches(aside):
    step = {"ego": (0.0, 0.0, 0.0, 10.0), "other": (TRUCK.length, aside, 0.0, 5.0)}  # the points are those of fronts
    x, y = ring_of(recording(step, step, actors=[CAR, TRUCK]))
    touching = max(-CAR.width / 2, aside - TRUCK.width / 2), min(CAR.width / 2, aside + TRUCK.width / 2)
    assert (x, y) == pytest.approx((CAR.length / 2, sum(touching) / 2), abs=0.2)


def _nearest_middle(first, second):
    """Return the middle between the closest points of two convex outlines, by their vertices and edges."""
    best = (np.inf, None)
    for one, other in ((first, second), (second, first)):
        for vertex in one:
            for start, end in zip(other, np.roll(other, -1, axis=0), strict=True):
                share = np.clip(np.dot(vertex - start, end - start) / np.dot(end - start, end - start), 0, 1)
                near = start + share * (end - start)
                best = min(best, (np.linalg.norm(vertex - near), (vertex + near) / 2), key=lambda each: each[0])
    return best[1]


def test_a_film_has_its_panels_next_to_the_scene_in_every_picture():
    shot = following(steps=4)
    plain, with_panels = (
        list(frames([shot], FilmOptions(size=(320, 200), panels=panels, last_step_repeats=0)))
        for panels in (False, True)
    )
    assert len(plain) == len(with_panels) == 5
    assert plain[0].shape == (200, 320, 3)
    assert with_panels[0].shape[0] * with_panels[0].shape[1] >= 320 * 200 + 4 * 240 * 160
    for scene, picture in zip(plain, with_panels, strict=True):
        assert np.array_equal(picture[:200, :320], scene)
        outside = picture.copy()
        outside[:200, :320] = 255
        assert (outside != 255).any(axis=2).sum() > 1000


def test_far_gaps_are_cut_so_that_near_ones_can_be_read():
    places = [{"ego": (float(n), 0.0, 0.0, 10.0), "other": (400.0, 0.0, 0.0, 10.0)} for n in range(4)]
    shot = Shot(recording(*places, actors=[CAR, TRUCK]), [], "ego", "other", -1, {})
    curves = [panel for _, panel in builtin_panels(shot).panels(3) if isinstance(panel, Curve)]
    assert (curves[1].low, curves[1].high) == (0.0, 100.0)


def test_a_film_shows_the_last_seconds_or_those_around_a_near_miss():
    found = following(steps=100).recording
    assert shown_steps(found, 0.0, -1) == (0, 100)
    assert shown_steps(found, 3.0, -1) == (70, 100)
    assert shown_steps(found, 4.0, 50) == (30, 70)
    assert shown_steps(found, 4.0, 95) == (75, 100)
    assert shown_steps(found, 4.0, 5) == (0, 25)
    shot = Shot(found, [], "ego", "other", -1, {})
    assert _steps(shot, FilmOptions(fps=5.0, last_s=2.0)) == list(range(80, 101, 2))
    assert _steps(shot, FilmOptions(fps=20.0, last_s=0.5)) == [95, 95, 96, 96, 97, 97, 98, 98, 99, 99, 100]


def test_a_drawn_panel_of_another_size_is_replaced_by_the_reason(tmp_path):
    from PIL import Image

    small = SimpleNamespace(draw=lambda label: np.zeros((9, 9, 3), np.uint8))
    save_panels(tmp_path, 4, [("good", Curve([1.0, 2.0])), ("bad", small)])
    for path, shown in zip(sorted(tmp_path.glob("*.png")), (Curve([1.0, 2.0]), None), strict=True):
        with Image.open(path) as image:
            pixels = np.asarray(image)
        assert pixels.shape == (160, 240, 3)
        assert shown is None or np.array_equal(pixels, shown.draw(label="good"))
        assert len(np.unique(pixels.reshape(-1, 3), axis=0)) > 2  # the reason, in letters


def test_a_film_is_at_most_8192_wide_and_high():
    FilmOptions(size=(8192, 64))
    for size in ((8193, 64), (64, 8193), (63, 64)):
        with pytest.raises(Exception, match=r"size"):
            FilmOptions(size=size)
