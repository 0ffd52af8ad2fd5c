"""What a scenario may be made from, and what is refused before any program reads it."""

from __future__ import annotations

import gzip
import math
import os

import pytest
from hypothesis import given, strategies as st

from crashhunt.errors import CrashhuntError, ScenarioError, UsageError
from crashhunt.sumo.maps import MapSource, _source, check_source, parse_bbox, parse_shape
from crashhunt.sumo.maps._source import _MAX_BYTES, _overlaps, fix_of_bbox, kind_of_file

OSM = b'<?xml version="1.0"?><osm version="0.6"></osm>'


def source(path, kind="osm"):
    return MapSource(kind=kind, path=path)


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("a.osm", "osm"), ("A.OSM", "osm"), ("a.osm.gz", "osm"), ("a.osm.pbf", "osm"), ("a.xodr", "opendrive"),
        ("a.net.xml", "net"), ("a.net.xml.gz", "net"), ("a.xml", None), ("osm", None),
    ],
)  # fmt: skip
def test_ending_of_file_gives_kind_of_map(tmp_path, name, kind):
    assert kind_of_file(tmp_path / name) == kind


@pytest.mark.parametrize(
    ("name", "kind", "expected"),
    [
        ("town.osm", "osm", "town"), ("town.osm.pbf", "osm", "town"), ("town.osm.gz", "osm", "town"),
        ("map.xodr", "opendrive", "map"), ("my.town.net.xml", "net", "my.town"),
    ],
)  # fmt: skip
def test_name_of_place_is_file_without_ending(tmp_path, name, kind, expected):
    assert source(tmp_path / name, kind).name == expected


def test_a_generated_map_is_named_by_its_kind_and_shape():
    grid, spider = MapSource(kind="grid", shape=(2, 3)), MapSource(kind="spider", shape=(5, 1))
    assert (grid.name, spider.name) == ("grid-2x3", "spider-5x1")
    assert (grid.title, spider.title) == ("a grid of 2 by 3 junctions", "a spider's web of 5 arms and 1 rings")


@given(st.text())
def test_any_text_is_four_numbers_in_order_or_refused(text):
    try:
        west, south, east, north = parse_bbox(text)
    except UsageError as error:
        assert "--bbox" in error.message
        assert error.fix
    else:
        assert -180 <= west < east <= 180
        assert -90 <= south < north <= 90


@given(st.tuples(*[st.floats(-200, 200, allow_nan=False)] * 4))
def test_bbox_is_read_as_written(numbers):
    west, south, east, north = numbers
    is_box = -180 <= west < east <= 180 and -90 <= south < north <= 90
    text = ",".join(map(repr, numbers))
    if is_box:
        assert parse_bbox(text) == numbers
    else:
        with pytest.raises(UsageError):
            parse_bbox(text)


@pytest.mark.parametrize("text", ["nan,1,2,3", "1,2,inf,4", "", "1,2,3", "1,2,3,4,5", "a,b,c,d"])
def test_bbox_of_other_form_is_refused(text):
    with pytest.raises(UsageError):
        parse_bbox(text)


@pytest.mark.parametrize(
    ("bbox", "fix"),
    [
        ((2.0, 2.0, 3.0, 3.0), "choose a --bbox with streets; the map spans 11.4,48.1,11.6,48.2"),
        ((11.45, 48.11, 11.46, 48.12), "choose a --bbox with streets; the map spans 11.4,48.1,11.6,48.2"),
        ((48.15, 11.5, 48.16, 11.55), "give --bbox=11.5,48.15,11.55,48.16, since the order is west,south,east,north; "),
    ],
)
def test_bbox_without_roads_is_compared_with_that_of_the_map(bbox, fix):
    bounds = (11.4, 48.1, 11.6, 48.2)
    assert fix_of_bbox(bbox, bounds).startswith(fix)
    assert fix_of_bbox(bbox, None) == ""


def test_smallest_and_largest_shapes_are_accepted():
    assert parse_shape("3x5", "--grid") == (3, 5)
    assert parse_shape("2X40", "--grid") == (2, 40)
    assert parse_shape("40x2", "--grid") == (40, 2)
    assert parse_shape("3x2", "--spider") == (3, 2)
    for text in ("1x2", "2x41", "2x3"):
        with pytest.raises(UsageError):
            parse_shape(text, "--spider")


@pytest.mark.parametrize("text", ["", "4", "4x", "x4", "4x4x4", "-4x4", "4.5x4", "٤x٤", "0x0"])
def test_shape_of_other_form_is_refused(text):
    with pytest.raises(UsageError):
        parse_shape(text, "--grid")


@pytest.mark.parametrize("text", ["1x1", "0x4", "10000x10000", "2x99999999999"])
def test_shape_of_any_size_is_out_of_range_and_not_of_another_form(text):
    with pytest.raises(UsageError, match="is out of range"):
        parse_shape(text, "--grid")


def test_bbox_that_is_not_finite_is_named_so():
    with pytest.raises(UsageError, match="is not four finite numbers"):
        parse_bbox("nan,1,2,3")


def test_web_of_two_arms_is_refused():
    with pytest.raises(UsageError, match="2 arms"):
        parse_shape("2x3", "--spider")


def refusal(path, kind="osm"):
    with pytest.raises(ScenarioError) as caught:
        check_source(source(path, kind))
    assert caught.value.fix
    assert caught.value.where == str(path)
    return caught.value


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.osm", b"", "the file is empty"),
        ("a.osm", b'{"a": 1}', "not valid XML"),
        ("a.osm", b"\x00\xff\xfe", "not valid XML"),
        ("a.osm", b"<net></net>", "begins with <net>"),
        ("a.osm.gz", b"\x1f\x8b\x08garbage", "cannot be unpacked"),
        ("a.osm.gz", gzip.compress(b"<net/>", mtime=0), "begins with <net>"),
        ("a.osm.pbf", OSM, "not an OpenStreetMap PBF"),
        ("a.pdf", OSM, "does not have the ending of OpenStreetMap"),
    ],
)
def test_file_that_is_no_map_is_refused(tmp_path, name, content, words):
    (tmp_path / name).write_bytes(content)
    assert words in refusal(tmp_path / name).message


def test_map_of_another_kind_is_refused_with_its_option(tmp_path):
    (tmp_path / "a.osm").write_bytes(b"<OpenDRIVE/>")
    assert "--opendrive" in refusal(tmp_path / "a.osm").fix
    (tmp_path / "a.xodr").write_bytes(b"<OpenDRIVE/>")
    assert "--opendrive" in refusal(tmp_path / "a.xodr").fix


def test_pbf_with_the_ending_of_xml_is_refused_with_its_name(tmp_path):
    path = tmp_path / "town.osm"
    path.write_bytes(b"\x00\x00\x00\x0d\x0a\x09OSMHeader\x18")
    with pytest.raises(ScenarioError, match="is an OpenStreetMap PBF") as caught:
        check_source(MapSource(kind="osm", path=path))
    assert caught.value.fix == "rename it to town.osm.pbf"


def test_huge_map_is_refused_unread(tmp_path):
    with (tmp_path / "a.osm").open("wb") as file:
        file.truncate(_MAX_BYTES + 1)
    assert "500 MB" in refusal(tmp_path / "a.osm").message
    with (tmp_path / "b.osm").open("wb") as file:
        file.truncate(_MAX_BYTES)  # read, and refused for its content
    assert "MB" not in refusal(tmp_path / "b.osm").message


def test_packed_map_is_refused_before_it_fills_the_disk(tmp_path, monkeypatch):
    monkeypatch.setattr(_source, "_MAX_BYTES", 5_000_000)
    packed = gzip.compress(b"<osm>" + b" " * 5_000_000 + b"</osm>", mtime=0)
    (tmp_path / "a.osm.gz").write_bytes(packed)
    assert "over 5 MB when it is unpacked" in refusal(tmp_path / "a.osm.gz").message
    (tmp_path / "b.osm.gz").write_bytes(gzip.compress(b"<osm>" + b" " * 2_000_000 + b"</osm>", mtime=0)[:-9])
    assert "cannot be unpacked" in refusal(tmp_path / "b.osm.gz").message


def test_pipes_devices_and_broken_links_are_named_so(tmp_path):
    os.mkfifo(tmp_path / "pipe.osm")
    (tmp_path / "link.osm").symlink_to("nowhere")
    (tmp_path / "loop.osm").symlink_to("loop.osm")
    for path in (tmp_path / "pipe.osm", tmp_path / "link.osm", tmp_path / "loop.osm"):
        assert refusal(path).message == "is a device, a pipe or a broken link, not a map"


def test_folder_and_missing_file_are_refused(tmp_path):
    (tmp_path / "a.osm").mkdir()
    assert "folder" in refusal(tmp_path / "a.osm").message
    (tmp_path / "town.osm").write_bytes(OSM)
    assert "town.osm" in refusal(tmp_path / "twn.osm").fix


@pytest.mark.parametrize(
    ("name", "kind", "content"),
    [
        ("a.osm", "osm", OSM),
        ("a.osm.gz", "osm", gzip.compress(OSM, mtime=0)),
        ("a.xodr", "opendrive", b"<OpenDRIVE><header/></OpenDRIVE>"),
        ("b.xodr", "opendrive", b'<OpenDRIVE xmlns="http://www.opendrive.org"><header/></OpenDRIVE>'),
        ("a.net.xml", "net", b"<net></net>"),
        ("a.osm.pbf", "osm", b"\x00\x00\x00\x0d\x0a\x09OSMHeader\x18\x7c"),
    ],
)
def test_map_of_its_kind_is_accepted(tmp_path, name, kind, content):
    (tmp_path / name).write_bytes(content)
    check_source(source(tmp_path / name, kind))


@given(content=st.binary(max_size=200))
def test_any_content_is_accepted_or_refused_in_one_line(tmp_path_factory, content):
    path = tmp_path_factory.getbasetemp() / "any.osm"
    path.write_bytes(content)
    try:
        check_source(source(path))
    except CrashhuntError as error:
        assert error.fix
        assert math.isfinite(len(str(error)))


@pytest.mark.parametrize("axis", [0, 1])
def test_boxes_that_only_touch_do_not_overlap(axis):
    def moved(by):
        box = [0.0, 0.0, 10.0, 10.0]
        box[axis] += by
        box[axis + 2] += by
        return tuple(box)

    here = moved(0.0)
    for by, overlaps in ((-10.0, False), (-9.9, True), (0.0, True), (9.9, True), (10.0, False), (30.0, False)):
        assert _overlaps(here, moved(by)) is overlaps
        assert _overlaps(moved(by), here) is overlaps


def test_largest_pbf_that_is_read_has_50_mb(tmp_path):
    path = tmp_path / "m.osm.pbf"
    path.write_bytes(b"    OSMHeader")
    with path.open("r+b") as file:
        file.truncate(50_000_000)  # sparse
        check_source(source(path))
        file.truncate(50_000_001)
    assert "50 MB" in refusal(path).message
