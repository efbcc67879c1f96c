"""Damaged and hostile OSM files: one clear line each, in bounded time and memory."""

import contextlib
import subprocess
import sys
import time
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from hdmap_tools.errors import FormatError, HDMapError
from hdmap_tools.formats.lanelet2 import read_lanelet2, write_lanelet2
from hdmap_tools.formats.osm_xml import read_osm
from hdmap_tools.map_model.elements import Crosswalk, Lanelet, LaneMark, SidewalkArea
from hdmap_tools.map_model.vector_map import VectorMap

NODES = "".join(
    f'<node id="{k}" lat="{49 + y * 1e-5}" lon="{8 + x * 1e-5}"/>'
    for k, (x, y) in enumerate([(0, 0), (9, 0), (9, 5), (0, 5)], 1)
)


def _file(tmp_path: Path, body: str, head: str = "") -> Path:
    path = tmp_path / "bad.osm"
    path.write_text(f"<?xml version='1.0' encoding='UTF-8'?>{head}\n<osm>{body}</osm>", "utf-8")
    return path


LAUGHS = "<!DOCTYPE osm [<!ENTITY a0 'ha'>" + "".join(
    f"<!ENTITY a{k} '{f'&a{k - 1};' * 10}'>" for k in range(1, 12)
) + "]>"  # fmt: skip


@pytest.mark.parametrize(
    "head",
    [
        LAUGHS,
        "<!DOCTYPE osm [<!ENTITY a11 SYSTEM 'file:///etc/passwd'>]>",
        "<!DOCTYPE osm SYSTEM 'http://192.0.2.1/osm.dtd'>",
        "<!DOCTYPE osm [<!ENTITY % p SYSTEM 'http://192.0.2.1/'> %p;]>",
        "<!DOCTYPE osm>",
    ],
)
@pytest.mark.parametrize("body", ["<node id='1' lat='&a11;' lon='0'/>", "&a11;"])
def test_doctype_is_refused_at_once(head: str, body: str, tmp_path: Path) -> None:
    started = time.monotonic()
    with pytest.raises(FormatError, match="DOCTYPE") as caught:
        read_lanelet2(_file(tmp_path, body, head))
    assert time.monotonic() - started < 2.0
    assert "\n" not in str(caught.value)
    assert "root:" not in str(caught.value)


def test_doctype_in_another_encoding_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.osm"
    text = "<?xml version='1.0' encoding='UTF-16'?><!DOCTYPE osm [<!ENTITY a 'b'>]><osm a='&a;'/>"
    path.write_bytes(text.encode("utf-16"))
    with pytest.raises(FormatError, match="DOCTYPE"):
        read_osm(path)


@pytest.mark.parametrize(
    ("start", "end"),
    [
        ('<osm><node id="', '" lat="0" lon="0"/></osm>'),
        ('<osm><node id="1" lat="0" lon="0"><tag k="name" v="', '"/></node></osm>'),
        ('<osm version="', '"/>'),
        ("<osm><", "/></osm>"),
        ("<osm><!--", "--></osm>"),
        ("<osm><?a ", "?></osm>"),
    ],
)
def test_an_endless_attribute_ends_early_in_little_memory(
    start: str, end: str, tmp_path: Path
) -> None:
    path = tmp_path / "big.osm"
    with path.open("wb") as stream:
        stream.write(start.encode())
        for _ in range(60):
            stream.write(b"a" * (1 << 20))
        stream.write(end.encode())
    # In a process of its own: the peak of this one says nothing about a second reading.
    script = (
        "import resource, sys\n"
        "from hdmap_tools.formats.osm_xml import read_osm\n"
        "import lxml.etree\n"
        "peak_kb = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "before = peak_kb()\n"
        "try:\n"
        "    read_osm(sys.argv[1])\n"
        "except Exception as error:\n"
        "    print(type(error).__name__, peak_kb() - before, error, sep='|')\n"
    )
    command = [sys.executable, "-c", script, str(path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    kind, grown_kb, message = done.stdout.strip().split("|", 2)
    assert kind == "FormatError"
    assert "big.osm" in message
    assert "\n" not in message
    assert int(grown_kb) < 40 * 1024  # the file has 60 MB


def test_deep_nesting_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="not well-formed"):
        read_osm(_file(tmp_path, "<a>" * 5000))


@pytest.mark.parametrize(
    ("body", "says"),
    [
        ('<node id="1" lat="1" lon="1">\n</way>', "line 3"),
        ('<node id="1" lat="1" lon="1"/>\n<way id=2/>', "line 3"),
        ('<node id="1" lat="&nbsp;" lon="1"/>', "nbsp"),
        ('<node id="1" lat="1e999" lon="1"/>', "node 1: lat is '1e999'"),
        ('<node id="1" lat="nan" lon="1"/>', "node 1: lat is 'nan'"),
        ('<node id="1" lat="1" lon="inf"/>', "node 1: lon is 'inf'"),
        ('<node id="1" lat="90.1" lon="1"/>', "within ±90"),
        ('<node id="1" lat="1" lon="-180.5"/>', "within ±180"),
        ('<node id="1" lon="1"/>', "lat is missing"),
        ('<node id="1" lat="" lon="1"/>', "lat is ''"),
        ('<node id="1" lat="1" lon="1"><tag k="ele" v="high"/></node>', "ele is 'high'"),
        ('<node id="1" lat="1" lon="1"><tag k="ele" v="1e999"/></node>', "ele is '1e999'"),
        ('<node id="1" lat="1" lon="1"><tag k="ele" v="1e300"/></node>', "within ±100000"),
        ('<node lat="1" lon="1"/>', "without an id: the id is no value"),
        ('<node id="9223372036854775808" lat="1" lon="1"/>', "64-bit"),
        (f'<node id="{"9" * 5000}" lat="1" lon="1"/>', "64-bit"),
        ('<node id="1.5" lat="1" lon="1"/>', "'1.5'"),
        ('<way id="1"><nd ref="99999999999999999999"/></way>', "way 1: a node reference"),
        ('<relation id="1"><member type="way" role="left"/></relation>', "member reference"),
        ('<node id="1" lat="1" lon="1"/><node id="1" lat="2" lon="2"/>', "node 1 is defined twice"),
        ('<way id="1"/><way id="1"/>', "way 1 is defined twice"),
        ('<hdmap_tools metadata="{"/>', "damaged"),
    ],
)
def test_damage_ends_in_one_line_that_says_where(body: str, says: str, tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=says) as caught:
        read_lanelet2(_file(tmp_path, body))
    message = str(caught.value)
    assert "bad.osm" in message
    assert "\n" not in message
    assert len(message) < 400


@pytest.mark.parametrize("content", [b"", b"\x00\x01", b"<html></html>", b"{}", b"\xff\xfe"])
def test_not_osm_at_all(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "a.osm").write_bytes(content)
    with pytest.raises(FormatError):
        read_osm(tmp_path / "a.osm")
    with pytest.raises(FormatError, match="cannot be read"):
        read_osm(tmp_path / "missing.osm")
    with pytest.raises(FormatError, match="cannot be read"):
        read_osm(tmp_path)


def test_a_file_cut_anywhere_is_refused(vector_map: VectorMap, tmp_path: Path) -> None:
    write_lanelet2(vector_map, tmp_path / "a.osm")
    whole = (tmp_path / "a.osm").read_bytes()
    for share in (0.001, 0.1, 0.5, 0.9, 0.999):
        (tmp_path / "b.osm").write_bytes(whole[: int(len(whole) * share)])
        with pytest.raises(FormatError, match=r"not well-formed XML, line \d+"):
            read_lanelet2(tmp_path / "b.osm")


def test_markup_characters_in_attributes_come_back(tmp_path: Path) -> None:
    body = '<node id="1" lat="1" lon="1"><tag k="n" v="a &amp; b &lt;c&gt; &#38;amp; &quot;&#10;"/></node>'
    assert read_osm(_file(tmp_path, body)).nodes[1].tags == {"n": 'a & b <c> &amp; "\n'}


@given(data=st.binary(max_size=40), at=st.floats(0, 1))
@settings(
    max_examples=80, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
def test_noise_gives_a_map_or_our_error(data: bytes, at: float, tmp_path: Path) -> None:
    ways = '<way id="9"><nd ref="1"/><nd ref="2"/><tag k="type" v="line_thin"/></way>'
    whole = f"<osm>{NODES}{ways}</osm>".encode()
    k = int(at * len(whole))
    (tmp_path / "a.osm").write_bytes(whole[:k] + data + whole[k + len(data) :])
    with contextlib.suppress(HDMapError):
        read_lanelet2(tmp_path / "a.osm")


def _skipped(tmp_path: Path, body: str) -> tuple[VectorMap, dict[str, int]]:
    found = read_lanelet2(_file(tmp_path, NODES + body))
    return found, found.provenance["skipped"]


def test_dangling_references_are_counted_and_the_rest_is_read(tmp_path: Path) -> None:
    found, skipped = _skipped(
        tmp_path,
        """<way id="10"><nd ref="1"/><nd ref="2"/><tag k="type" v="line_thin"/></way>
        <way id="11"><nd ref="3"/><nd ref="77"/><tag k="type" v="line_thin"/></way>
        <way id="12"><nd ref="3"/><nd ref="3"/><tag k="type" v="curbstone"/></way>
        <way id="13"><nd ref="4"/><nd ref="4"/><nd ref="3"/><tag k="type" v="line_thin"/></way>
        <relation id="20"><member type="way" ref="10" role="right"/>
          <member type="way" ref="11" role="left"/><tag k="type" v="lanelet"/></relation>
        <relation id="21"><member type="way" ref="10" role="right"/>
          <member type="way" ref="99" role="left"/><tag k="type" v="lanelet"/></relation>
        <relation id="22"><member type="way" ref="10" role="right"/>
          <tag k="type" v="lanelet"/></relation>
        <relation id="23"><member type="way" ref="10" role="right"/>
          <member type="way" ref="13" role="left"/><member type="node" ref="1" role="odd"/>
          <tag k="type" v="lanelet"/></relation>
        <relation id="24"><member type="way" ref="98" role="outer"/>
          <tag k="type" v="multipolygon"/><tag k="subtype" v="walkway"/></relation>
        <relation id="25"><member type="way" ref="10" role="outer"/>
          <tag k="type" v="multipolygon"/><tag k="subtype" v="walkway"/></relation>""",
    )
    assert skipped == {
        "way with missing nodes": 1,
        "way of less than two points": 1,
        "lanelet with an unreadable bound": 2,
        "lanelet without one left and one right way": 1,
        "role odd of a lanelet": 1,
        "area with an unreadable outline": 1,
        "area whose outline does not close once": 1,
    }
    assert found.provenance["skipped_ids"]["lanelet with an unreadable bound"] == ["20", "21"]
    assert [e.id for e in found] == ["way-10", "way-13", "relation-23"]
    assert isinstance(found.elements[2], Lanelet)


def test_what_others_write_is_read(tmp_path: Path) -> None:
    found, skipped = _skipped(
        tmp_path,
        """<node id="5" action="delete"/>
        <way id="-10"><nd ref="1"/><nd ref="2"/><tag k="type" v="pedestrian_marking"/></way>
        <way id="-11"><nd ref="4"/><nd ref="3"/><tag k="type" v="zebra_marking"/></way>
        <way id="12"><nd ref="1"/><nd ref="2"/><nd ref="3"/><tag k="area" v="yes"/>
          <tag k="type" v="walkway"/></way>
        <way id="13"><nd ref="1"/><nd ref="2"/><nd ref="3"/><tag k="area" v="yes"/>
          <tag k="type" v="hedge"/></way>
        <way id="14"><nd ref="1"/><nd ref="2"/><tag k="type" v="line_thick"/>
          <tag k="subtype" v="dotted"/><tag k="width" v="wide"/><tag k="confidence" v="0.5"/></way>
        <way id="15"><nd ref="1"/><nd ref="2"/><tag k="type" v="line_thin"/>
          <tag k="confidence" v="7"/></way>
        <way id="16"><nd ref="1"/><nd ref="3"/><tag k="type" v="arrow"/></way>
        <way id="17"><nd ref="1"/><nd ref="2"/><tag k="type" v="line_thin"/><tag k="hdmap_id" v="m"/></way>
        <way id="18"><nd ref="2"/><nd ref="3"/><tag k="type" v="line_thin"/><tag k="hdmap_id" v="m"/>
          <tag k="lane_change" v="no"/></way>
        <relation id="20"><member type="way" ref="-10" role="right"/>
          <member type="way" ref="-11" role="left"/><tag k="type" v="lanelet"/>
          <tag k="subtype" v="crosswalk"/></relation>
        <relation id="21"><tag k="type" v="regulatory_element"/>
          <tag k="subtype" v="right_of_way"/></relation>""",
    )
    assert skipped == {
        "area:hedge": 1,
        "deleted": 1,
        "invalid lane_mark": 1,
        "relation:regulatory_element:right_of_way": 1,
        "repeated hdmap_id": 1,
        "tag:lane_change": 1,
        "way:arrow": 1,
    }
    assert found.provenance["read_as"] == {"line_thick dotted as lane_mark": 1}
    assert {e.id for e in found.of_type(LaneMark)} == {"way-14", "m", "m/way-18"}
    assert found.of_type(LaneMark)[2].confidence == 0.5
    (crossing,), (area,) = found.of_type(Crosswalk), found.of_type(SidewalkArea)
    assert crossing.geometry.area == pytest.approx(2 * area.geometry.area, rel=1e-3)
    assert crossing.geometry.area == pytest.approx(9 * 0.7320 * 5 * 1.1120, rel=0.01)
