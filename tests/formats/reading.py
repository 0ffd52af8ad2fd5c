"""Reads a file with the library of whoever looks after its format, and prints what that has understood as JSON.

Run by an interpreter of its own: commonroad-io wants a protobuf that nothing else can live with any more.
"""

from __future__ import annotations

import contextlib
import json
import sys
from pathlib import Path


def commonroad(file):
    """Obstacles, problems and lanelets; and what the schema says against it."""
    import commonroad
    from commonroad.common.file_reader import CommonRoadFileReader
    from lxml import etree

    scenario, problems = CommonRoadFileReader(file).open(lanelet_assignment=True)
    folder = Path(commonroad.__file__).parent / "common" / "xml_definition_files"
    schema = etree.XMLSchema(etree.parse(folder / "XML_commonRoad_XSD.xsd"))
    schema.validate(etree.parse(file))
    return {
        "dt": scenario.dt,
        "obstacles": {
            obstacle.obstacle_id: {
                step: [*map(float, state.position), state.orientation, state.velocity]
                for step in range(100)
                if (state := obstacle.state_at_time(step)) is not None
            }
            for obstacle in scenario.dynamic_obstacles
        },
        "problems": list(problems.planning_problem_dict),
        "successors": {lanelet.lanelet_id: lanelet.successor for lanelet in scenario.lanelet_network.lanelets},
        "against": [error.message for error in schema.error_log],
    }


def openscenario(file):
    """What scenariogeneration writes again of what it has read and found valid; what the schema says of the roads."""
    import warnings

    from lxml import etree
    from scenariogeneration import xosc

    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*not valid.*")
        root = xosc.ParseOpenScenario(file).get_element()
    schemas = Path(xosc.__file__).parent.parent.parent / "schemas"
    schema = etree.XMLSchema(etree.parse(schemas / "opendrive_17_core.xsd"))
    schema.validate(etree.parse(Path(file).with_suffix(".xodr")))
    return {
        "against": [error.message for error in schema.error_log],
        "entities": [entity.get("name") for entity in root.iter("ScenarioObject")],
        "ways": {
            way.get("name"): [
                [float(vertex.get("time")), *(float(vertex.find(".//WorldPosition").get(key)) for key in "xyh")]
                for vertex in way.iter("Vertex")
            ]
            for way in root.iter("Trajectory")
        },
    }


if __name__ == "__main__":
    with contextlib.redirect_stdout(sys.stderr):
        found = {"commonroad": commonroad, "openscenario": openscenario}[sys.argv[1]](sys.argv[2])
    print(json.dumps(found))
