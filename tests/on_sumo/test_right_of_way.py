"""The right of way of a network: which lane gives way to which lane in each junction."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

from crashhunt.sumo._junction_rules import right_of_way
from crashhunt.sumo._options import SumoSetup

# A road from the west with priority; one from the south turns left in two parts, around a place to wait.
NET = """<net>
<edge id=":j_0"><lane id=":j_0_0" index="0" length="9" shape="-5,0 5,0"/></edge>
<edge id=":j_1"><lane id=":j_1_0" index="0" length="4" shape="0,-5 0,-1"/></edge>
<edge id=":j_2"><lane id=":j_2_0" index="0" length="5" shape="0,-1,3 -5,1,3"/></edge>
<edge id=":u_0"><lane id=":u_0_0" index="0" length="9" shape="90,0 95,0"/></edge>
<connection from="west" to="east" fromLane="0" toLane="0" via=":j_0_0" tl="light"/>
<connection from="south" to="out" fromLane="1" toLane="0" via=":j_1_0"/>
<connection from="east" to="far" fromLane="0" toLane="2" via=":u_0_0"/>
<connection from="far" to="gone" fromLane="0" toLane="0"/>
<connection from=":j_1" to="out" fromLane="0" toLane="0" via=":j_2_0"/>
<connection from=":j_2" to="out" fromLane="0" toLane="0"/>
<junction id="j" type="priority" intLanes=":j_0_0 :j_2_0">
  <request index="0" response="00" foes="10"/><request index="1" response="01" foes="01"/></junction>
<junction id="u" type="unregulated" intLanes=":u_0_0"><request index="0" response="1" foes="1"/></junction>
</net>"""


def scenario(folder):
    setup = SumoSetup(net="n.net.xml")
    return SimpleNamespace(folder=folder, table=lambda kind: replace(setup))


def test_links_are_read_with_all_their_lanes_and_who_gives_way(tmp_path):
    (tmp_path / "n.net.xml").write_text(NET)
    found = right_of_way(scenario(tmp_path))
    assert [(link.junction, link.source, link.target, link.signalised) for link in found.links] == [
        ("j", "west_0", "east_0", True), ("j", "south_1", "out_0", False), ("u", "east_0", "far_2", False),
    ]  # fmt: skip
    assert [link.inside for link in found.links] == [(":j_0_0",), (":j_1_0", ":j_2_0"), (":u_0_0",)]
    assert found.links[1].shape == ((0, -5), (0, -1), (0, -1), (-5, 1))
    assert found.gives_way == {(1, 0)}
    (tmp_path / "n.net.xml").write_text("<net>")
    assert right_of_way(scenario(tmp_path)) is None
    (tmp_path / "n.net.xml").unlink()
    assert right_of_way(scenario(tmp_path)) is None
