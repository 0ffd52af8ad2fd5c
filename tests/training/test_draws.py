"""Which crash an episode begins with, and what the environment adds, with episodes made by hand."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from crashhunt.errors import HuntDirectoryError, SimulatorError, UsageError
from crashhunt.training import CrashEnv, TrainedOn, _crash_env
from crashhunt.training._crash_priorities import CrashReplay
from crashhunt.training._held_out_traffics import is_test_traffic, read_trained_on


def test_probabilities_are_those_of_prioritized_level_replay():
    replay = CrashReplay(3)
    assert replay.probabilities().tolist() == pytest.approx([1 / 3] * 3)
    index = replay.draw(np.random.default_rng(0))
    replay.record(index, has_crashed=False)
    assert replay.scores[index] == pytest.approx(0.8)
    others = [n for n in range(3) if n != index]
    found = replay.probabilities()
    assert found[index] == pytest.approx(0.9 * 0.8 / 2.8)  # it is not stale
    assert found[others] == pytest.approx([0.9 / 2.8 + 0.1 / 2] * 2)
    replay.record(index, has_crashed=True)
    assert replay.scores[index] == pytest.approx(0.84)
    replay.remove(others[0])
    assert replay.probabilities()[others[0]] == 0
    assert not replay.is_empty
    replay.restart()
    assert replay.scores.tolist() == [1, 1, 1]
    assert replay.probabilities()[index] == pytest.approx(0.5)


class Episodes:
    """Episodes of two steps; a crash whose name is in `bad` cannot be repeated."""

    agent, observation_space, action_space, is_closed = "ego", None, None, False
    invalid = 0
    bad: tuple[int, ...] = ()

    def __init__(self, *words) -> None:
        self.words, self.asked, self.closed = words, [], 0
        self.outcome = None

    def reset_to_crash(self, index):
        self.asked.append(index)
        return f"seen {index}", {"step": 3}, "it differs" if index in self.bad else ""

    def reset_to_plain(self, hunt, seed):
        self.asked.append((hunt, seed))
        if len(self.asked) <= self.invalid:
            raise SimulatorError("invalid", fix="x")
        return "plain", {"step": 0}

    def step(self, action):
        info = {} if self.outcome is None else {"outcome": self.outcome, "has_crashed": self.outcome == "collision"}
        return "next", 1.5, bool(info), False, info

    def close(self):
        self.closed += 1


@pytest.fixture
def make(monkeypatch):
    """Make environments with five crashes, of which the last two are in the test part."""

    def crash(name, seed):
        bundle = SimpleNamespace(path=Path("h") / name, id=name, hunt=Path("h") / str(seed % 2))
        return SimpleNamespace(name=f"h/{name}", seed=seed, bundle=bundle)

    crashes = [crash(f"{n}-x", n) for n in range(5)]

    def split(places, test):
        return SimpleNamespace(
            training=tuple(crashes[:3]), held_out=tuple(crashes[3:]), crashes=tuple(crashes), test=test, places=places
        )

    monkeypatch.setattr(_crash_env, "split_crashes", split)
    monkeypatch.setattr(_crash_env, "CrashEpisodes", Episodes)
    monkeypatch.setattr(_crash_env, "_RemoteCrashEpisodes", lambda *words: ("remote", *words))
    monkeypatch.setattr(_crash_env, "read_settings", lambda path: SimpleNamespace(seed=70 + int(path.parent.name)))
    return lambda *places, **options: CrashEnv(list(places) or "h", process=False, **options)


def test_episodes_get_the_options_and_the_crashes_of_the_training_part(make):
    env = make("a", Path("b"), before_s=3, after_s=4, agent="ego", max_steps=9)
    assert env._episodes.words == (("h/0-x", "h/1-x", "h/2-x"), "ego", 3.0, 4.0, 9)
    assert env.crashes == ("h/0-x", "h/1-x", "h/2-x")
    assert env.scores == dict.fromkeys(env.crashes, 1.0)
    assert env._split.places == ["a", Path("b")]
    assert make()._episodes.words == (("h/0-x", "h/1-x", "h/2-x"), "", 5.0, 10.0, 0)
    env.close()
    assert env._episodes.closed == 1


def test_record_that_cannot_be_written_is_an_error(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(HuntDirectoryError) as caught:
        TrainedOn(test=0.5).write(tmp_path / "file" / "trained_on.json")
    assert caught.value.message == "cannot be written: File exists"
    assert (caught.value.fix, caught.value.where) == (
        "name a file in a writable folder",
        str(tmp_path / "file" / "trained_on.json"),
    )
    (tmp_path / "folder" / "trained_on.json").mkdir(parents=True)
    with pytest.raises(HuntDirectoryError, match="cannot be read: Is a directory"):
        TrainedOn(test=0.5).write(tmp_path / "folder" / "trained_on.json")


def test_record_is_written_only_where_it_grows(tmp_path):
    file = tmp_path / "new" / "trained_on.json"
    TrainedOn(test=0.5, seeds=frozenset({2, 1}), hunt_seeds=frozenset({7})).write(file)
    text = file.read_text()
    assert text.endswith("]\n}\n")
    TrainedOn(test=0.5, seeds=frozenset({1}), hunt_seeds=frozenset({7})).write(file)
    assert file.read_text() == text
    TrainedOn(test=0.5, seeds=frozenset({1}), hunt_seeds=frozenset({8})).write(file)
    assert read_trained_on(file) == TrainedOn(test=0.5, seeds=frozenset({1, 2}), hunt_seeds=frozenset({7, 8}))
    TrainedOn(test=0.5, seeds=frozenset({3})).write(file)
    assert read_trained_on(file).seeds == {1, 2, 3}


def test_record_of_a_training_has_its_seeds(make, tmp_path):
    assert make().trained_on == TrainedOn(test=0.5, seeds=frozenset({0, 1, 2}), hunt_seeds=frozenset({70, 71}))
    for given, file in (("policy", "policy/trained_on.json"), ("own.json", "own.json")):
        make(test=0.3, trained_on=tmp_path / given)
        assert read_trained_on(tmp_path / file).test == 0.3
    make(trained_on="")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["own.json", "policy"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"before_s": 0}, "before_s is 0; give a time above 0"), ({"after_s": math.inf}, "after_s is inf"),
        ({"before_s": "5"}, "before_s is '5'; give a number"), ({"share": 1.1}, "share is 1.1"),
        ({"share": -0.1}, "share is -0.1"), ({"max_steps": 0}, "max_steps is 0"),
        ({"max_steps": 1.5}, "max_steps is 1.5"),
        ({"crash_reward": math.nan}, "crash_reward is nan"), ({"test": 1.0}, "test is 1"), ({"agent": 3}, "agent is 3"),
        ({"render_mode": "human"}, "render_mode is 'human'"), ({"trained_on": 3}, "trained_on is 3"),
        ({"trained_on": "a\0b"}, "trained_on is 'a"), ({"after_s": None}, "after_s is None"),
        ({"share": "x"}, "share is 'x'"), ({"test": None}, "test is None"),
        ({"crash_reward": "a"}, "crash_reward is 'a"),
    ],
)  # fmt: skip
def test_options_out_of_range_are_named(make, options, message):
    with pytest.raises(UsageError) as caught:
        make(**options)
    assert str(caught.value).startswith(message)


@pytest.mark.parametrize("places", [[], 3, [3], None, b"falls"])
def test_places_are_folders(places):
    with pytest.raises(UsageError, match=r"^crashes is (empty|3|\[3\]|None|b'falls')"):
        CrashEnv(places)
    assert _crash_env._places("h") == ["h"]


def test_reset_begins_with_the_crash_that_is_named(make):
    env = make()
    for name in ("h/1-x", "1-x"):
        observation, info = env.reset(options={"crash": name})
        assert (observation, info) == ("seen 1", {"step": 3, "crash": "h/1-x", "seed": 1})
    assert env._episodes.asked == [1, 1]
    for options, message in (
        ({"crash": "3-x"}, "the crash '3-x' is in the test part"), ({"crash": "9-x"}, "there is no crash '9-x'"),
        ({"seed": 3}, "options has 'seed'; give only 'crash'"), (["1-x"], "options is ['1-x']"),
    ):  # fmt: skip
        with pytest.raises(UsageError) as caught:
            env.reset(options=options)
        assert str(caught.value).startswith(message)


@pytest.mark.parametrize(("share", "count"), [(0.0, 0), (1.0, 40), (0.5, 20)])
def test_share_of_the_episodes_begins_with_crashes(make, share, count):
    env = make(share=share)
    infos = [env.reset(seed=5)[1], *(env.reset()[1] for _ in range(39))]
    assert sum(bool(info["crash"]) for info in infos) == pytest.approx(count, abs=8 if share == 0.5 else 0)
    seeds = [info["seed"] for info in infos if not info["crash"]]
    assert not any(is_test_traffic(seed, 0.5) for seed in seeds)
    assert len(set(seeds)) == len(seeds)
    again = make(share=share)
    assert [again.reset(seed=5)[1], *(again.reset()[1] for _ in range(39))] == infos
    assert again.reset(options={"crash": ""})[1]["crash"] == ""


def test_crash_that_cannot_be_repeated_is_not_used_again(make, monkeypatch):
    monkeypatch.setattr(Episodes, "bad", (0, 2))
    env = make(share=1.0)
    with pytest.warns(UserWarning, match="h/[02]-x is not used: it differs") as warned:
        names = {env.reset(seed=1 if not n else None)[1]["crash"] for n in range(30)}
    assert names == {"h/1-x"}
    assert len(warned) == 2
    with pytest.raises(SimulatorError, match="h/0-x is not used: it differs"):
        env.reset(options={"crash": "0-x"})
    monkeypatch.setattr(Episodes, "bad", (0, 1, 2))
    with pytest.warns(UserWarning, match="is not used"), pytest.raises(SimulatorError, match="no crash can be"):
        env.reset()


@pytest.mark.parametrize(("invalid", "works"), [(0, True), (19, True), (20, False)])
def test_plain_episode_is_tried_with_20_seeds(make, monkeypatch, invalid, works):
    monkeypatch.setattr(Episodes, "invalid", invalid)
    env = make(share=0.0)
    if works:
        assert env.reset(seed=1)[0] == "plain"
    else:
        with pytest.raises(SimulatorError, match="invalid"):
            env.reset(seed=1)
    asked = env._episodes.asked
    assert len(asked) == min(20, invalid + 1)
    assert {hunt for hunt, _ in asked} <= {0, 1, 2}
    assert len({seed for _, seed in asked}) == len(asked)


def test_plain_episode_of_a_process_that_has_ended_is_tried_once(make, monkeypatch):
    monkeypatch.setattr(Episodes, "invalid", 5)
    monkeypatch.setattr(Episodes, "is_closed", True)
    env = make(share=0.0)
    with pytest.raises(SimulatorError):
        env.reset(seed=1)
    assert len(env._episodes.asked) == 1


def test_outcome_of_an_episode_counts_for_its_crash_and_its_reward(make):
    env = make(crash_reward=-10.0)
    env.reset(options={"crash": "1-x"})
    assert env.step(0) == ("next", 1.5, False, False, {})
    assert env.scores["h/1-x"] == 1.0
    env._episodes.outcome = "survived"
    assert env.step(0)[1] == 1.5
    assert env.scores == {"h/0-x": 1.0, "h/1-x": pytest.approx(0.8), "h/2-x": 1.0}
    env._episodes.outcome = "collision"
    assert env.step(0)[1] == -8.5
    assert env.scores["h/1-x"] == pytest.approx(0.84)
    env.reset(options={"crash": ""})
    assert env.step(0)[1] == -8.5
    assert env.scores["h/1-x"] == pytest.approx(0.84)  # a plain episode is no crash's
    env.reset(seed=3)
    assert set(env.scores.values()) == {1.0}
