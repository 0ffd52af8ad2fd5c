"""The table of observation parts: words, settings, spaces, and the places of parts in a recorded array."""

from __future__ import annotations

import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given, strategies as st

from crashhunt.base.errors import UsageError
from crashhunt.scenario import AgentSetup
from crashhunt.simulators import PARTS, History, ObservationForm, ObservationLayout, parse_parts
from crashhunt.simulators._observation_layout import modifiers_of
from crashhunt.simulators._scene_observation import SceneObserver


def layout_of(*words):
    return ObservationLayout(parse_parts(words, where="--observe"))


def test_every_part_has_a_space_of_its_shape_and_type():
    for name, part in PARTS.items():
        (one,) = parse_parts([name], where="")
        assert one.space.shape == one.shape
        assert one.space.dtype == np.dtype(part.dtype)
        assert len({column.name for column in part.columns}) == len(part.columns)
        assert bool(part.columns) != bool(part.values)
        assert all(column.low < column.high and np.isfinite([column.low, column.high]).all() for column in part.columns)
        assert one.space.contains(np.zeros(one.shape, part.dtype))  # of an agent that has left
        assert set(part.measured) <= {column.name for column in part.values_of_last_axis}
        for setting in part.settings:
            assert setting.low <= setting.default <= setting.high
            least = setting.choices[0] if setting.choices else f"{setting.low:g}"
            (other,) = parse_parts([f"{name}:{setting.name}={least}"], where="")
            assert other.settings == {**one.settings, setting.name: setting.low}


def test_columns_are_those_of_the_documented_table():
    words = {
        "ego": "x y heading speed acceleration yaw_rate steering length width lane_index lane_offset distance time",
        "actors": "present x y heading vx vy acceleration length width kind same_lane ahead lane_offset brake_light "
        "indicator",
        "lanes": "present x y heading width speed_limit",
        "route": "present x y heading speed_limit lane_index",
        "route_state": "distance_left lane_changes_needed distance_to_lane_change goal_x goal_y",
        "signals": "present state distance time_in_state",
        "right_of_way": "present must_yield stop_line_distance conflict_distance other_distance other_speed "
        "other_arrival stop_sign",
        "stop_line": "present distance must_yield stop_sign signal",
        "speed_limit": "speed_limit",
        "predictions": "x y yaw speed",
        "prediction_covariance": "var_x var_y cov_xy",
        "crossings": "present distance must_yield persons nearest",
    }  # fmt: skip
    assert {name: [column.name for column in PARTS[name].columns] for name in words} == {
        name: text.split() for name, text in words.items()
    }
    assert set(PARTS) - set(words) == {"lidar2d", "grid", "image", "actor_ids", "time_to_switch"}


def test_relation_adds_columns_behind_the_others():
    plain, wide = (layout_of(word) for word in ("actors:rows=2", "actors:rows=2:relation=true"))
    names = [*wide.columns["actors"]]
    assert names == [*plain.columns["actors"], "left", "right", "oncoming", "crossing"]
    assert wide.shapes["actors"] == wide.space["actors"].shape == (2, len(names))
    assert wide.describe()["actors"]["columns"] == names


@given(
    st.lists(st.sampled_from(sorted(set(PARTS) - {"image", "grid"})), min_size=1, max_size=4, unique=True), st.data()
)
def test_recorded_array_is_what_gymnasium_flattens(names, data):
    layout = layout_of(*names)
    seed = data.draw(st.integers(0, 99))
    layout.space.seed(seed)
    shown = {
        name: np.random.default_rng(seed).uniform(size=box.shape).astype(box.dtype)
        for name, box in layout.space.spaces.items()
    }
    flat = layout.flat(shown)
    assert flat.tobytes() == spaces.flatten(layout.space, shown).tobytes()
    assert not flat.flags.writeable  # the agent cannot change what has been recorded
    restored = layout.restore(flat)
    assert list(restored) == list(layout.space.spaces)
    assert all(restored[name].tobytes() == shown[name].tobytes() for name in names)
    assert ObservationForm(layout.space).space == layout.flat_space


@pytest.mark.parametrize("part", ["ego", "actor_ids", "grid", "image"])
def test_arrays_of_every_type_are_read_only(part):
    layout = layout_of("ego", "actor_ids", "grid", "image")
    shown = layout.restore(layout.flat({name: np.zeros(shape) for name, shape in layout.shapes.items()}))
    assert shown[part].dtype == layout.space[part].dtype
    with pytest.raises(ValueError, match="read-only"):
        shown[part][...] = 1


def test_columns_give_the_index_of_each_column():
    layout = layout_of("ego", "actors:rows=2", "lidar2d:rays=3")
    assert layout.columns["ego"]["speed"] == 3
    assert layout.columns["lidar2d"] == {}
    assert layout.describe()["actors"]["shape"] == [2, 15]
    assert layout.describe()["lidar2d"] == {"shape": [3], "columns": [], "units": ["m"]}
    assert layout.reach_m == 100.0
    assert not layout.blank().any()
    assert layout.blank().shape == layout.flat_space.shape == (13 + 30 + 3,)


@pytest.mark.parametrize(
    ("words", "message", "fix"),
    [
        (["egoo"], "--observe: 'egoo' is not a part of observations", "did you mean 'ego'?"),
        ([""], "--observe: '' is not a part of observations", "give one of"),
        (["ego", "ego"], "--observe names the part 'ego' twice", "name each part once"),
        (["ego:rows=3"], "--observe: ego has no setting 'rows'", "it has no settings"),
        (["actors:row=3"], "--observe: actors has no setting 'row'", "did you mean 'rows'? it has rows, radius"),
        (["actors:rows=0"], "--observe: actors:rows is '0'", "give a whole number within 1 and 1000"),
        (["actors:rows=2.5"], "--observe: actors:rows is '2.5'", "give a whole number within 1 and 1000"),
        (["actors:radius=nan"], "--observe: actors:radius is 'nan'", "give a number in m within 1 and 120"),
        (["actors:radius"], "--observe: actors:radius is ''", "give a number in m within 1 and 120"),
        (["actors:rows=2:rows=3"], "--observe: actors has the setting 'rows' twice", "name each setting once"),
        (
            ["image:rows=1000:columns=1000", "history=4"],
            "--observe: an observation has 12,000,000 numbers",
            "at most 10,000,000 numbers",
        ),
        (["kinematics", "ego"], "--observe names kinematics and parts: kinematics,ego", "name kinematics alone"),
    ],
)
def test_wrong_words_are_refused_in_one_line(words, message, fix):
    with pytest.raises(UsageError) as refused:
        parse_parts(words, where="--observe")
    assert refused.value.message == message
    assert fix in refused.value.fix
    assert "\n" not in str(refused.value)


def test_part_that_a_simulator_lacks_is_refused():
    with pytest.raises(UsageError, match="has no part 'lanes'") as refused:
        parse_parts(["lanes"], ["ego"], where="--observe")
    assert refused.value.fix == "give one of ego, history, occlusion, reference_point, kinematics"
    with pytest.raises(UsageError, match="has no part 'ego'") as refused:
        parse_parts(["ego"], [], where="--observe")
    assert "omit it" in refused.value.fix
    assert parse_parts(["kinematics"], ["ego"], where="") == ()


def test_errors_change_what_is_measured_and_nothing_else():
    layout = layout_of("ego", "actors:rows=2", "lidar2d:rays=3")
    shown = layout.restore(layout.blank().copy())
    shown = {name: array.copy() for name, array in shown.items()}
    ego, actors = layout.columns["ego"], layout.columns["actors"]
    shown["ego"][[ego["x"], ego["speed"], ego["length"]]] = 1000.0, 10.0, 5.0
    shown["actors"][0, [actors["present"], actors["x"], actors["vx"], actors["heading"]]] = 1.0, 1010.0, 8.0, 1.5
    shown["lidar2d"][:] = 50.0, 60.0, 115.0
    factors = np.full(layout.flat_space.shape, 1.1)
    wrong = layout.restore(layout.with_errors(layout.flat(shown), factors, (1000.0, 0.0)))
    assert wrong["ego"][[ego["x"], ego["speed"], ego["length"]]].tolist() == [1000.0, 11.0, 5.0]
    row = wrong["actors"][0]
    assert row[[actors["present"], actors["heading"]]].tolist() == [1.0, 1.5]
    # 10 m ahead of a vehicle at 1000 m is seen at 11 m, and not at 1111 m.
    assert row[[actors["x"], actors["vx"]]] == pytest.approx([1011.0, 8.8])
    assert not wrong["actors"][1].any()  # an absent row stays 0
    assert wrong["lidar2d"] == pytest.approx([55.0, 66.0, 120.0])  # within the space


def test_history_stacks_the_last_observations_with_the_present_one_last():
    words = ["ego", "history=3", "lidar2d:rays=2"]
    assert modifiers_of(words) == modifiers_of(["history:steps=3"]) == {"history": 3}
    layout = ObservationLayout(parse_parts(words, where=""), modifiers_of(words))
    assert {name: box.shape for name, box in layout.space.spaces.items()} == {"ego": (3, 13), "lidar2d": (3, 2)}
    assert layout.describe()["ego"]["shape"] == [3, 13]
    history, seen = History(layout), []
    for step in range(4):
        shown = layout.restore(layout.flat(history.add({"ego": np.full(13, step), "lidar2d": np.full(2, 10.0 + step)})))
        seen.append(shown["ego"][:, 0].tolist())
    assert seen == [[0, 0, 0], [0, 0, 1], [0, 1, 2], [1, 2, 3]]
    assert shown["lidar2d"].tolist() == [[11, 11], [12, 12], [13, 13]]
    assert layout.columns["ego"]["y"] == 1  # of the last axis, as without a history
    assert modifiers_of(["ego"]) == {}
    assert modifiers_of(["ego", "history"]) == {"history": 4}
    for wrong, message in (
        (["history"], "names history and no part"),
        (["ego", "history:steps=0"], "history:steps is '0'"),
        (["ego", "history=0"], "history:steps is '0'"),
        (["ego", "reference_point=nose"], "reference_point:at is 'nose'; give one of center, rear_axle, front_bumper"),
        (
            ["ego", "reference_point:at=nose"],
            "reference_point:at is 'nose'; give one of center, rear_axle, front_bumper",
        ),
        (["occlusion"], "names occlusion and no part"),
    ):
        with pytest.raises(UsageError, match=message):
            parse_parts(wrong, where="--observe")


@pytest.mark.parametrize("word", ["predictions:along=lanes", "actors:relation=true"])
def test_what_needs_the_lanes_of_actors_is_refused_where_there_are_no_lanes(word):
    message = rf"agents\.ego\.observation: the simulator of this scenario does not have '{word}'"
    with pytest.raises(UsageError, match=message):
        SceneObserver({"ego": AgentSetup(observation=(word,))})
    SceneObserver({"ego": AgentSetup(observation=("actors:relation=false",))})
    SceneObserver({"ego": AgentSetup(observation=("predictions:along=heading",))})
