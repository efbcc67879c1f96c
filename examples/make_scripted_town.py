"""Draw a made-up town of its own for every seed, as a Lanelet2 file.

python examples/make_scripted_town.py 7 town_7.osm

As the town that comes with the package: five junctions joined by eight streets. Where they lie, how
the streets bend, how many lanes they have and how wide, what is painted on them, where one parks
and where one crosses follow from the seed; the same file comes out everywhere.
"""

import argparse
import math
from itertools import pairwise
from pathlib import Path
from random import Random

import numpy as np
from make_demo_town import (
    APPROACH,
    CROSSING,
    DASHED,
    DOUBLE,
    SOLID,
    WIDE,
    WIDE_DASHED,
    Arm,
    Osm,
    Path2D,
    Street,
    Widths,
    bezier,
    give_way,
    junction,
    park,
    roundabout,
    traffic_lights,
    unit,
    wrap,
)

YELLOW = {"color": "yellow"}
UNMARKED = {"type": "virtual"}
RING_INNER, RING_OUTER, RING_GATE = 9.5, 15.0, 30.0
CORNER = 8.4  # metres from the kerb of the street that is met to where its corners begin
TRIES = 200


def town(seed: int) -> str:
    """A whole town as OSM XML.

    Not every layout that is drawn can be built (a bend may need more room than there is);
    the first one that can is taken.
    """
    for attempt in range(TRIES):
        try:
            return _town(Random(seed * TRIES + attempt))
        except ValueError:
            continue
    raise ValueError(f"none of {TRIES} layouts of seed {seed} can be built")


def _town(rng: Random) -> str:
    osm = Osm()
    middle = np.zeros(2)
    turned = rng.uniform(-0.4, 0.4)
    directions = [turned + k * math.pi / 2 + rng.uniform(-0.22, 0.22) for k in range(4)]
    places = [rng.uniform(135.0, 215.0) * unit(angle) for angle in directions]
    has_ring = [rng.random() < 0.2 for _ in places]
    has_ring_in_middle = rng.random() < 0.2
    kinds = [_Kind(rng) for _ in range(8)]
    # Opposite streets are of one kind: an avenue goes on beyond a crossroads.
    kinds[2], kinds[3] = kinds[0], kinds[1]
    if has_ring_in_middle:
        for kind in kinds[:4]:
            kind.for_a_roundabout()
    for k, is_ring in enumerate(has_ring):
        for other in (k, 4 + k, 4 + (k - 1) % 4) if is_ring else ():
            kinds[other].for_a_roundabout()
    kerbs = [kind.kerb for kind in kinds]

    def gate_at(k: int, own: int) -> float:
        """How far before the ring's junction `k` a street ends: the others' corners need room."""
        met = [j for j in (k, 4 + k, 4 + (k - 1) % 4) if j != own]
        return RING_GATE if has_ring[k] else CORNER + max(kerbs[j] for j in met)

    gate_in_middle = RING_GATE if has_ring_in_middle else CORNER + 1.5 + max(kerbs[:4])
    radial, around = [], []
    for k, place in enumerate(places):
        across = unit(directions[k] + math.pi / 2)
        bend = 0.5 * place + rng.uniform(-9.0, 9.0) * across
        path = Path2D([(0.0, 0.0), tuple(bend), tuple(place)], [rng.uniform(100.0, 250.0)])
        radial.append(_street(osm, rng, path, (gate_in_middle, gate_at(k, k)), kinds[k]))
    for k, place in enumerate(places):
        onward = (k + 1) % 4
        path = _way_around(rng, place, directions[k], places[onward], directions[onward])
        gates = gate_at(k, 4 + k), gate_at(onward, 4 + k)
        around.append(_street(osm, rng, path, gates, kinds[4 + k]))

    arms = [street.arms[0] for street in radial]
    _meet(osm, rng, middle, arms, has_ring_in_middle)
    for k, place in enumerate(places):
        through = [around[k].arms[0], around[(k - 1) % 4].arms[1]]
        _meet(osm, rng, place, [radial[k].arms[1], *through], has_ring[k])
    for street in (*radial, *around):
        _beside(rng, street)
    for k in range(4):
        _park(osm, rng, places[k], places[(k + 1) % 4])
    return osm.text()


class _Kind:
    """What a street is like, all along."""

    def __init__(self, rng: Random) -> None:
        self.lanes = rng.choice([1, 1, 1, 2, 2])
        self.has_bicycles = rng.random() < (0.5 if self.lanes > 1 else 0.25)
        # Streets that share a junction share the pavement's width too: corners join them.
        self.widths = Widths(
            lane=rng.choice([2.75, 3.0, 3.25, 3.5, 3.75]),
            bicycle=rng.choice([1.4, 1.6, 1.9]),
            parking=rng.choice([2.0, 2.2, 2.5]),
        )
        self.center = rng.choice(
            [None, None, DASHED, SOLID, DOUBLE, {**DOUBLE, **YELLOW}, {**DASHED, **YELLOW}]
            + [UNMARKED] * (self.lanes == 1)
        )
        self.edge = rng.choice([None, None, SOLID, WIDE, DASHED])
        self.limit = rng.choice(["30 km/h", "50 km/h"])

    @property
    def kerb(self) -> float:
        """Metres from the middle of the street to its kerb."""
        return self.lanes * self.widths.lane + self.has_bicycles * self.widths.bicycle

    def for_a_roundabout(self) -> None:
        """One lane each way, as the ring has one."""
        self.lanes, self.has_bicycles = 1, False


def _street(osm: Osm, rng: Random, path: Path2D, gates: tuple[float, float], kind: _Kind) -> Street:
    crossing, approach = ("crossing", CROSSING, False, False), ("approach", APPROACH, False, False)
    short = ("approach", 10.0, False, False)
    room = path.length - sum(gates) - 2 * (CROSSING + APPROACH)
    if room < 12.0:
        raise ValueError("too short a street")
    sections: list[tuple[str, float | None, bool, bool]] = []
    sections += [crossing] * (rng.random() < 0.8) + [approach]
    pieces = max(1, int(room / 60.0))
    midblock = rng.randrange(1, pieces) if pieces > 1 and rng.random() < 0.6 else None
    for k in range(pieces):
        if k == midblock:
            sections += [short, crossing, short]
        # A bicycle lane lies where one would park.
        can_park = not kind.has_bicycles and room / pieces > 25.0
        sections.append(
            ("open", None, can_park and rng.random() < 0.4, can_park and rng.random() < 0.4)
        )
    sections += [approach] + [crossing] * (rng.random() < 0.8)
    street = Street(
        osm,
        path,
        gates,
        sections,
        kind.lanes,
        kind.center,
        kind.limit,
        kind.widths,
        kind.has_bicycles,
    )
    if kind.edge is not None and not kind.has_bicycles:
        inside = rng.uniform(0.25, 0.5)
        for side in (1, -1):
            begin, end = street.begin + CROSSING + 2.0, street.end - CROSSING - 2.0
            osm.way(street.line(begin, end, side * (street.kerb - inside)), kind.edge)
    return street


def _way_around(
    rng: Random, begin: np.ndarray, direction: float, end: np.ndarray, direction_end: float
) -> Path2D:
    """From one junction of the ring to the next: off at about a right angle, bent, and in again."""
    first = begin + rng.uniform(50.0, 80.0) * unit(direction + math.pi / 2 + rng.uniform(-0.2, 0.2))
    last = end + rng.uniform(50.0, 80.0) * unit(
        direction_end - math.pi / 2 + rng.uniform(-0.2, 0.2)
    )
    corners = [begin, first]
    chord = last - first
    if math.hypot(*chord) > 90.0 and rng.random() < 0.7:
        across = np.array([-chord[1], chord[0]]) / math.hypot(*chord)
        corners.append((first + last) / 2 + rng.uniform(-28.0, 28.0) * across)
    corners += [last, end]
    radii = []
    for a, b, c in zip(corners, corners[1:], corners[2:], strict=False):
        turn = abs(wrap(_heading(b, c) - _heading(a, b)))
        room = 0.46 * min(math.dist(a, b), math.dist(b, c))
        radii.append(min(rng.uniform(30.0, 110.0), room / max(math.tan(turn / 2.0), 1e-3)))
    if min(radii) < 22.0:
        raise ValueError("too sharp a bend")
    return Path2D([tuple(corner) for corner in corners], radii)


def _heading(a: np.ndarray, b: np.ndarray) -> float:
    return math.atan2(b[1] - a[1], b[0] - a[0])


def _meet(osm: Osm, rng: Random, place: np.ndarray, arms: list[Arm], is_ring: bool) -> None:
    """A roundabout, a crossroads with lights, or a T-junction whose first arm gives way."""
    if is_ring:
        headings = sorted(arm.outward % (2.0 * math.pi) for arm in arms)
        gaps = [b - a for a, b in pairwise([*headings, headings[0] + 2.0 * math.pi])]
        if min(gaps) < math.radians(70.0):
            raise ValueError("arms of a roundabout too close")
        roundabout(osm, place, arms, RING_INNER, RING_OUTER)
        return
    stopping = arms if len(arms) > 3 else arms[:1]
    for arm in stopping:
        arm.street.stop(arm, CROSSING + 0.5)
    # Painted before the lanes are made, so that the lanes have these lines as their bounds.
    if rng.random() < 0.6:
        for a, b in [(arms[0], arms[2]), (arms[1], arms[3])] if len(arms) > 3 else [arms[1:]]:
            _paint_through(osm, rng, a, b)
    junction(osm, arms)
    if len(arms) > 3:
        traffic_lights(osm, arms)
    else:
        give_way(osm, arms[0], arms[1:])


def _paint_through(osm: Osm, rng: Random, a: Arm, b: Arm) -> None:
    """Lines that lead straight over a junction, from one arm to another."""
    style = rng.choice([DASHED, WIDE_DASHED])
    lanes = min(a.street.lanes, b.street.lanes)
    for comes, goes in ((a, b), (b, a)):
        for lane in range(rng.randrange(2), lanes):
            offset, offset_beyond = (lane * arm.street.widths.lane for arm in (comes, goes))
            p, q = comes.point(offset, True), goes.point(offset_beyond, False)
            osm.way(bezier(p, comes.outward + math.pi, q, goes.outward), style)


def _beside(rng: Random, street: Street) -> None:
    """Houses, walls and fences along a street, where there is room."""
    length = street.end - street.begin
    for side in (1, -1):
        if rng.random() < 0.4 and length > 90.0:
            count = rng.randint(1, max(1, int((length - 40.0) / 30.0)))
            lengths = [rng.uniform(14.0, 26.0) for _ in range(count)]
            street.buildings(rng.uniform(8.0, 20.0), side, lengths, rng.uniform(10.0, 15.0))
        elif rng.random() < 0.4 and length > 90.0:
            begin = rng.uniform(20.0, 40.0)
            what = rng.choice(["wall", "fence", "guard_rail"])
            offset = side * (street.kerb + street.widths.parking + street.widths.pavement + 1.5)
            street.alongside(
                begin, begin + rng.uniform(20.0, length - 60.0), offset, {"type": what}
            )


def _park(osm: Osm, rng: Random, a: np.ndarray, b: np.ndarray) -> None:
    """Trees and grass between two streets."""
    if rng.random() < 0.7:
        corners = [0.25 * (a + b), 0.55 * a + 0.25 * b, 0.45 * (a + b), 0.25 * a + 0.55 * b]
        park(osm, [tuple(corner) for corner in corners])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("seed", type=int, help="each makes another town, for example 7")
    parser.add_argument("map", type=Path, help="file to write, for example town_7.osm")
    arguments = parser.parse_args()
    arguments.map.write_text(town(arguments.seed), encoding="utf-8", newline="\n")
    print(f"{arguments.map}: {arguments.map.stat().st_size // 1000} kB")
