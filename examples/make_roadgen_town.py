"""Draw a made-up grid of streets with the package roadgen, as a Lanelet2 file.

python -m pip install roadgen==0.41.0
python examples/make_roadgen_town.py 7 grid_7.osm

Nine crossroads and T-junctions, not quite on a grid; lanes, widths, bends, markings and crossings
follow from the seed. roadgen is Apache-2.0; it draws lanes, junctions and pavements its own way,
and what one learns from is not the hand of one drawer alone.
"""

import argparse
import math
import sys
from itertools import combinations
from pathlib import Path
from random import Random
from typing import Any

VERSION = "0.41.0"
SIDE = 3  # junctions along one side of the grid


def town(seed: int) -> str:
    """The whole map as OSM XML.

    Raises:
        SystemExit: If roadgen is not installed, or its version would draw another town.
    """
    try:
        import roadgen
    except ImportError:
        sys.exit(f"roadgen draws these towns: python -m pip install roadgen=={VERSION}")
    from importlib.metadata import version

    if version("roadgen") != VERSION:
        sys.exit(
            f"roadgen {version('roadgen')} is installed and may draw other towns than {VERSION}: "
            f"python -m pip install roadgen=={VERSION}"
        )
    rng = Random(seed)
    drawn = roadgen.Map(name=f"grid_{seed}", origin=(49.0 + 0.01 * seed, 8.4, 0.0))
    spacing = rng.uniform(105.0, 150.0)
    at = {
        (i, j): (
            spacing * i + rng.uniform(-14.0, 14.0),
            spacing * j + rng.uniform(-14.0, 14.0),
        )
        for i in range(SIDE)
        for j in range(SIDE)
    }
    # Streets of a row or a column are one street: they have one cross-section.
    sections = {("row", k): _Section(rng) for k in range(SIDE)}
    sections |= {("column", k): _Section(rng) for k in range(SIDE)}
    arms: dict[tuple[int, int], list[tuple[Any, str]]] = {place: [] for place in at}
    for (i, j), here in at.items():
        for onward, which in (((i + 1, j), ("row", j)), ((i, j + 1), ("column", i))):
            if onward not in at:
                continue
            section = sections[which]
            road = drawn.add_road(
                lanes=section.lanes(roadgen),
                points=_bent(rng, here, at[onward], gap=section.half_width + 14.0),
                name=f"{which[0]}{i}{j}",
                speed_limit_kph=section.limit,
            )
            arms[i, j].append((road, "start"))
            arms[onward].append((road, "end"))
            if rng.random() < 0.4:
                drawn.add_crosswalk(road, fraction=rng.uniform(0.4, 0.6), width=section.crossing)
            for fraction in (0.07, 0.93):
                if rng.random() < 0.6:
                    drawn.add_crosswalk(road, fraction=fraction, width=section.crossing)
            for lane in road.lanes()[: 2 * section.count]:
                if rng.random() < 0.6:
                    drawn.add_stop_line(lane, setback=14.0 if section.count == 1 else 16.0)
    for (i, j), met in arms.items():
        crossing = drawn.add_junction(f"junction{i}{j}")
        for (a, end_a), (b, end_b) in combinations(met, 2):
            drawn.connect(a, b, junction=crossing, ends=(end_a, end_b))
    text: str = drawn.to_lanelet2_osm()
    return text


class _Section:
    """The cross-section of one street."""

    def __init__(self, rng: Random) -> None:
        self.count = rng.choice([1, 1, 2])
        self.width = rng.choice([2.9, 3.1, 3.3, 3.5, 3.7])
        self.pavement = rng.choice([1.6, 2.0, 2.6])
        self.bicycle = rng.choice([None, None, 1.5])
        self.color = rng.choice(["white", "white", "yellow"])
        self.middle = rng.choice(["solid", "broken", "broken", "solid_solid"])
        self.outside = rng.choice(["none", "solid", "broken"])
        self.crossing = rng.choice([3.0, 4.0, 5.0])
        self.limit = rng.choice([30, 50])

    @property
    def half_width(self) -> float:
        """Metres from the middle to the kerb."""
        return self.count * self.width + (self.bicycle or 0.0)

    def lanes(self, roadgen: Any) -> list[Any]:
        """Outwards from the middle, one side after the other."""
        made = []
        for direction in ("backward", "forward"):
            for k in range(self.count):
                inner = self.middle if k == 0 else "broken"
                outer = "broken" if k + 1 < self.count else self.outside
                # The middle line is on the left of who drives, whichever way.
                made.append(
                    roadgen.Lane(
                        width=self.width,
                        direction=direction,
                        left_marking=inner,
                        right_marking=outer,
                        marking_color=self.color if k == 0 else "white",
                    )
                )
            if self.bicycle:
                made.append(
                    roadgen.Lane(
                        width=self.bicycle,
                        direction=direction,
                        type_="biking",
                        left_marking="solid",
                        right_marking="none",
                    )
                )
            made.append(
                roadgen.Lane(
                    width=self.pavement,
                    direction=direction,
                    type_="sidewalk",
                    left_marking="none",
                    right_marking="none",
                )
            )
        return made


def _bent(
    rng: Random, a: tuple[float, float], b: tuple[float, float], gap: float
) -> list[tuple[float, float, float]]:
    """From near one junction to near the next, with up to two gentle bends."""
    length = math.dist(a, b)
    ahead = ((b[0] - a[0]) / length, (b[1] - a[1]) / length)
    shifts = [rng.uniform(-9.0, 9.0) for _ in range(rng.choice([0, 1, 2]))]
    along = [gap, *(length * (k + 1) / (len(shifts) + 1) for k in range(len(shifts))), length - gap]
    return [
        (a[0] + s * ahead[0] - t * ahead[1], a[1] + s * ahead[1] + t * ahead[0], 0.0)
        for s, t in zip(along, [0.0, *shifts, 0.0], strict=True)
    ]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("seed", type=int, help="each makes another town, for example 7")
    parser.add_argument("map", type=Path, help="file to write, for example grid_7.osm")
    arguments = parser.parse_args()
    arguments.map.write_text(town(arguments.seed), encoding="utf-8", newline="\n")
    print(f"{arguments.map}: {arguments.map.stat().st_size // 1000} kB")
