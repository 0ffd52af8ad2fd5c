"""Agents that are FMUs: their variables, their parameters, and what they cannot be."""

from __future__ import annotations

import re
import zipfile
from dataclasses import replace

import numpy as np
import pytest
from conftest import one_in
from programs import COMPILER
from simulated import Simulated, answers_in_python, observations

pytest.importorskip("fmpy", reason="FMPy is not installed", exc_type=ImportError)

from built_fmus import COLUMNS, build_fmu, described_by_fmi_2

from crashhunt.agents import FmuFactory
from crashhunt.base import forks
from crashhunt.base.errors import ActionError, PluginError, ProgramError
from crashhunt.simulators import SpeedAndLaneChange
from crashhunt.trial import Range, signature_of

pytestmark = pytest.mark.skipif(COMPILER is None, reason="there is no C compiler")


def agent_of(fmu, *, limit_s=None, **arguments):
    factory = FmuFactory(f"fmu:{fmu}")
    agent = factory.agent("ego", Simulated(), arguments, folder=fmu.parent, files={}, limit_s=limit_s)
    agent.reset(2**63 + 5)
    return agent


@pytest.mark.parametrize("version", [2, 3])
def test_an_fmu_acts_like_the_agent_in_python_in_each_of_its_instances(tmp_path, version):
    agent = agent_of(build_fmu(tmp_path, version), speed=9.125)
    for seed in (1, 2):
        agent.reset(seed)
        answers = [agent.act(seen) for seen in observations()]
        assert answers == answers_in_python(speed=9.125)
        assert [type(part) for part in answers[0]] == [float, int]
    assert {speed for speed, _ in answers} == {0.0, 9.125}
    agent.close()
    agent.close()


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize("has_state", [False, True])
def test_a_fork_has_the_state_of_an_fmu_whether_or_not_the_fmu_offers_it(tmp_path, version, has_state):
    agent = agent_of(build_fmu(tmp_path, version, has_state=has_state), harm=5)
    seen, known = observations(12), replace(forks.held(), threads=forks.threads())
    before = [agent.act(each) for each in seen[:4]]
    copies = [forks.Copy(lambda: {"actions": [agent.act(each)[0] for each in seen[4:]]}, known) for _ in range(2)]
    answers = [copy.answer(20)["actions"] for copy in copies]
    after = [agent.act(each)[0] for each in seen[4:]]
    agent.close()
    assert answers == [after, after]
    assert [*(action[0] for action in before), *after] == [12.0 - step / 8 for step in range(1, 13)]


def test_a_table_names_the_sources_of_inputs_and_of_the_action(tmp_path):
    fmu = build_fmu(tmp_path, 2, place="other_{row}_{column}", speed="v")
    rows = [
        f'other_{row}_{column} = "kinematics[{row}].{column}"'
        for row in range(1, 8)
        for column in COLUMNS
        if column[0] not in "cs"
    ]
    rows += [f"other_{row}_{column} = 0.0" for row in range(1, 8) for column in ("cos_h", "sin_h")]
    table = ["[inputs]", *rows, "[action]", 'target_speed = "v"', "lane_change = 1"]
    (tmp_path / "planner.toml").write_text("\n".join(table), encoding="utf-8")
    agent = agent_of(fmu, speed=9.125)
    actions = [agent.act(seen) for seen in observations()]
    assert set(actions) == {(0.0, 1), (9.125, 1)}


KM_H = '<Unit name="km/h"><BaseUnit m="1" s="-1" factor="0.25"/></Unit><Unit name="m/s"/>'  # 0.25: exact in doubles
DECIMETRES = '<Unit name="dm"><BaseUnit m="1" factor="0.125" offset="1"/></Unit>'


def with_units(definitions, output="", place=""):
    """A description whose output, and whose input for the place of the first actor, have units."""
    made = described_by_fmi_2("kinematics[{row}].{column}", "target_speed")
    made = made.replace('<Unit name="m/s"/>', definitions)
    made = made.replace('causality="output"><Real/>', f'causality="output"><Real unit="{output}"/>')
    return re.sub(r'(name="kinematics\[1\]\.x".*?start="0")', rf'\1 unit="{place}"', made, count=1)


def test_values_are_converted_between_the_units_of_an_fmu_and_those_of_the_simulator(tmp_path):
    (tmp_path / "plain").mkdir()
    seen = np.zeros((8, 7), np.float32)
    seen[1, :3] = 1, 3.0, 0.0
    plain = agent_of(build_fmu(tmp_path / "plain", 2), speed=16.0)
    converting = agent_of(build_fmu(tmp_path, 2, description=with_units(KM_H + DECIMETRES, "km/h", "dm")), speed=16.0)
    assert (plain.act(seen)[0], converting.act(seen)[0]) == (0.0, 4.0)  # 3 m are 16 dm here, which is far enough
    seen[1, 1] = 2.25  # 10 dm
    assert converting.act(seen)[0] == 0.0
    unconverted = agent_of(tmp_path / "plain" / "planner.fmu", speed=-0.0)
    assert str(unconverted.act(np.zeros_like(seen))[0]) == "-0.0"  # the same bits, which digests contain


@pytest.mark.parametrize("unit", ["1", "-"])
def test_a_variable_without_a_unit_has_that_of_the_simulator(tmp_path, unit):
    agent_of(build_fmu(tmp_path, 2, description=with_units(f'{KM_H}<Unit name="{unit}"/>', unit, unit)))


@pytest.mark.parametrize("base", ['m="2"', 'm="1" rad="1"', 'm="1" kg="1"', 'm="1" factor="0"', ""])
def test_a_unit_that_cannot_be_converted_is_refused(tmp_path, base):
    definition = f'<Unit name="dm"><BaseUnit {base}/></Unit>' if base else '<Unit name="dm"/>'
    fmu = build_fmu(tmp_path, 2, description=with_units(KM_H + definition, "km/h", "dm"))
    message = "its variable kinematics[1].x has the unit dm, which cannot be converted to m; export it with the unit m"
    with pytest.raises(PluginError, match=re.escape(message)):
        agent_of(fmu)


def test_parameters_are_arguments_with_their_units_and_bounds(tmp_path):
    arguments = signature_of(FmuFactory(f"fmu:{build_fmu(tmp_path, 2)}")).arguments
    speed = arguments["speed"]
    assert (speed.default, speed.unit, speed.distribution) == (12.0, "m/s", Range(8.0, 20.0))
    assert (arguments["harm"].default, arguments["harm"].distribution) == (0, None)
    assert arguments.keys() == {"speed", "harm"}


@pytest.mark.parametrize("bounds", [("-1.7976931348623157E308", "1.7976931348623157E308"), ("-INF", "INF")])
def test_limits_of_a_type_are_no_range_of_a_parameter(tmp_path, bounds):
    fmu = build_fmu(tmp_path, 2, description=described_with_bounds(*bounds))
    assert signature_of(FmuFactory(f"fmu:{fmu}")).arguments["speed"].distribution is None


def test_bounds_in_the_wrong_order_are_refused_with_the_name_of_the_fmu(tmp_path):
    fmu = build_fmu(tmp_path, 2, description=described_with_bounds("20.0", "8.0"))
    with pytest.raises(PluginError, match=f"^'fmu:{fmu}': its parameter speed: the range '20.0:8.0' begins above"):
        FmuFactory(f"fmu:{fmu}").declared_signature()


def described_with_bounds(low, high):
    described = described_by_fmi_2("kinematics[{row}].{column}", "target_speed")
    return described.replace('min="8.0" max="20.0"', f'min="{low}" max="{high}"')


def test_the_parts_that_inputs_need_are_observed(tmp_path):
    assert signature_of(FmuFactory(f"fmu:{build_fmu(tmp_path, 2)}")).observation == ()
    fmu = build_fmu(tmp_path, 2, place="actors[{row}].{column}")
    (tmp_path / "planner.toml").write_text('[inputs]\n"actors[1].x" = "ego.speed"\n"actors[1].y" = 5', "utf-8")
    assert signature_of(FmuFactory(f"fmu:{fmu}")).observation == ("actors", "ego")


@pytest.mark.parametrize("version", [2, 3])
def test_a_failure_is_an_error_that_names_the_agent_and_the_function(tmp_path, version):
    agent = agent_of(build_fmu(tmp_path, version), harm=1)
    message = f"ego: the FMU has failed in step 1: fmi{version}DoStep failed with status 3 (error)"
    with pytest.raises(ProgramError, match=f"^{re.escape(message)}"):
        agent.act(observations()[0])
    agent.close()


def test_an_fmu_that_asks_to_end_the_simulation_is_an_error_of_the_agent(tmp_path):
    agent = agent_of(build_fmu(tmp_path, 3), harm=6)
    with pytest.raises(ProgramError, match=r"^ego: the FMU asks to end the simulation in step 1$"):
        agent.act(observations()[0])


def test_an_action_that_is_not_a_number_is_left_to_the_check_of_all_agents(tmp_path):
    with pytest.raises(ActionError):
        SpeedAndLaneChange().encode(agent_of(build_fmu(tmp_path, 2), harm=2).act(observations()[0]))


A_TEXT = described_by_fmi_2("kinematics[{row}].{column}", "target_speed").replace(
    '<Enumeration declaredType="Lane"/>', "<String/>"
)


@pytest.mark.parametrize(
    ("options", "table", "message"),
    one_in(
        3,
        [
            ({"machine": "win64"}, "", "it has no binary for linux64 (it has: win64)"),
            ({"description": "<fmi"}, "", "it is not an FMU: "),
            ({"place": "row{row}.{column}"}, "", "its input row1.presence has no source: an observation has no place"),
            ({"place": "kinematics[8{row}].{column}"}, "", "no place 'kinematics[81].presence'"),
            ({"place": "kinematics[{row}].a{column}"}, "", "no place 'kinematics[1].apresence'"),
            ({"speed": "v"}, "", "no output has the name target_speed, which is a value of the action"),
            ({}, "[inputs]\nx = 1", "it has no input x (it has: "),
            ({}, '[action]\nspeed = "v"', "an action has no value speed (it has: target_speed, lane_change, "),
            (
                {},
                '[action]\ntarget_speed = "v"',
                "it has no output v for target_speed (it has: lane_change, target_speed)",
            ),
            ({}, '[inputs]\n"kinematics[1].x" = "kinematics[1]"', "kinematics[1].x has 1 values, and its place 7"),
            ({}, "[outputs]\nx = 1", "planner.toml has outputs (allowed: the tables inputs, action)"),
            ({}, "[inputs", "planner.toml cannot be read: "),
            ({"description": A_TEXT}, "", "its variable lane_change is of type String, which is no number"),
        ],
    ),
)
def test_an_fmu_that_does_not_fit_is_refused_in_one_line(tmp_path, options, table, message):
    fmu = build_fmu(tmp_path, 2, **options)
    if table:
        (tmp_path / "planner.toml").write_text(table, encoding="utf-8")
    with pytest.raises(PluginError, match=re.escape(message)) as refused:
        FmuFactory(f"fmu:{fmu}").agent("ego", Simulated(), {}, folder=tmp_path, files={})
    assert "\n" not in str(refused.value)


def test_a_file_that_is_no_fmu_is_refused(tmp_path):
    (tmp_path / "a.fmu").write_text("no archive", encoding="utf-8")
    with zipfile.ZipFile(tmp_path / "b.fmu", "w") as archive:
        archive.writestr("readme.txt", "empty")
    for name, message in {"a.fmu": "it is not an FMU", "b.fmu": "it is not an FMU", "c.fmu": "is not a file"}.items():
        with pytest.raises(PluginError, match=message):
            signature_of(FmuFactory(f"fmu:{tmp_path / name}"))


@pytest.mark.parametrize(
    ("length", "message"),
    [
        (
            7,
            "it cannot be loaded: Failed to load shared library binaries/linux64/planner.so. binaries/linux64/pl",
        ),
        (5000, "its planner.so is cut: it is shorter than its headers say; export it"),
    ],
)
def test_a_damaged_binary_is_refused_without_a_path_of_the_scratch_folder(tmp_path, monkeypatch, length, message):
    monkeypatch.chdir(tmp_path)  # FMPy leaves the process in the folder of a library that cannot be loaded
    with zipfile.ZipFile(build_fmu(tmp_path, 2)) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(tmp_path / "cut.fmu", "w") as archive:
        for name, data in files.items():
            archive.writestr(name, data[:length] if name.endswith(".so") else data)
    with pytest.raises(PluginError, match=re.escape(f"cut.fmu': {message}")):
        agent_of(tmp_path / "cut.fmu")


def test_a_step_that_takes_too_long_is_an_error_of_the_agent(tmp_path):
    agent = agent_of(build_fmu(tmp_path, 2), limit_s=0.05, harm=4)
    with pytest.raises(ProgramError, match=r"^ego: doStep of the FMU has not returned within 0\.05 s in step 1$"):
        agent.act(observations(1)[0])
    agent.close()
