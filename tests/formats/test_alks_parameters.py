"""Scenarios from the parameters of OpenSCENARIO files of the test cases of UN R157."""

from __future__ import annotations

import json

import numpy as np
import pytest

from crashhunt.errors import CrashhuntError
from crashhunt.formats import scenario_from_openscenario
from crashhunt.scenario import load_scenario
from crashhunt.testing._kinematic_cases import solve

HEAD = '<OpenSCENARIO><FileHeader revMajor="1" revMinor="1" description="Cut in"/>'
CUT_IN = {
    "Ego_InitSpeed_Ve0_kph": "60.0",
    "CutInVehicle_Model": "car",
    "CutInVehicle_InitPosition_RelativeLaneId": "-1",
    "CutInVehicle_RelativeInitSpeed_Ve0_Vo0_kph": "-20.0",
    "CutInVehicle_HeadwayDistanceTrigger_dx0_m": "30.0",
    "CutInVehicle_LaneChange_MaxLateralVelocity_Vy_mps": "2.0",
}


def template(values):
    declared = "".join(
        f'<ParameterDeclaration name="{name}" parameterType="double" value="{value}"/>'
        for name, value in values.items()
    )
    return f"{HEAD}<ParameterDeclarations>{declared}</ParameterDeclarations></OpenSCENARIO>"


def variation(parts, kind="Deterministic"):
    file = '<ScenarioFile filepath="./template.xosc"/>'
    return (
        f"{HEAD}<ParameterValueDistribution>{file}<{kind}>{parts}</{kind}></ParameterValueDistribution></OpenSCENARIO>"
    )


def single(name, low, high, step):
    return (
        f'<DeterministicSingleParameterDistribution parameterName="{name}"><DistributionRange stepWidth="{step}">'
        f'<Range lowerLimit="{low}" upperLimit="{high}"/></DistributionRange>'
        "</DeterministicSingleParameterDistribution>"
    )


@pytest.fixture
def made(tmp_path):
    def make(text):
        (tmp_path / "template.xosc").write_text(template(CUT_IN))
        (tmp_path / "v.xosc").write_text(text)
        return scenario_from_openscenario(tmp_path / "v.xosc", tmp_path / "made")

    return make


def arguments(made):
    return {name: (one.default, one.range) for name, one in load_scenario(str(made.directory)).arguments.items()}


def test_declared_parameters_are_constants(made):
    found = made(template(CUT_IN))
    assert found.scenario == "r157-cut-in"
    assert found.not_read == ("CutInVehicle_Model (car)",)
    read = {name: value for name, (value, _) in arguments(found).items()}
    assert read == {"ego_kmh": 60, "slower_kmh": 20, "gap_m": 30.0, "lateral_mps": 2.0, "side": -1}
    assert {name: known for name, (_, known) in arguments(found).items() if known} == {}


def test_ranges_and_sets_of_a_variation_become_ranges_of_arguments(made):
    parts = (
        single("CutInVehicle_RelativeInitSpeed_Ve0_Vo0_kph", -50, -10, 10)
        + single("CutInVehicle_Acceleration_Rate_mps2", -3, 3, 1.5)
        + '<DeterministicSingleParameterDistribution parameterName="CutInVehicle_InitPosition_RelativeLaneId">'
        '<DistributionSet><Element value="1"/><Element value="-1"/></DistributionSet>'
        "</DeterministicSingleParameterDistribution>"
        "<DeterministicMultiParameterDistribution><ValueSetDistribution><ParameterValueSet>"
        '<ParameterAssignment parameterRef="a" value="1"/></ParameterValueSet></ValueSetDistribution>'
        "</DeterministicMultiParameterDistribution>"
    )
    found = made(variation(parts))
    assert found.read["CutInVehicle_RelativeInitSpeed_Ve0_Vo0_kph"] == "slower_kmh = 10:50:10"
    assert found.read["CutInVehicle_InitPosition_RelativeLaneId"] == "side = 1|-1"
    assert str(arguments(found)["slower_kmh"][1]) == "10:50:10"
    assert "CutInVehicle_Acceleration_Rate_mps2 (-3:3:1.5)" in found.not_read
    assert any(one.startswith("DeterministicMultiParameterDistribution of a: ") for one in found.not_read)


def test_uniform_distributions_are_read_and_others_are_named(made):
    parts = (
        '<StochasticDistribution parameterName="CutInVehicle_HeadwayDistanceTrigger_dx0_m"><UniformDistribution>'
        '<Range lowerLimit="0" upperLimit="60"/></UniformDistribution></StochasticDistribution>'
        '<StochasticDistribution parameterName="Ego_InitSpeed_Ve0_kph"><NormalDistribution expectedValue="50"/>'
        "</StochasticDistribution>"
    )
    found = made(variation(parts, "Stochastic"))
    assert found.read["CutInVehicle_HeadwayDistanceTrigger_dx0_m"] == "gap_m = 0:60"
    assert "Ego_InitSpeed_Ve0_kph: only a uniform distribution is read, not NormalDistribution" in found.not_read


def test_missing_template_is_named(made, tmp_path):
    (tmp_path / "v.xosc").write_text(variation(single("FrontOfLead_Distance_dx0_f_m", 10, 100, 10)))
    found = scenario_from_openscenario(tmp_path / "v.xosc", tmp_path / "made")
    assert found.scenario == "r157-cut-out"
    assert "defaults of ./template.xosc: cannot be read" in found.not_read[0]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is not valid XML"),
        ("<OpenDRIVE/>", "is <OpenDRIVE>, not <OpenSCENARIO>"),
        (
            template({"Ego_InitSpeed_Ve0_kph": "60"}),
            "the parameters are of no test case that crashhunt knows: Ego_Init",
        ),
        (template({}), "the parameters are of no test case that crashhunt knows: none"),
        (template({"FrontOfLead_Distance_dx0_f_m": "$x"}), "no parameter has a number that can be read"),
        (template({"FrontOfLead_Distance_dx0_f_m": "nan"}), "no parameter has a number that can be read"),
    ],
)
def test_file_of_another_kind_is_refused_and_nothing_is_written(made, tmp_path, text, message):
    with pytest.raises(CrashhuntError, match=message):
        made(text)
    assert not (tmp_path / "made").exists()


def test_folder_with_files_is_refused(made, tmp_path):
    (tmp_path / "made").mkdir()
    (tmp_path / "made" / "mine").write_text("x")
    with pytest.raises(CrashhuntError, match="not empty"):
        made(template(CUT_IN))
    assert (tmp_path / "made" / "mine").exists()


@pytest.mark.parametrize(("gap", "lateral", "avoids"), [(30.0, 2.0, True), (10.0, 3.0, False)])
def test_careful_human_avoids_the_avoidable_case_of_asam_and_not_the_unavoidable_one(gap, lateral, avoids):
    """The cases 4.4_1 and 4.4_2 of the public ALKS scenarios, by their templates."""
    columns = {"ego_kmh": 60.0, "other_kmh": 40.0, "gap_m": gap, "lateral_mps": lateral}
    found = solve("cut_in", {name: np.array([value]) for name, value in columns.items()}, "cc_human")
    assert (found["cc_human"][0] == 0) == avoids


def test_command_lists_parameters_that_are_not_read(shell):
    (shell.folder / "v.xosc").write_text(template(CUT_IN))
    out = shell.crashhunt("init", "made", "--xosc", "v.xosc").out
    assert "CutInVehicle_RelativeInitSpeed_Ve0_Vo0_kph: slower_kmh = 20" in out
    assert "Not read:\n  CutInVehicle_Model (car)" in out
    made = json.loads(shell.crashhunt("init", "again", "--xosc", "v.xosc", "--json").out)
    assert made["scenario"] == "r157-cut-in"
    failed = shell.crashhunt("init", "third", "--xosc", "v.xosc", "--agent", "keep-lane", expect=2)
    assert "--agent cannot be used with --xosc" in failed.err
