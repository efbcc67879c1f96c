"""Shapes of vehicles and people: x ahead, y left, z up, on the ground at z = 0, origin in the middle."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from hdmap_tools.simulate.furniture import box, mesh_of, moved, prism
from hdmap_tools.simulate.materials import Mat
from hdmap_tools.simulate.scene import Mesh
from hdmap_tools.types import NDArrayAny

CAR_COLOURS: Final = (
    Mat.CAR_BODY_WHITE,
    Mat.CAR_BODY_BLACK,
    Mat.CAR_BODY_RED,
    Mat.CAR_BODY_BLUE,
    Mat.CAR_BODY_GREY,
)


MIRROR_M: Final = 0.17
"""So far the mirrors of a car reach beyond its sides."""


class _Station(NamedTuple):
    """A cross-section of a body at x: sill, beltline and roof heights, half widths at the last two."""

    x: float
    sill: float
    belt: float
    roof: float
    half_belt: float
    half_roof: float
    is_glass: bool
    """Whether what lies between this section and the next one is glass above the beltline."""


_SEDAN: Final = (
    _Station(-2.25, 0.42, 0.66, 0.70, 0.72, 0.66, False),
    _Station(-2.15, 0.30, 0.95, 1.00, 0.84, 0.74, False),
    _Station(-1.55, 0.24, 0.98, 1.03, 0.88, 0.76, True),
    _Station(-0.85, 0.24, 0.96, 1.42, 0.90, 0.60, True),
    _Station(0.25, 0.24, 0.94, 1.44, 0.90, 0.60, True),
    _Station(1.05, 0.24, 0.92, 0.97, 0.89, 0.74, False),
    _Station(1.95, 0.26, 0.78, 0.83, 0.86, 0.70, False),
    _Station(2.20, 0.36, 0.60, 0.62, 0.74, 0.62, False),
)
_HATCHBACK: Final = (
    _Station(-1.95, 0.40, 0.80, 0.84, 0.74, 0.68, False),
    _Station(-1.88, 0.28, 1.00, 1.04, 0.83, 0.74, True),
    _Station(-1.45, 0.24, 1.00, 1.46, 0.86, 0.60, True),
    _Station(0.30, 0.24, 0.97, 1.50, 0.87, 0.60, True),
    _Station(1.15, 0.24, 0.95, 1.00, 0.86, 0.72, False),
    _Station(1.80, 0.26, 0.80, 0.84, 0.84, 0.68, False),
    _Station(2.00, 0.36, 0.60, 0.62, 0.72, 0.60, False),
)
_SUV: Final = (
    _Station(-2.25, 0.46, 0.86, 0.90, 0.80, 0.74, False),
    _Station(-2.18, 0.36, 1.12, 1.16, 0.90, 0.80, True),
    _Station(-1.80, 0.32, 1.12, 1.68, 0.93, 0.68, True),
    _Station(0.30, 0.32, 1.10, 1.72, 0.94, 0.68, True),
    _Station(1.05, 0.32, 1.08, 1.13, 0.93, 0.80, False),
    _Station(2.05, 0.34, 0.98, 1.03, 0.91, 0.78, False),
    _Station(2.28, 0.44, 0.74, 0.76, 0.80, 0.70, False),
)
_VAN: Final = (
    _Station(-2.60, 0.40, 1.20, 2.22, 0.94, 0.86, False),
    _Station(-2.55, 0.34, 1.22, 2.28, 0.97, 0.88, False),
    _Station(0.60, 0.32, 1.22, 2.30, 0.98, 0.88, True),
    _Station(1.40, 0.32, 1.20, 2.12, 0.98, 0.82, True),
    _Station(2.10, 0.32, 1.15, 1.20, 0.96, 0.84, False),
    _Station(2.60, 0.36, 0.92, 0.96, 0.90, 0.80, False),
    _Station(2.72, 0.46, 0.70, 0.72, 0.80, 0.72, False),
)
_BUS: Final = (
    _Station(-5.95, 0.40, 1.10, 2.90, 1.20, 1.16, False),
    _Station(-5.80, 0.34, 1.10, 3.02, 1.25, 1.20, True),
    _Station(5.70, 0.34, 1.10, 3.02, 1.25, 1.20, True),
    _Station(5.98, 0.36, 1.00, 2.80, 1.22, 1.14, False),
)
_CAB: Final = (
    _Station(1.70, 0.50, 1.60, 2.75, 1.18, 1.12, False),
    _Station(2.20, 0.45, 1.58, 2.82, 1.20, 1.12, True),
    _Station(3.20, 0.45, 1.55, 2.74, 1.20, 1.10, True),
    _Station(3.55, 0.45, 1.50, 1.62, 1.18, 1.10, False),
    _Station(3.70, 0.55, 1.30, 1.34, 1.10, 1.04, False),
)


def car(rng: np.random.Generator) -> tuple[Mesh, tuple[float, float]]:
    """A passenger car or van of a seeded kind and colour, and its (length, width) in metres."""
    kind = int(rng.choice(4, p=[0.35, 0.30, 0.25, 0.10]))
    stations = (_SEDAN, _HATCHBACK, _SUV, _VAN)[kind]
    colour = CAR_COLOURS[int(rng.choice(5, p=[0.25, 0.22, 0.10, 0.13, 0.30]))]
    length = stations[-1].x - stations[0].x
    half = max(s.half_belt for s in stations)
    tyre = 0.33 if kind != 2 else 0.37
    parts = [
        _loft(stations, colour, Mat.CAR_GLASS),
        *_wheels((-0.30 * length, 0.31 * length), half, tyre, Mat.TYRE),
    ]
    rear, front = stations[1], stations[-2]
    for side in (-1, 1):
        y = side * (rear.half_belt - 0.14)
        parts.append(
            box(
                (stations[0].x - 0.01, y - 0.13, rear.belt - 0.24),
                (rear.x + 0.12, y + 0.13, rear.belt - 0.05),
                Mat.LIGHT_RED,
            )
        )
        y = side * (front.half_belt - 0.16)
        parts.append(
            box(
                (front.x - 0.05, y - 0.15, front.belt - 0.2),
                (stations[-1].x - 0.06, y + 0.15, front.belt - 0.04),
                Mat.CAR_BODY_WHITE,
            )
        )
        y = side * (half + MIRROR_M - 0.09)
        x = next(s.x for s in stations[::-1] if s.roof - s.belt > 0.3) + 0.45
        parts.append(box((x - 0.06, y - 0.09, 0.95), (x + 0.06, y + 0.09, 1.1), colour))
    return Mesh.merged(parts), (length, 2 * half)


def truck(rng: np.random.Generator) -> tuple[Mesh, tuple[float, float]]:
    """A box truck of 7.6 m."""
    high = float(rng.uniform(3.0, 3.5))
    parts = [
        _loft(_CAB, Mat.TRUCK_BODY, Mat.TRUCK_GLASS),
        box((-3.9, -1.24, 1.0), (1.6, 1.24, high), Mat.TRUCK_BODY),
        box((-3.7, -0.5, 0.55), (2.0, 0.5, 1.0), Mat.TRUCK_TYRE),
        *_wheels((-2.6, 2.6), 1.22, 0.5, Mat.TRUCK_TYRE),
    ]
    return Mesh.merged(parts), (7.6, 2.5)


def bus() -> tuple[Mesh, tuple[float, float]]:
    """A city bus of 12 m."""
    parts = [
        _loft(_BUS, Mat.BUS_BODY, Mat.BUS_GLASS, roof_is_body=True),
        *_wheels((-3.2, 3.4), 1.27, 0.48, Mat.BUS_GLASS),
    ]
    for x in np.arange(-4.9, 5.0, 1.4):  # pillars between the windows
        for side in (-1.23, 1.17):
            parts.append(box((x - 0.06, side, 1.1), (x + 0.06, side + 0.06, 2.95), Mat.BUS_BODY))
    front = [(5.995, -1.05, 1.1), (5.995, 1.05, 1.1), (5.99, 1.0, 2.5), (5.99, -1.0, 2.5)]
    parts.append(mesh_of(np.array(front), np.array([[0, 1, 2], [0, 2, 3]]), int(Mat.BUS_GLASS)))
    return Mesh.merged(parts), (12.0, 2.5)


def person(rng: np.random.Generator) -> Mesh:
    """Somebody who walks along x, 1.55 to 1.9 m tall."""
    top = Mat.CLOTHES_BRIGHT if rng.uniform() < 0.5 else Mat.CLOTHES_DARK
    step = float(rng.uniform(0.12, 0.25))
    tall = float(rng.uniform(0.9, 1.1))
    parts = [
        *(
            _limb((0.0, y, 0.88), (step * s, y, 0.02), 0.085, Mat.CLOTHES_DARK)
            for y, s in ((0.1, 1), (-0.1, -1))
        ),
        _trunk(top),
        *(
            _limb((0.0, y, 1.4), (-0.8 * step * s, 1.15 * y, 0.82), 0.055, top)
            for y, s in ((0.23, 1), (-0.23, -1))
        ),
        moved(prism(0.1, 1.48, 1.72, Mat.SKIN, 8, 0.85), (0.02, 0, 0)),
        moved(prism(0.11, 1.64, 1.74, Mat.CLOTHES_DARK, 8, 0.6), (-0.01, 0, 0)),
    ]
    mesh = Mesh.merged(parts)
    return Mesh((mesh.vertices * tall).astype(np.float32), mesh.triangles, mesh.materials)


def cyclist(rng: np.random.Generator) -> Mesh:
    """Somebody on a bicycle."""
    top = Mat.CLOTHES_BRIGHT if rng.uniform() < 0.5 else Mat.CLOTHES_DARK
    wheels = [_disc(x, 0.0, 0.34, 0.02, Mat.BICYCLE, 16) for x in (-0.52, 0.52)]
    frame = [((-0.52, 0, 0.34), (-0.2, 0, 0.9)), ((-0.2, 0, 0.85), (0.4, 0, 0.9)),
             ((0.52, 0, 0.34), (0.4, 0, 1.02)), ((-0.1, 0, 0.4), (0.42, 0, 0.85)),
             ((0.4, -0.28, 1.02), (0.4, 0.28, 1.02))]  # fmt: skip
    parts = wheels + [_limb(a, b, 0.025, Mat.BICYCLE) for a, b in frame]
    for y, knee in ((0.1, 0.75), (-0.1, 0.6)):
        parts.append(_limb((-0.2, y, 0.98), (0.15, y, knee), 0.08, Mat.CLOTHES_DARK))
        parts.append(_limb((0.15, y, knee), (-0.02, y, knee - 0.4), 0.06, Mat.CLOTHES_DARK))
        parts.append(_limb((0.05, 1.8 * y, 1.45), (0.4, 2.4 * y, 1.05), 0.05, top))
    parts.append(_limb((-0.2, 0, 0.95), (0.08, 0, 1.5), 0.17, top))
    parts.append(moved(prism(0.1, 1.5, 1.76, Mat.SKIN, 8, 0.8), (0.14, 0, 0)))
    return Mesh.merged(parts)


def _loft(stations: tuple[_Station, ...], body: Mat, glass: Mat, roof_is_body: bool = True) -> Mesh:
    """A skin over cross-sections from back to front: sides, glass above the beltline, roof, floor."""
    rings = []
    for s in stations:
        # Sills tuck in a little, as they do below the doors.
        rings.append(
            [
                (s.x, -s.half_belt + 0.06, s.sill),
                (s.x, -s.half_belt, s.belt),
                (s.x, -s.half_roof, s.roof),
                (s.x, s.half_roof, s.roof),
                (s.x, s.half_belt, s.belt),
                (s.x, s.half_belt - 0.06, s.sill),
            ]
        )
    faces: list[tuple[int, ...]] = []
    materials: list[int] = []
    n = 6
    for k in range(len(stations) - 1):
        a, b = stations[k], stations[k + 1]
        is_pane = a.is_glass and b.x > a.x
        slopes = abs(a.roof - b.roof) > 0.25
        for j in range(n):
            p, q = k * n + j, k * n + (j + 1) % n
            faces += [(p, p + n, q + n), (p, q + n, q)]
            mat = body
            if is_pane and j in (1, 3):
                mat = glass
            if is_pane and j == 2 and (slopes or not roof_is_body):
                mat = glass
            materials += [int(mat)] * 2
    last = (len(stations) - 1) * n
    for base, flip in ((0, -1), (last, 1)):
        for j in range(1, n - 1):
            faces.append((base, base + j, base + j + 1)[::-flip])
            materials.append(int(body))
    # Rings run from -y over the roof to +y as seen from behind: that is clockwise seen along x.
    return mesh_of(np.array(rings).reshape(-1, 3), np.array(faces), np.array(materials))


def _wheels(xs: tuple[float, float], half_width: float, radius: float, mat: Mat) -> list[Mesh]:
    return [
        _disc(x, side * (half_width - 0.1), radius, 0.11, mat, 14) for x in xs for side in (-1, 1)
    ]


def _disc(x: float, y: float, radius: float, half_thick: float, mat: Mat, sides: int) -> Mesh:
    """A wheel that rolls along x and stands on the ground."""
    upright = prism(radius, -half_thick, half_thick, mat, sides)
    v = upright.vertices
    low_cap = np.column_stack(
        [np.zeros(sides - 2, dtype=int), np.arange(2, sides), np.arange(1, sides - 1)]
    )
    # z becomes -y, y becomes z: a quarter turn about x keeps the outside outside.
    turned = np.column_stack([v[:, 0] + x, -v[:, 2] + y, v[:, 1] + radius])
    return mesh_of(turned, np.concatenate([upright.triangles, low_cap]), int(mat))


def _limb(
    a: tuple[float, float, float], b: tuple[float, float, float], radius: float, mat: Mat
) -> Mesh:
    """A six-sided rod between two points."""
    start, end = np.array(a), np.array(b)
    along = end - start
    length = float(np.linalg.norm(along))
    along /= length
    helper = np.array([0.0, 1.0, 0.0]) if abs(along[1]) < 0.9 else np.array([1.0, 0.0, 0.0])
    u = np.cross(helper, along)
    u /= np.linalg.norm(u)
    frame: NDArrayAny = np.column_stack([u, np.cross(along, u), along])
    rod = prism(radius, 0.0, length, mat, 6)
    return mesh_of(rod.vertices @ frame.T + start, rod.triangles, int(mat))


def _trunk(mat: Mat) -> Mesh:
    rod = prism(0.2, 0.84, 1.48, mat, 8, 1.1)
    return mesh_of(rod.vertices * (0.65, 1.0, 1.0), rod.triangles, int(mat))
