"""Films: what is in them, how long they are, and where panels go."""

from __future__ import annotations

import math
import sys
from types import SimpleNamespace

import av
import numpy as np
import pytest
from hypothesis import given, strategies as st
from PIL import Image

from crashhunt.errors import CrashhuntError, UsageError
from crashhunt.recording import Prologue, StepRecord
from crashhunt.render import FilmOptions, Layout, Shot, check_places, frames, write_frames, write_gif, write_video
from crashhunt.trial import Disturbance
from crashhunt.world import Actor, Roster, Scene

ROSTER = Roster((Actor("ego", "passenger", 5.0, 2.0), Actor("other", "truck", 12.0, 2.5)))
RED = (143, 15, 63)


def shot(steps: int = 20, *, crash: bool = True, other: str = "other", panels=None) -> Shot:
    """The ego follows a truck on a straight road, and reaches it in the last step."""
    records = [
        StepRecord(
            n,
            Scene(20 + n / 10, ROSTER, [(float(n), 0.0), (steps + 12.0, 0.0)], [0.0, 0.0], [10.0, 0.0]),
            actions={"ego": np.array([10.0, 0.0])} if n else {},
        )
        for n in range(steps + 1)
    ]
    recording = SimpleNamespace(compact=None,
        all_steps=records, prologue=Prologue((), 0.1), steps=steps, agents=["ego"], actors=list(ROSTER.actors),
        disturbances=(), scenes=lambda: [record.scene for record in records], scene=lambda n: records[n].scene,
    )  # fmt: skip
    x = np.linspace(-50, 150, 30)
    lanes = [(np.stack((x, np.full(30, -1.6)), 1), np.stack((x, np.full(30, 1.6)), 1))]
    return Shot(recording, lanes, "ego", other, steps if crash else -1, panels or {})


def film(*shots: Shot, **options) -> list[np.ndarray]:
    return list(frames(shots, FilmOptions(**({"size": (320, 200)} | options))))


def test_what_disturbs_is_reported_while_it_continues():
    plain, disturbed = shot(11), shot(11)
    disturbed.recording.disturbances = (
        Disturbance(5, "ahead", "brake", 4.0, 0.5, "ego", "other"),
        Disturbance(5, "behind", "speed", 4.0, 0.5, "ego"),  # nobody was there
    )
    pairs = zip(film(plain, panels=False), film(disturbed, panels=False), strict=True)
    changed = [number for number, (was, now) in enumerate(pairs) if (was != now).any()]
    assert changed == [5, 6, 7, 8, 9]
    words_only = shot(11)
    words_only.recording.disturbances = (Disturbance(5, "ahead", "brake", 4.0, 0.5, "ego", "truck.2"),)  # it has left
    purple = (128, 62, 158)
    ringed, told = film(disturbed, panels=False)[7], film(words_only, panels=False)[7]
    assert count(ringed, purple) > count(told, purple) + 20


def count(picture: np.ndarray, color: tuple[int, int, int]) -> int:
    return int((picture == color).all(axis=2).sum())


@given(st.integers(64, 2000), st.integers(64, 2000), st.integers(0, 40))
def test_panels_overlap_neither_the_scene_nor_each_other(width, height, number):
    layout = Layout((width, height), [str(n) for n in range(number)])
    taken = np.zeros((layout.size[1], layout.size[0]), np.int8)
    taken[:height, :width] += 1
    for x, y in layout.places.values():
        assert taken[y : y + 160, x : x + 240].shape == (160, 240)
        taken[y : y + 160, x : x + 240] += 1
    assert taken.max() == 1
    assert len(layout.places) == number
    assert layout.size[0] % 2 == layout.size[1] % 2 == 0


def test_panels_go_to_where_the_picture_stays_smaller():
    labels = ["a", "b", "c", "d", "e"]
    assert Layout((960, 960), labels).size == (1200, 960)  # beside
    assert Layout((720, 300), labels).size == (720, 620)  # below
    assert Layout((961, 541), []).size == (962, 542)


def test_a_film_has_a_picture_a_step_and_shows_the_last_one_longer():
    assert len(film(shot(4), last_step_repeats=0)) == 5
    pictures = film(shot(6), last_step_repeats=7)
    assert len(pictures) == 14
    assert all((picture == pictures[6]).all() for picture in pictures[6:])
    assert (pictures[5] != pictures[6]).any()


@pytest.mark.parametrize(
    ("options", "length"),
    [
        ({"fps": 20.0}, 41),
        ({"fps": 5.0}, 11),
        ({"last_s": 0.5}, 6),
        ({"last_s": 99.0}, 21),
        ({"fps": 3.0}, 7),
        ({"fps": 0.7}, 3),
    ],
)
def test_pictures_a_second_and_the_last_seconds(options, length):
    pictures = film(shot(20), last_step_repeats=0, panels=False, **options)
    assert len(pictures) == length
    assert (pictures[-1] == film(shot(20), last_s=0.1, panels=False)[-1]).all()  # it always ends with the crash


def test_several_crashes_have_blank_pictures_between_them():
    pictures = film(shot(5), shot(2), last_step_repeats=0, blank_frames=4)
    assert len(pictures) == 6 + 4 + 3
    blank = [number for number, picture in enumerate(pictures) if (picture == 255).all()]
    assert blank == [6, 7, 8, 9]
    assert len({picture.shape for picture in pictures}) == 1


def test_vehicles_have_their_true_size():
    picture = film(shot(20, crash=False), panels=False, size=(600, 200))[20]
    red = (picture[80:120] == RED).all(axis=2)
    # 12 m by 2.5 m at 8 pixels a metre, less outline and windscreen.
    assert np.nonzero(red.any(axis=0))[0].size == pytest.approx(96, abs=4)
    assert np.nonzero(red.any(axis=1))[0].size == pytest.approx(20, abs=3)


def test_the_agents_own_panels_are_shown_in_their_step():
    blue = np.full((160, 240, 3), (0, 0, 255), np.uint8)
    made = shot(5, panels={3: {"ego/mine": blue}})
    pictures = film(made, last_step_repeats=0)
    assert [count(picture, (0, 0, 255)) for picture in pictures] == [0, 0, 0, 240 * 160, 0, 0]
    assert all((picture == 255).any() for picture in pictures)
    assert film(made, panels=False)[3].shape == (200, 320, 3)


def test_an_episode_without_a_single_step_is_one_picture():
    assert len(film(shot(0), last_step_repeats=0)) == 1


def test_a_video_has_the_pictures_in_it(tmp_path):
    path = tmp_path / "out.mp4"
    options = FilmOptions(size=(320, 200), panels=False, last_step_repeats=3)
    assert write_video(path, [shot(8)], options) == 12
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert (stream.width, stream.height) == (320, 200)
        assert float(stream.average_rate) == pytest.approx(10.0)
        decoded = [frame.to_ndarray(format="rgb24") for frame in container.decode(stream)]
    assert len(decoded) == 12
    for got, want in zip(decoded, frames([shot(8)], options), strict=True):
        assert np.abs(got.astype(int) - want).mean() < 4  # the codec loses a little
    assert [p.name for p in tmp_path.iterdir()] == ["out.mp4"]


def test_a_gif_plays_in_real_time(tmp_path):
    path = tmp_path / "out.gif"
    assert write_gif(path, [shot(3)], FilmOptions(size=(320, 200), last_step_repeats=0)) == 4
    with Image.open(path) as image:
        assert image.n_frames == 4
        assert image.info["duration"] == 100
        assert image.info["loop"] == 0
    again = FilmOptions(size=(320, 200), last_step_repeats=5)
    with Image.open(path) as image:
        assert write_gif(path, [shot(3)], again) == image.n_frames  # what repeats the last picture prolongs it


def test_frames_are_files(tmp_path):
    options = FilmOptions(size=(320, 200), last_step_repeats=0)
    assert write_frames(tmp_path / "f", [shot(4)], options) == 5
    names = sorted(path.name for path in (tmp_path / "f").iterdir())
    assert names == [f"{number:06d}.png" for number in range(5)]
    with Image.open(tmp_path / "f/000004.png") as image:
        assert (np.asarray(image) == film(shot(4))[4]).all()


def test_video_without_pyav_is_refused_with_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(UsageError, match=r"--video needs PyAV.*; \S*pip install (-e )?\S*\[video\]"):
        check_places(video=tmp_path / "a.mp4")
    check_places(gif=tmp_path / "a.gif")


def test_a_film_that_cannot_be_written_leaves_nothing_behind(tmp_path):
    options = FilmOptions(size=(320, 200), panels=False)
    (tmp_path / "in the way.mp4").mkdir()
    (tmp_path / "in the way.gif").mkdir()
    for write, name in ((write_video, "in the way.mp4"), (write_gif, "in the way.gif")):
        with pytest.raises(CrashhuntError, match="cannot be written"):
            write(tmp_path / name, [shot(3)], options)
    (tmp_path / "file").touch()
    with pytest.raises(CrashhuntError, match="cannot be written"):
        write_frames(tmp_path / "file" / "x", [shot(3)], options)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "in the way.gif", "in the way.mp4"]


@pytest.mark.parametrize("there", [False, True])
def test_interrupted_frames_leave_nothing_behind(tmp_path, there):
    folder = tmp_path / "f"
    if there:
        folder.mkdir()
    seen = []

    def interrupt(done, total):
        seen.append((done, total))
        if done == 2:
            raise KeyboardInterrupt

    options = FilmOptions(size=(64, 64), last_step_repeats=0)
    with pytest.raises(KeyboardInterrupt):
        write_frames(folder, [shot(4)], options, watch=interrupt)
    assert seen == [(1, 5), (2, 5)]
    assert folder.exists() == there
    assert list(tmp_path.rglob("*.png")) == []


@pytest.mark.parametrize(
    "options",
    [
        pytest.param({}, marks=pytest.mark.nightly),
        {"last_s": 0.5},
        {"fps": 3.0, "blank_frames": 4},
        pytest.param({"last_step_repeats": 0}, marks=pytest.mark.nightly),
    ],
)
def test_how_many_pictures_there_will_be_is_known_before(tmp_path, options):
    seen = []
    shots, settings = [shot(4), shot(7)], FilmOptions(size=(64, 64), panels=False, **options)
    made = write_frames(tmp_path / "f", shots, settings, watch=lambda *now: seen.append(now))
    assert seen == [(done, made) for done in range(1, made + 1)]


def test_an_interrupted_video_leaves_nothing_behind(tmp_path, monkeypatch):
    def interrupted(self, step):
        if step == 3:
            raise KeyboardInterrupt
        return np.zeros((200, 320, 3), np.uint8)

    monkeypatch.setattr("crashhunt.render._film.SceneView.draw", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_video(tmp_path / "out.mp4", [shot(20)], FilmOptions(size=(320, 200), panels=False))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"fps": -1.0}, "--fps is -1"), ({"fps": math.nan}, "--fps is nan"), ({"size": (8, 300)}, "--size is 8"),
        ({"size": (300, 8193)}, "--size is 300x8193"), ({"last_s": -2.0}, "--last-seconds is -2"),
        ({"blank_frames": -1}, "--blank-frames is -1"), ({"last_step_repeats": -1}, "--last-step-repeats is -1"),
    ],
)  # fmt: skip
def test_impossible_options_are_named(options, message):
    with pytest.raises(UsageError, match=message):
        FilmOptions(**options)


def test_places_are_looked_at_before_anything_is_run(tmp_path):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "x").touch()
    check_places(video=tmp_path / "a.mp4", gif=tmp_path / "a.gif", folder=tmp_path / "new")
    for options, message in (
        ({"video": tmp_path / "a.avi"}, "does not end in .mp4"),
        ({"gif": tmp_path / "a.mp4"}, "does not end in .gif"),
        ({"video": tmp_path / "no" / "a.mp4"}, "there is no folder"),
        ({"folder": tmp_path / "full"}, "is not an empty folder"),
        ({"folder": tmp_path / "full" / "x"}, "is not an empty folder"),
    ):
        with pytest.raises(UsageError, match=message):
            check_places(**options)
