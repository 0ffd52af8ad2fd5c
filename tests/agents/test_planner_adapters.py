"""Adapters of planners from PyPI: they are short, and with the planner's package they drive and replay."""

from __future__ import annotations

import ast
import io
import runpy
import sys
import tokenize
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest

import crashhunt
from crashhunt.agents import planners
from crashhunt.simulators import PARTS

ADAPTERS = sorted(path for path in Path(planners.__file__).parent.glob("*.py") if path.name != "__init__.py")
MAX_LINES = 60  # what a user can be asked to write
PLANNERS = {  # the class of an adapter, the package that it needs, and its form of actions
    "fiss_agent:FissPlanner": ("fiss_planner", "trajectory"),
    "fiss_agent:FopPlanner": ("fiss_planner", "trajectory"),
    "frenetix_agent:Frenetix": ("frenetix", "trajectory"),
    "mpc_agent:Mpc": ("osqp", "acceleration_steering"),
}
PACKAGES = {  # what an adapter may import beside NumPy and the standard library; SciPy comes with OSQP
    "commonroad_program": {"commonroad", "commonroad_clcs", "commonroad_dc", "commonroad_rp"},
    "fiss_agent": {"fiss_planner"},
    "frenetix_agent": {"frenetix"},
    "mpc_agent": {"osqp", "scipy"},
}


@pytest.mark.parametrize("path", ADAPTERS, ids=lambda path: path.stem)
def test_adapter_imports_only_its_planner(path):
    nodes = list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
    names = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
    names |= {node.module for node in nodes if isinstance(node, ast.ImportFrom)}
    assert {name.split(".")[0] for name in names} - sys.stdlib_module_names <= PACKAGES[path.stem] | {"numpy"}


@pytest.mark.parametrize("path", ADAPTERS, ids=lambda path: path.stem)
def test_adapter_has_at_most_60_lines_of_code(path):
    kinds = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}
    tokens = tokenize.generate_tokens(io.StringIO(path.read_text(encoding="utf-8")).readline)
    lines = {line for token in tokens if token.type not in kinds for line in range(token.start[0], token.end[0] + 1)}
    assert len(lines) <= MAX_LINES


def test_fiss_predicts_each_actor_by_its_columns(monkeypatch):
    monkeypatch.setitem(sys.modules, "fiss_planner", planner := MagicMock())
    kind = runpy.run_path(str(Path(planners.__file__).with_name("fiss_agent.py")))["FissPlanner"]
    agent = kind(MagicMock(route=[], lanes={}, stop_lines=[]), MagicMock(max_steering=0.5, wheelbase=3.0))
    plan = agent.planner.step.return_value.trajectory
    plan.t, plan.x, plan.y, plan.yaw, plan.v = np.zeros((5, 2))
    value = {one.name: 10.0 + number for number, one in enumerate(PARTS["actors"].columns)} | {"vx": 3.0, "vy": 4.0}
    row = np.array([[*value.values()]])
    agent.act({"ego": np.ones(13), "actor_ids": np.array([7]), "actors": row, "signals": np.zeros((0, 4))})
    place = value["x"], value["y"], value["heading"], 5.0, value["length"], value["width"]
    assert planner.predict_lane_following.call_args.args == (agent.roads, 7, *place, 6.0, 0.1)


@pytest.mark.nightly
@pytest.mark.parametrize("scenario", ["intersection", "motorway"])
@pytest.mark.parametrize("name", PLANNERS)
def test_trial_of_a_planner_is_bit_identical_in_a_new_process(name, scenario, tmp_path):
    package, action = PLANNERS[name]
    pytest.importorskip(package)
    agent = f"crashhunt.agents.planners.{name}"
    options = {"scenario": scenario, "agents": {"ego": agent}, "action": action, "seed": 1, "audit": 1.0}
    report = crashhunt.run(tmp_path / "h", 1, 1, 40, **options)
    assert (report.outcomes, report.trial_steps) == ({"survived": 1}, 40)
    # The trial was run again in a new process, and compared bit by bit.
    assert (report.audit.trials, report.audit.differences, report.audit.not_finished) == (1, (), 0)


@pytest.mark.nightly
@pytest.mark.parametrize("gap_m", [2.1, 4.0])
def test_frenetix_brakes_although_its_costs_prefer_to_drive_through_the_vehicle_ahead(gap_m):
    pytest.importorskip("frenetix")
    from crashhunt.agents.planners.frenetix_agent import Frenetix

    times = np.arange(1, 31) * 0.1
    route, actors = np.zeros((60, 6)), np.zeros((9, 15))
    route[:, 0], route[:, 1], route[:, 4] = 1.0, np.arange(-20, 100, 2), 13.9
    actors[0, :9] = 1.0, 5.0 + gap_m, 0.0, 0.0, 1.6, 0.0, 0.0, 5.0, 1.8
    predictions, covariance = np.zeros((9, 30, 4)), np.zeros((9, 30, 3))
    predictions[0, :, 0], predictions[0, :, 3] = 5.0 + gap_m + 1.6 * times, 1.6
    covariance[0, :, 0], covariance[0, :, 1] = (0.3 * times) ** 2, (0.1 * times) ** 2
    seen = {
        "ego": np.array([0.0, 0.0, 0.0, 5.7, -2.0, 0.0, 0.0]), "actors": actors, "route": route,
        "predictions": predictions, "prediction_covariance": covariance,
    }  # fmt: skip
    vehicle = SimpleNamespace(length=5.0, width=1.8, rear_axle_offset=1.5, wheelbase=3.0)
    agent = Frenetix(SimpleNamespace(reference_path=route[:, 1:3]), vehicle, 19.0)
    plan = agent.act(seen)
    assert plan[5, 4] < 4.0
    assert (np.diff(plan[:10, 4]) < 0).all()


@pytest.mark.nightly
def test_frenetix_brakes_straight_on_where_no_curve_is_feasible():
    pytest.importorskip("frenetix")
    from crashhunt.agents.planners.frenetix_agent import Frenetix

    path = np.column_stack([np.arange(-20.0, 100.0, 2.0), np.zeros(60)])
    route = np.zeros((60, 6))
    route[:, 0], route[:, 1], route[:, 4] = 1.0, path[:, 0], 13.9
    seen = {
        "ego": np.array([0.0, 0.0, 1.5, 8.0, 0.0, 0.0, 0.0]), "actors": np.zeros((9, 15)), "route": route,
        "predictions": np.zeros((9, 30, 4)), "prediction_covariance": np.zeros((9, 30, 3)),
    }  # fmt: skip
    vehicle = SimpleNamespace(length=5.0, width=1.8, rear_axle_offset=1.5, wheelbase=3.0)
    plan = Frenetix(SimpleNamespace(reference_path=path), vehicle).act(seen)
    assert (plan[:, 3] == 1.5).all()
    assert plan[:, 4] == pytest.approx(np.maximum(8.0 - 8.0 * plan[:, 0], 0.0))
    assert np.hypot(*plan[-1, 1:3]) == pytest.approx(4.0)  # v² / 2a


def test_mpc_keeps_its_distance_from_the_side_of_a_truck_that_crosses():
    """Half of the truck's length is not in the way along the route, and far more than its width is across it."""
    module = pytest.importorskip("crashhunt.agents.planners.mpc_agent", exc_type=ImportError)
    path = np.column_stack([np.arange(0.0, 100.0, 1.0), np.zeros(100)])
    vehicle = SimpleNamespace(length=5.0, width=1.8, wheelbase=2.8)
    agent = module.Mpc(SimpleNamespace(reference_path=path), vehicle, gap=4.0)
    agent.reset(1)
    actors = np.zeros((2, 9))
    actors[0] = [1.0, 8.0, -5.0, np.pi / 2, 0.0, 0.0, 0.0, 12.0, 2.5]  # its front is 1 m across the route
    paths = np.tile([8.0, -5.0, np.pi / 2, 0.0], (2, module.STEPS, 1))
    room = agent.room(actors, paths)
    assert room == pytest.approx(np.full(module.STEPS, 8.0 - 2.5 / 2 - 5.0 / 2 - 4.0))
    paths[0, :, 1] = -8.0  # it stands 2 m beside the route
    assert (agent.room(actors, paths) > 900.0).all()
