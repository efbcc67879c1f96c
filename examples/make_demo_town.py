"""Draw the small town that comes with the package, as a Lanelet2 file.

python examples/make_demo_town.py demo_town.osm

The town is made up. Five junctions (two T-junctions on a four-lane avenue with bicycle lanes, a
crossroads with traffic lights, a T-junction in the south, a roundabout in the north) are joined by
eight streets. Lengths are metres, x east, y north, from the crossroads; the same file comes out
everywhere, byte for byte.
"""

import argparse
import math
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np

LAT, LON = 49.012, 8.432
CROSSING, APPROACH, TAPER = 6.0, 18.0, 3.0
STRAIGHT_STEP, SAGITTA = 25.0, 0.02

SOLID = {"type": "line_thin", "subtype": "solid"}
DASHED = {"type": "line_thin", "subtype": "dashed"}
WIDE = {"type": "line_thick", "subtype": "solid"}
WIDE_DASHED = {"type": "line_thick", "subtype": "dashed"}
DOUBLE = {"type": "line_thin", "subtype": "solid_solid"}
KERB = {"type": "curbstone", "subtype": "high"}
LOW_KERB = {"type": "curbstone", "subtype": "low"}
VIRTUAL = {"type": "virtual"}


@dataclass(frozen=True)
class Widths:
    """Of the strips of a street."""

    lane: float = 3.25
    bicycle: float = 1.6
    parking: float = 2.2
    pavement: float = 2.3


class Osm:
    """Nodes, ways and relations; equal nodes and ways exist once."""

    def __init__(self) -> None:
        self.ids: dict[object, int] = {}
        self.nodes: list[str] = []
        self.ways: list[str] = []
        self.relations: dict[int, tuple[list[tuple[str, int, str]], dict[str, str]]] = {}

    def _new(self, key: object) -> int:
        return self.ids.setdefault(key, len(self.ids) + 1)

    def node(self, x: float, y: float, height: float = 0.0) -> int:
        """The node at a place."""
        key = ("node", round(float(x), 3) + 0.0, round(float(y), 3) + 0.0, height)
        if key not in self.ids:
            lat, lon = lat_lon(key[1], key[2])
            start = f"  <node id='{self._new(key)}' lat='{lat:.9f}' lon='{lon:.9f}'"
            tag = f"><tag k='ele' v='{height:g}'/></node>" if height else "/>"
            self.nodes.append(start + tag)
        return self.ids[key]

    def way(self, points: np.ndarray, tags: dict[str, str], height: float = 0.0) -> int:
        """The way through these points (N, 2); if one exists, either way round, it stays as it is."""
        refs = [self.node(x, y, height) for x, y in points]
        refs = [r for k, r in enumerate(refs) if k == 0 or r != refs[k - 1]]
        key = ("way", *min(refs, refs[::-1]))
        if key not in self.ids:
            nodes = "".join(f"<nd ref='{r}'/>" for r in refs)
            self.ways.append(f"  <way id='{self._new(key)}'>{nodes}{tags_xml(tags)}</way>")
        return self.ids[key]

    def relation(self, members: list[tuple[str, int, str]], tags: dict[str, str]) -> int:
        """A new relation."""
        identifier = self._new(("relation", len(self.relations)))
        self.relations[identifier] = (members, tags)
        return identifier

    def lanelet(self, left: int, right: int, subtype: str, **tags: str) -> int:
        """A lane between two ways."""
        both = "no" if subtype in ("walkway", "crosswalk") else "yes"
        fixed = {"location": "urban", "one_way": both, "subtype": subtype}
        members = [("way", left, "left"), ("way", right, "right")]
        return self.relation(members, {**fixed, "type": "lanelet", **tags})

    def area(self, outer: list[int], subtype: str, inner: list[int] | None = None) -> int:
        """A polygon of ways that close."""
        members = [("way", w, "outer") for w in outer] + [("way", w, "inner") for w in inner or []]
        return self.relation(
            members, {"location": "urban", "subtype": subtype, "type": "multipolygon"}
        )

    def rule(self, subtype: str, members: list[tuple[str, int, str]], obeyed_by: list[int]) -> None:
        """A regulatory element, and the lanelets it holds for."""
        rule = self.relation(members, {"subtype": subtype, "type": "regulatory_element"})
        for lanelet in obeyed_by:
            self.relations[lanelet][0].append(("relation", rule, "regulatory_element"))

    def text(self) -> str:
        """The file."""
        lines = ["<?xml version='1.0' encoding='UTF-8'?>"]
        lines += ["<osm version='0.6' generator='hdmap_tools make_demo_town'>"]
        lines += [*self.nodes, *self.ways]
        for identifier, (members, tags) in self.relations.items():
            body = "".join(
                f"<member type='{t}' ref='{r}' role='{role}'/>" for t, r, role in members
            )
            lines.append(f"  <relation id='{identifier}'>{body}{tags_xml(tags)}</relation>")
        return "\n".join([*lines, "</osm>", ""])


def tags_xml(tags: dict[str, str]) -> str:
    """Tags in the order of their names."""
    return "".join(f"<tag k='{k}' v='{v}'/>" for k, v in sorted(tags.items()))


def lat_lon(x: float, y: float) -> tuple[float, float]:
    """On the WGS84 ellipsoid, by its radii at the origin; exact to centimetres this near to it."""
    a, e2, phi = 6378137.0, 0.00669437999014, math.radians(LAT)
    w2 = 1.0 - e2 * math.sin(phi) ** 2
    north, east = a * (1.0 - e2) / w2**1.5, a / math.sqrt(w2) * math.cos(phi)
    return LAT + math.degrees(y / north), LON + math.degrees(x / east)


class Path2D:
    """Straight lines joined by arcs."""

    def __init__(self, corners: list[tuple[float, float]], radii: list[float]) -> None:
        points = np.array(corners, dtype=float)
        self.pieces: list[
            tuple[float, np.ndarray, float, float]
        ] = []  # length, start, heading, bend
        here = points[0]
        for k in range(1, len(points)):
            step = points[k] - points[k - 1]
            heading = math.atan2(step[1], step[0])
            cut, arc = 0.0, None
            if k + 1 < len(points):
                onward = points[k + 1] - points[k]
                turn = wrap(math.atan2(onward[1], onward[0]) - heading)
                cut = radii[k - 1] * math.tan(abs(turn) / 2.0)
                arc = (radii[k - 1] * abs(turn), turn)
            end = points[k] - cut * unit(heading)
            length = float((end - here) @ unit(heading))
            if length < -1e-9:
                raise ValueError(f"the bend at {corners[k]} does not fit: {length:.1f} m")
            if length > 1e-9:
                self.pieces.append((length, here, heading, 0.0))
            here = end
            if arc is not None and abs(arc[1]) > 1e-6:
                bend = math.copysign(1.0 / radii[k - 1], arc[1])
                self.pieces.append((arc[0], here, heading, bend))
                here = points[k] + cut * unit(heading + arc[1])
        self.length = sum(piece[0] for piece in self.pieces)

    def at(self, s: float) -> tuple[np.ndarray, float]:
        """Position and heading."""
        for k, (length, start, heading, bend) in enumerate(self.pieces):
            if s <= length or k == len(self.pieces) - 1:
                if bend == 0.0:
                    return start + s * unit(heading), heading
                middle = start + unit(heading + math.pi / 2) / bend
                return middle - unit(heading + s * bend + math.pi / 2) / bend, heading + s * bend
            s -= length
        raise AssertionError

    def stations(self, begin: float, end: float) -> list[float]:
        """Where vertices are needed between two arc lengths, both included."""
        found, passed = [begin], 0.0
        for length, _, _, bend in self.pieces:
            a, b = max(passed, begin), min(passed + length, end)
            step = STRAIGHT_STEP if bend == 0.0 else math.sqrt(8.0 * SAGITTA / abs(bend))
            if b > a:
                found += list(np.linspace(a, b, math.ceil((b - a) / step - 1e-9) + 1)[1:])
            passed += length
        return found

    def beside(self, s: float, offset: float) -> np.ndarray:
        """The point left (offset > 0) or right of the path."""
        place, heading = self.at(s)
        return place + offset * unit(heading + math.pi / 2)


def unit(angle: float) -> np.ndarray:
    """The direction of an angle."""
    return np.array([math.cos(angle), math.sin(angle)])


def wrap(angle: float) -> float:
    """An angle within half a turn."""
    return math.remainder(angle, 2.0 * math.pi)


def bezier(p: np.ndarray, heading: float, q: np.ndarray, heading_q: float) -> np.ndarray:
    """A bend from p to q; an arc of a circle, almost, where one fits."""
    turn = wrap(heading_q - heading)
    handle = math.dist(p, q) / (3.0 * math.cos(turn / 4.0) ** 2)
    count = 2 if abs(turn) < 0.02 else 5 + math.ceil(abs(turn) / 0.2)
    t = np.linspace(0.0, 1.0, count)[:, None]
    a, b = p + handle * unit(heading), q - handle * unit(heading_q)
    return (1 - t) ** 3 * p + 3 * (1 - t) ** 2 * t * a + 3 * (1 - t) * t**2 * b + t**3 * q


@dataclass
class Arm:
    """The end of a street at a junction. `sign`: the side of the street that leads in."""

    street: "Street"
    s: float
    sign: int
    inbound: dict[int, int] = field(default_factory=dict)  # lanelet by lane; -1 is for bicycles
    outbound: dict[int, int] = field(default_factory=dict)
    stop_line: int | None = None

    @property
    def outward(self) -> float:
        """Direction out of the junction."""
        heading = self.street.path.at(self.s)[1]
        return heading if self.sign > 0 else heading + math.pi

    def point(self, offset: float, is_inbound: bool) -> np.ndarray:
        """A point of the gate, so far from the middle of the street."""
        return self.street.path.beside(self.s, offset * (self.sign if is_inbound else -self.sign))

    def lane_edges(self, lane: int, is_inbound: bool) -> tuple[np.ndarray, np.ndarray]:
        """Left and right end of a lane at the gate."""
        lanes, width = self.street.lanes, self.street.widths.lane
        left, right = lane * width, (lane + 1) * width
        if lane == -1:
            left, right = lanes * width, self.street.kerb
        return self.point(left, is_inbound), self.point(right, is_inbound)


class Street:
    """A street between two gates, in sections.

    Sections are (kind, length, parking on the left, parking on the right); the length None
    is shared out among the sections that have it. Kinds: ``crossing``, ``approach``, ``open``.
    """

    def __init__(
        self,
        osm: Osm,
        path: Path2D,
        gates: tuple[float, float],
        sections: list[tuple[str, float | None, bool, bool]],
        lanes: int = 1,
        center: dict[str, str] | None = None,
        limit: str = "50 km/h",
        widths: Widths = Widths(),
        has_bicycles: bool | None = None,
    ) -> None:
        self.osm, self.path, self.lanes, self.limit = osm, path, lanes, limit
        self.center, self.widths = center, widths
        self.has_bicycles = lanes > 1 if has_bicycles is None else has_bicycles
        self.kerb = lanes * widths.lane + (widths.bicycle if self.has_bicycles else 0.0)
        begin, end = gates[0], path.length - gates[1]
        fixed = sum(length for _, length, _, _ in sections if length is not None)
        shares = sum(length is None for _, length, _, _ in sections)
        free = (end - begin - fixed) / max(shares, 1)
        self.arms = Arm(self, begin, 1), Arm(self, end, -1)
        s = begin
        for k, (kind, length, left, right) in enumerate(sections):
            until = end if k == len(sections) - 1 else s + (free if length is None else length)
            self._section(kind, s, until, left, right)
            s = until
        self.begin, self.end = begin, end

    def line(self, begin: float, end: float, offset: float) -> np.ndarray:
        """Points along the street at an offset."""
        return np.array([self.path.beside(s, offset) for s in self.path.stations(begin, end)])

    def _section(self, kind: str, begin: float, end: float, left: bool, right: bool) -> None:
        osm, widths = self.osm, self.widths
        bare = kind == "crossing"
        center = self.center or (DASHED if kind == "open" else SOLID)
        middle = osm.way(self.line(begin, end, 0.0), VIRTUAL if bare else center)
        for side, has_parking in ((1, left), (-1, right)):
            bounds = [middle]
            for lane in range(1, self.lanes):
                divider = DASHED if kind == "open" else SOLID
                xy = self.line(begin, end, side * lane * widths.lane)
                bounds.append(osm.way(xy, VIRTUAL if bare else divider))
            kerb = LOW_KERB if bare else KERB
            if self.has_bicycles:
                xy = self.line(begin, end, side * self.lanes * widths.lane)
                bounds.append(osm.way(xy, VIRTUAL if bare else WIDE))
            edge = self.line(begin, end, side * self.kerb)
            bounds.append(osm.way(edge, SOLID if has_parking else kerb))
            kerb_way = bounds[-1]
            outer = self.line(begin, end, side * (self.kerb + widths.pavement))
            if has_parking:
                a, b = begin + TAPER, end - TAPER
                parked, walked = self.kerb + widths.parking, self.kerb + widths.pavement
                wide = self.line(a, b, side * parked)
                outer = self.line(a, b, side * (parked + widths.pavement))
                ends = [self.path.beside(s, side * walked) for s in (begin, end)]
                outer = np.concatenate([ends[:1], outer, ends[1:]])
                kerb_way = osm.way(np.concatenate([edge[:1], wide, edge[-1:]]), KERB)
                osm.area([bounds[-1], kerb_way], "parking")
            walk = osm.way(outer, VIRTUAL)
            pair = (kerb_way, walk) if side < 0 else (walk, kerb_way)
            osm.lanelet(*pair, "walkway")
            for lane, (inner, outside) in enumerate(pairwise(bounds)):
                is_bicycle = lane == self.lanes
                subtype = "bicycle_lane" if is_bicycle else "road"
                made = osm.lanelet(inner, outside, subtype, speed_limit=self.limit)
                key = -1 if is_bicycle else lane
                # The left side of a street leads to its begin.
                first, last = self.arms
                if side > 0:
                    first.inbound.setdefault(key, made)
                    last.outbound[key] = made
                else:
                    first.outbound.setdefault(key, made)
                    last.inbound[key] = made
        if bare:
            ends = [(begin + 1.0), (begin + 5.0)]
            stripes = [
                osm.way(
                    np.array([self.path.beside(s, o) for o in (self.kerb, -self.kerb)]),
                    {"type": "zebra_marking"},
                )
                for s in ends
            ]
            # Walked from the left kerb to the right one, the farther edge is on the left.
            osm.lanelet(stripes[1], stripes[0], "crosswalk")

    def stop(self, arm: Arm, inside: float) -> int:
        """A stop line across the inbound lanes, so far from the gate; the street's own stop."""
        s = arm.s + arm.sign * inside
        reach = self.lanes * self.widths.lane
        points = [self.path.beside(s, arm.sign * o) for o in (0.1, reach - 0.1)]
        arm.stop_line = self.osm.way(np.array(points), {"type": "stop_line"})
        return arm.stop_line

    def alongside(self, begin: float, end: float, offset: float, tags: dict[str, str]) -> None:
        """Something that follows the street at an offset, arc lengths from its begin gate."""
        xy = self.line(self.begin + begin, self.begin + end, offset)
        self.osm.way(xy, tags)

    def buildings(self, begin: float, side: int, lengths: list[float], depth: float) -> None:
        """A row of houses behind the pavement."""
        s = self.begin + begin
        front = self.kerb + self.widths.parking + self.widths.pavement + 3.0
        for length in lengths:
            place, heading = self.path.at(s + length / 2.0)
            along, away = unit(heading), side * unit(heading + math.pi / 2)
            a = place + front * away - along * (length / 2.0)
            ring = np.array(
                [a, a + along * length, a + along * length + away * depth, a + away * depth, a]
            )
            self.osm.area([self.osm.way(ring, VIRTUAL)], "building")
            s += length + 6.0


def turn_of(a: Arm, b: Arm) -> float:
    """How far one turns, left is positive, from one arm into another."""
    return wrap(b.outward - a.outward - math.pi)


def junction(osm: Osm, arms: list[Arm]) -> None:
    """Corners with kerb and pavement, the paved middle, and a lane for every movement."""
    outline = []
    for a in arms:
        b = min((other for other in arms if other is not a), key=lambda other: turn_of(a, other))
        headings = a.outward + math.pi, b.outward
        rings = []
        for has_walk in (False, True):
            p, q = (
                arm.point(arm.street.kerb + has_walk * arm.street.widths.pavement, arm is a)
                for arm in (a, b)
            )
            rings.append(bezier(p, headings[0], q, headings[1]))
        corner = osm.way(rings[0], KERB)
        osm.lanelet(corner, osm.way(rings[1], VIRTUAL), "walkway")
        gate = osm.way(
            np.array([a.point(a.street.kerb, False), a.point(a.street.kerb, True)]), VIRTUAL
        )
        outline += [gate, corner]
    osm.area(outline, "freespace")
    for a in arms:
        for b in arms:
            if a is b:
                continue
            turn, last_in, last_out = turn_of(a, b), a.street.lanes - 1, b.street.lanes - 1
            if turn < -math.pi / 4:
                moves = [(last_in, last_out)]
            elif turn > math.pi / 4:
                moves = [(0, 0)]
            else:
                moves = [(k, min(k, last_out)) for k in range(last_in + 1)]
            if a.street.has_bicycles and b.street.has_bicycles and abs(turn) < math.pi / 4:
                moves.append((-1, -1))
            for lane_in, lane_out in moves:
                sides = []
                ends = a.lane_edges(lane_in, True), b.lane_edges(lane_out, False)
                for p, q in zip(*ends, strict=True):
                    xy = bezier(p, a.outward + math.pi, q, b.outward)
                    sides.append(osm.way(xy, VIRTUAL))
                subtype = "bicycle_lane" if lane_in == -1 else "road"
                osm.lanelet(*sides, subtype, speed_limit=a.street.limit)


def roundabout(osm: Osm, middle: np.ndarray, arms: list[Arm], inner: float, outer: float) -> None:
    """A ring driven counter-clockwise; whoever comes in gives way."""
    half, pavement = math.radians(33.0), arms[0].street.widths.pavement
    arms = sorted(arms, key=lambda arm: wrap(arm.outward))
    at = [wrap(math.atan2(*(arm.point(0.0, True) - middle)[::-1])) for arm in arms]

    def arc(radius: float, begin: float, end: float) -> np.ndarray:
        count = math.ceil((end - begin) / math.sqrt(8.0 * SAGITTA / radius)) + 1
        return np.array([middle + radius * unit(t) for t in np.linspace(begin, end, count)])

    island, outline, ring_at, entries = [], [], [], []
    for k, (arm, theta) in enumerate(zip(arms, at, strict=True)):
        onward = (k + 1) % len(arms)
        after = at[onward] + (2.0 * math.pi if onward == 0 else 0.0)
        mouth, free = (theta - half, theta + half), (theta + half, after - half)
        # Past the mouth of the arm, then on to the next.
        inside = [osm.way(arc(inner, *span), LOW_KERB) for span in (mouth, free)]
        yield_line = osm.way(arc(outer, *mouth), WIDE_DASHED)
        rim = osm.way(arc(outer, *free), KERB)
        rim_walk = osm.way(arc(outer + pavement, *free), VIRTUAL)
        ring_at.append(osm.lanelet(inside[0], yield_line, "road", speed_limit="30 km/h"))
        osm.lanelet(inside[1], rim, "road", speed_limit="30 km/h")
        osm.lanelet(rim, rim_walk, "walkway")
        island += inside

        def bend(
            start: np.ndarray, angle: float, radius: float, comes_in: bool, arm: Arm
        ) -> np.ndarray:
            target, along = middle + radius * unit(angle), angle + math.pi / 2
            if comes_in:
                return bezier(start, arm.outward + math.pi, target, along)
            return bezier(target, along, start, arm.outward)

        ways = []
        for comes_in, angle in ((True, mouth[1]), (False, mouth[0])):
            left, right = arm.lane_edges(0, comes_in)
            outside = arm.point(arm.street.kerb + arm.street.widths.pavement, comes_in)
            a = osm.way(bend(left, angle, inner, comes_in, arm), VIRTUAL)
            b = osm.way(bend(right, angle, outer, comes_in, arm), KERB)
            c = osm.way(bend(outside, angle, outer + pavement, comes_in, arm), VIRTUAL)
            made = osm.lanelet(a, b, "road", speed_limit="30 km/h")
            osm.lanelet(b, c, "walkway")
            if comes_in:
                entries.append(made)
            ways.append(b)
        gate = osm.way(
            np.array([arm.point(arm.street.kerb, False), arm.point(arm.street.kerb, True)]), VIRTUAL
        )
        outline += [gate, ways[0], rim, ways[1]]
    for entry, ring in zip(entries, ring_at, strict=True):
        osm.rule(
            "right_of_way",
            [("relation", entry, "yield"), ("relation", ring, "right_of_way")],
            [entry, ring],
        )
    osm.area(outline, "freespace", island)
    osm.area(island, "traffic_island")


def give_way(osm: Osm, stem: Arm, through: list[Arm]) -> None:
    """The stem of a T-junction waits for the street it meets."""
    assert stem.stop_line is not None
    own = [v for k, v in stem.inbound.items() if k >= 0]
    first = [v for arm in through for k, v in arm.inbound.items() if k >= 0]
    members = [("relation", k, "yield") for k in own]
    members += [("relation", k, "right_of_way") for k in first]
    osm.rule("right_of_way", [*members, ("way", stem.stop_line, "ref_line")], own + first)


def traffic_lights(osm: Osm, arms: list[Arm]) -> None:
    """A light on the right of every arm, 3 m above the ground."""
    for arm in arms:
        assert arm.stop_line is not None
        s = arm.s + arm.sign * (CROSSING + 0.5)
        ends = [arm.street.path.beside(s, arm.sign * (arm.street.kerb + o)) for o in (0.5, 0.9)]
        light = osm.way(
            np.array(ends), {"type": "traffic_light", "subtype": "red_yellow_green"}, height=3.0
        )
        own = [v for k, v in arm.inbound.items() if k >= 0]
        osm.rule(
            "traffic_light", [("way", light, "refers"), ("way", arm.stop_line, "ref_line")], own
        )


def park(osm: Osm, corners: list[tuple[float, float]]) -> None:
    """An area of trees and grass."""
    osm.area([osm.way(np.array([*corners, corners[0]]), VIRTUAL)], "vegetation")


def town() -> str:
    """The whole town as OSM XML."""
    osm = Osm()
    west, east, south, north = (-210.0, 12.0), (215.0, -12.0), (0.0, -165.0), (0.0, 160.0)
    crossing = ("crossing", CROSSING, False, False)
    approach = ("approach", APPROACH, False, False)
    open_road = ("open", None, False, False)

    def sections(begin: bool, *middle: tuple[str, float | None, bool, bool], end: bool) -> list:
        found = [crossing] * begin + [approach, *middle, approach] + [crossing] * end
        return found

    short = ("approach", 10.0, False, False)
    midblock = [short, crossing, short]
    white, yellow = DOUBLE, {**DOUBLE, "color": "yellow"}
    avenue_west = Street(
        osm, Path2D([west, (-110.0, 12.0), (0.0, 0.0)], [250.0]), (12.5, 12.5),
        sections(True, open_road, *midblock, open_road, end=True), 2, white,
    )  # fmt: skip
    avenue_east = Street(
        osm, Path2D([(0.0, 0.0), (110.0, -12.0), east], [250.0]), (12.5, 12.5),
        sections(True, open_road, end=True), 2, yellow,
    )  # fmt: skip
    main_north = Street(
        osm, Path2D([(0.0, 0.0), (11.0, 80.0), north], [110.0]), (17.0, 29.0),
        sections(True, ("open", None, True, True), end=True), limit="30 km/h",
    )  # fmt: skip
    main_south = Street(
        osm, Path2D([(0.0, 0.0), (-11.0, -80.0), south], [110.0]), (17.0, 12.5),
        sections(True, ("open", None, False, True), *midblock, ("open", None, True, True), end=True),
        limit="30 km/h",
    )  # fmt: skip
    north_west = Street(
        osm, Path2D([west, (-224.0, 100.0), (-165.0, 172.0), (-85.0, 148.0), north], [50.0, 45.0, 80.0]),
        (16.5, 29.0),
        sections(True, ("open", None, True, False), open_road, open_road, end=True),
    )  # fmt: skip
    south_west = Street(
        osm, Path2D([west, (-204.0, -80.0), (-180.0, -150.0), (-95.0, -172.0), south], [90.0, 45.0, 90.0]),
        (16.5, 12.5),
        sections(True, open_road, open_road, ("open", None, True, True), end=False),
    )  # fmt: skip
    winding = Street(
        osm, Path2D(
            [north, (62.0, 172.0), (105.0, 128.0), (152.0, 172.0), (205.0, 160.0), (208.0, 95.0),
             (228.0, 50.0), east],
            [40.0, 28.0, 30.0, 32.0, 60.0, 60.0],
        ),
        (29.0, 16.5),
        sections(True, open_road, open_road, open_road, end=True),
    )  # fmt: skip
    south_east = Street(
        osm, Path2D([south, (95.0, -172.0), (150.0, -118.0), (222.0, -118.0), east], [70.0, 60.0, 38.0]),
        (12.5, 16.5),
        sections(False, ("open", None, True, True), open_road, open_road, end=True),
    )  # fmt: skip

    crossroads = [avenue_west.arms[1], avenue_east.arms[0], main_north.arms[0], main_south.arms[0]]
    for arm in crossroads:
        arm.street.stop(arm, CROSSING + 0.5)
    tees = [
        (avenue_west.arms[0], [north_west.arms[0], south_west.arms[0]]),
        (avenue_east.arms[1], [winding.arms[1], south_east.arms[1]]),
        (main_south.arms[1], [south_west.arms[1], south_east.arms[0]]),
    ]
    for stem, through in tees:
        stem.street.stop(stem, CROSSING + 0.5)
        junction(osm, [stem, *through])
        give_way(osm, stem, through)
    junction(osm, crossroads)
    traffic_lights(osm, crossroads)
    ring = [main_north.arms[1], north_west.arms[1], winding.arms[0]]
    roundabout(osm, np.array(north), ring, 9.5, 15.0)

    avenue_west.buildings(8.0, 1, [22.0, 16.0, 26.0, 18.0], 14.0)
    avenue_west.buildings(12.0, -1, [18.0, 24.0, 20.0, 16.0], 12.0)
    avenue_east.buildings(10.0, -1, [26.0, 18.0, 22.0, 20.0, 16.0], 13.0)
    main_north.buildings(12.0, 1, [14.0, 18.0], 11.0)
    main_south.buildings(30.0, -1, [16.0, 14.0, 18.0], 11.0)
    south_east.buildings(6.0, 1, [16.0, 18.0], 11.0)
    north_west.alongside(20.0, 60.0, 11.0, {"type": "wall"})
    winding.alongside(60.0, 200.0, 6.6, {"type": "guard_rail"})
    south_west.alongside(30.0, 140.0, -6.6, {"type": "fence"})
    park(
        osm,
        [(30.0, 25.0), (120.0, 15.0), (185.0, 20.0), (170.0, 110.0), (70.0, 105.0), (32.0, 110.0)],
    )
    park(
        osm,
        [
            (-190.0, 55.0),
            (-120.0, 60.0),
            (-60.0, 62.0),
            (-60.0, 120.0),
            (-120.0, 130.0),
            (-185.0, 105.0),
        ],
    )
    park(osm, [(-180.0, -50.0), (-70.0, -60.0), (-60.0, -140.0), (-150.0, -135.0)])
    park(
        osm,
        [
            (20.0, -70.0),
            (190.0, -60.0),
            (195.0, -95.0),
            (110.0, -100.0),
            (60.0, -130.0),
            (25.0, -130.0),
        ],
    )
    return osm.text()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("map", type=Path, help="file to write, for example demo_town.osm")
    arguments = parser.parse_args()
    arguments.map.write_text(town(), encoding="utf-8", newline="\n")
    print(f"{arguments.map}: {arguments.map.stat().st_size // 1000} kB")
