"""Shapes of what stands beside a road: buildings, trees, lamps, signs, hedges, fences.

Each is a mesh in its own frame: x along the road, y to the left, z up, the ground at z = 0.
"""

from __future__ import annotations

import itertools

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from hdmap_tools.simulate.materials import Mat
from hdmap_tools.simulate.scene import Mesh
from hdmap_tools.simulate.terrain import Terrain
from hdmap_tools.types import NDArrayAny, NDArrayFloat

_BOX = np.array(
    [
        [0, 2, 1], [0, 3, 2], [4, 5, 6], [4, 6, 7], [0, 1, 5], [0, 5, 4],
        [1, 2, 6], [1, 6, 5], [2, 3, 7], [2, 7, 6], [3, 0, 4], [3, 4, 7],
    ]
)  # fmt: skip


def mesh_of(vertices: NDArrayAny, triangles: NDArrayAny, materials: NDArrayAny | int) -> Mesh:
    """A mesh of arrays in any dtype; one material stands for all triangles."""
    triangles = np.asarray(triangles).reshape(-1, 3)
    return Mesh(
        np.asarray(vertices, dtype=np.float32).reshape(-1, 3),
        triangles.astype(np.uint32),
        np.broadcast_to(np.asarray(materials, dtype=np.uint8), len(triangles)).copy(),
    )


def box(low: tuple[float, float, float], high: tuple[float, float, float], mat: Mat) -> Mesh:
    """An upright box between two corners."""
    (x0, y0, z0), (x1, y1, z1) = low, high
    ring = [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]
    corners = [(x, y, z) for z in (z0, z1) for x, y in ring]
    return mesh_of(np.array(corners), _BOX, int(mat))


def prism(
    radius_m: float, low_m: float, high_m: float, mat: Mat, sides: int = 6, top: float = 1.0
) -> Mesh:
    """An upright prism around the z axis; `top` is its radius above relative to below."""
    turn = np.arange(sides) * 2 * np.pi / sides
    ring = radius_m * np.column_stack([np.cos(turn), np.sin(turn)])
    low = np.column_stack([ring, np.full(sides, low_m)])
    high = np.column_stack([ring * top, np.full(sides, high_m)])
    k = np.arange(sides)
    n = (k + 1) % sides
    sides_ = np.concatenate(
        [np.column_stack([k, n, n + sides]), np.column_stack([k, n + sides, k + sides])]
    )
    cap = np.column_stack([np.full(sides - 2, sides), k[1:-1] + sides, k[2:] + sides])
    return mesh_of(np.concatenate([low, high]), np.concatenate([sides_, cap]), int(mat))


def moved(mesh: Mesh, xyz: NDArrayAny | tuple[float, float, float], yaw_rad: float = 0.0) -> Mesh:
    """The mesh turned about z and then shifted."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    vertices = mesh.vertices.astype(np.float64) @ turn + np.asarray(xyz, dtype=np.float64)
    return Mesh(vertices.astype(np.float32), mesh.triangles, mesh.materials)


def building(
    width_m: float, depth_m: float, height_m: float, mat: Mat, rng: np.random.Generator
) -> Mesh:
    """A block with a grid of windows a little proud of its walls, and a flat or gabled roof.

    Centred on its footprint, `width_m` along x and `depth_m` along y; it reaches one
    metre into the ground, for the ground may slope.
    """
    x, y = width_m / 2, depth_m / 2
    body = box((-x, -y, -1.0), (x, y, height_m), mat)
    storey = float(rng.uniform(2.8, 3.4))
    spacing = float(rng.uniform(2.2, 3.4))
    w, h = float(rng.uniform(0.9, 1.5)), float(rng.uniform(1.2, 1.7))
    parts = [body]
    for length, out, turn in ((width_m, y, 0), (depth_m, x, 1), (width_m, y, 2), (depth_m, x, 3)):
        columns = max(int((length - 0.8) / spacing), 1)
        rows = max(int((height_m - 0.6) / storey), 1)
        u = (np.arange(columns) - (columns - 1) / 2) * spacing
        v = np.arange(rows) * storey + 1.0
        uu, vv = (a.ravel() for a in np.meshgrid(u, v))
        corners = np.stack(
            [
                np.column_stack([uu + dx, np.full(len(uu), -out - 0.03), vv + dz])
                for dx, dz in ((-w / 2, 0), (w / 2, 0), (w / 2, h), (-w / 2, h))
            ],
            axis=1,
        )
        at = 4 * np.arange(len(uu))[:, None]
        faces = np.concatenate([at + [0, 1, 2], at + [0, 2, 3]])
        panes = mesh_of(corners.reshape(-1, 3), faces, int(Mat.WINDOW))
        parts.append(moved(panes, (0, 0, 0), turn * np.pi / 2))
    if rng.uniform() < 0.55:
        rise = min(depth_m, 12.0) * 0.3
        over = 0.4
        gable = np.array(
            [
                (-x - over, -y - over, height_m - 0.15),
                (x + over, -y - over, height_m - 0.15),
                (x + over, y + over, height_m - 0.15),
                (-x - over, y + over, height_m - 0.15),
                (-x - over, 0, height_m + rise),
                (x + over, 0, height_m + rise),
            ]
        )
        faces = np.array(
            [[0, 1, 5], [0, 5, 4], [2, 3, 4], [2, 4, 5], [1, 2, 5], [3, 0, 4], [0, 2, 1], [0, 3, 2]]
        )
        walls = [int(Mat.ROOF)] * 4 + [int(mat)] * 2 + [int(Mat.ROOF)] * 2
        parts.append(mesh_of(gable, faces, np.array(walls)))
    else:
        parts.append(
            box(
                (-x - 0.15, -y - 0.15, height_m),
                (x + 0.15, y + 0.15, height_m + 0.35),
                Mat.BUILDING_CONCRETE,
            )
        )
    return Mesh.merged(parts)


def outlined_building(
    outline: BaseGeometry,
    corner: NDArrayFloat,
    inner: BaseGeometry,
    terrain: Terrain,
    top_m: float,
    mat: Mat,
) -> Mesh:
    """A flat-roofed block over any outline, with windows in its longer walls.

    Args:
        outline: A polygon, city metres.
        corner: (2,) what becomes the mesh's origin, so that float32 keeps its precision.
        inner: Line along which the outline was cut and no wall stands.
        terrain: What it stands on.
        top_m: Height of its roof.
        mat: Of its walls.
    """
    vertices: list[NDArrayAny] = []
    materials: list[int] = []
    outline = shapely.orient_polygons(outline)
    # What is built lies on the left of every ring, the outside on its right.
    for ring in (outline.exterior, *outline.interiors):
        xy = shapely.get_coordinates(ring)
        ground = terrain.height_at(xy)
        for k in range(len(xy) - 1):
            a, b = xy[k], xy[k + 1]
            length = float(np.linalg.norm(b - a))
            if length < 1e-6 or shapely.Point((a + b) / 2).distance(inner) < 1e-6:
                continue
            low = float(min(ground[k], ground[k + 1]))
            vertices.append(_panel(a, b, low - 1.0, top_m))
            materials.append(int(mat))
            along = (b - a) / length
            out = np.array([along[1], -along[0]]) * 0.03
            for u in np.arange(1.6, length - 1.5, 2.8):
                for z in np.arange(low + 1.2, top_m - 1.8, 3.1):
                    left = a + along * (u - 0.55) + out
                    vertices.append(_panel(left, left + along * 1.1, z, z + 1.5))
                    materials.append(int(Mat.WINDOW))
    quads = np.array(vertices).reshape(-1, 4, 3) - (*corner, 0.0)
    at = 4 * np.arange(len(quads))[:, None]
    walls = np.stack([at + [0, 1, 2], at + [0, 2, 3]], axis=1).reshape(-1, 3)
    split = shapely.get_parts(shapely.constrained_delaunay_triangles(outline))
    flat = shapely.get_coordinates(shapely.orient_polygons(split)).reshape(-1, 4, 2)[:, :3]
    roof = np.column_stack([flat.reshape(-1, 2) - corner, np.full(3 * len(flat), top_m)])
    return Mesh.merged(
        [
            mesh_of(quads.reshape(-1, 3), walls, np.repeat(materials, 2)),
            mesh_of(roof, np.arange(len(roof)).reshape(-1, 3), int(Mat.ROOF)),
        ]
    )


def _panel(a: NDArrayFloat, b: NDArrayFloat, low: float, high: float) -> NDArrayAny:
    return np.array([[*a, low], [*b, low], [*b, high], [*a, high]])


def _icosphere() -> tuple[NDArrayFloat, NDArrayAny]:
    """42 points and 80 triangles on the unit sphere."""
    g = (1 + 5**0.5) / 2
    points = [(-1, g, 0), (1, g, 0), (-1, -g, 0), (1, -g, 0), (0, -1, g), (0, 1, g), (0, -1, -g),
              (0, 1, -g), (g, 0, -1), (g, 0, 1), (-g, 0, -1), (-g, 0, 1)]  # fmt: skip
    faces = [(0, 11, 5), (0, 5, 1), (0, 1, 7), (0, 7, 10), (0, 10, 11), (1, 5, 9), (5, 11, 4),
             (11, 10, 2), (10, 7, 6), (7, 1, 8), (3, 9, 4), (3, 4, 2), (3, 2, 6), (3, 6, 8),
             (3, 8, 9), (4, 9, 5), (2, 4, 11), (6, 2, 10), (8, 6, 7), (9, 8, 1)]  # fmt: skip
    vertices = [np.array(p) / np.linalg.norm(p) for p in points]
    middles: dict[tuple[int, int], int] = {}

    def middle(a: int, b: int) -> int:
        key = (min(a, b), max(a, b))
        if key not in middles:
            point = vertices[a] + vertices[b]
            vertices.append(point / np.linalg.norm(point))
            middles[key] = len(vertices) - 1
        return middles[key]

    split = []
    for a, b, c in faces:
        ab, bc, ca = middle(a, b), middle(b, c), middle(c, a)
        split += [(a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca)]
    return np.array(vertices), np.array(split)


_SPHERE = _icosphere()


def tree(height_m: float, rng: np.random.Generator) -> Mesh:
    """A trunk and a crown of a few lumpy blobs."""
    crown_m = height_m * float(rng.uniform(0.22, 0.32))
    bare_m = height_m * float(rng.uniform(0.28, 0.40))
    parts = [prism(0.022 * height_m + 0.05, -0.3, height_m * 0.7, Mat.TRUNK, 7, 0.6)]
    points, faces = _SPHERE
    for k in range(int(rng.integers(4, 7))):
        out = 0.0 if k == 0 else crown_m * float(rng.uniform(0.3, 0.7))
        turn = float(rng.uniform(0, 2 * np.pi))
        z = bare_m + crown_m * 0.6 + (height_m - bare_m - crown_m) * float(rng.uniform(0, 1)) * 0.8
        radius = crown_m * float(rng.uniform(0.55, 0.85))
        lumps = radius * rng.uniform(0.78, 1.15, len(points))[:, None]
        blob = points * lumps * (1, 1, 0.85) + (out * np.cos(turn), out * np.sin(turn), z)
        parts.append(mesh_of(blob, faces, int(Mat.FOLIAGE)))
    return Mesh.merged(parts)


def lamp(height_m: float) -> Mesh:
    """A street lamp whose arm reaches to the right, over the road."""
    arm = 1.4
    return Mesh.merged(
        [
            prism(0.09, -0.3, height_m, Mat.POLE, 8, 0.6),
            box((-0.04, -arm, height_m - 0.08), (0.04, 0.05, height_m), Mat.POLE),
            box((-0.13, -arm - 0.5, height_m - 0.12), (0.13, -arm, height_m + 0.02), Mat.POLE),
        ]
    )


def sign(kind: int) -> Mesh:
    """A traffic sign on a pole that faces those who come along x: its face looks to -x.

    Args:
        kind: 0 round, 1 triangular, 2 square.
    """
    sides, turn = ((16, 0.0), (3, np.pi / 2), (4, np.pi / 4))[kind]
    angles = turn + np.arange(sides) * 2 * np.pi / sides
    y, z = 0.36 * np.cos(angles), 2.4 + 0.36 * np.sin(angles)
    fan = np.array([[0, k, k + 1] for k in range(1, sides - 1)])
    # Seen from -x, y runs to the right reversed: the fan turned over faces -x.
    face = mesh_of(np.column_stack([np.full(sides, -0.06), y, z]), fan[:, ::-1], int(Mat.SIGN))
    back = mesh_of(np.column_stack([np.full(sides, -0.045), y, z]), fan, int(Mat.SIGN_BACK))
    return Mesh.merged([prism(0.035, -0.3, 2.7, Mat.POLE, 6), face, back])


def traffic_light() -> Mesh:
    """A signal on a pole beside the road, facing -x."""
    return Mesh.merged(
        [
            prism(0.07, -0.3, 3.3, Mat.POLE, 8),
            box((-0.22, -0.17, 2.3), (-0.02, 0.17, 3.25), Mat.TRAFFIC_LIGHT),
        ]
    )


def hedge(length_m: float, height_m: float, rng: np.random.Generator) -> Mesh:
    """A hedge along x with an uneven face."""
    n = max(int(length_m / 0.6), 2)
    x = np.linspace(-length_m / 2, length_m / 2, n + 1)
    profile = np.array(
        [
            (-0.4, -0.3),
            (-0.45, height_m * 0.6),
            (-0.3, height_m),
            (0.3, height_m),
            (0.45, height_m * 0.6),
            (0.4, -0.3),
        ]
    )
    ring = len(profile)
    points = np.array([[(xi, y, z) for y, z in profile] for xi in x])
    points[:, 1:-1, 1:] += rng.uniform(-0.07, 0.07, (n + 1, ring - 2, 2))
    faces: list[tuple[int, ...]] = []
    for k in range(n):
        for j in range(ring - 1):
            a, b = k * ring + j, k * ring + j + 1
            faces += [(a, a + ring, b + ring), (a, b + ring, b)]
    for base, flip in ((0, 1), (n * ring, -1)):
        faces += [(base, base + j, base + j + 1)[::flip] for j in range(1, ring - 1)]
    return mesh_of(points.reshape(-1, 3), np.array(faces), int(Mat.HEDGE))


def barrier(xyz: NDArrayFloat, height_m: float, thick_m: float, foot_m: float, mat: Mat) -> Mesh:
    """Panels along a polyline (N, 3) on the ground, from foot_m up to height_m above it."""
    parts = []
    for a, b in itertools.pairwise(xyz):
        ahead = (b - a)[:2]
        length = float(np.linalg.norm(ahead))
        if length < 1e-6:
            continue
        side = np.array([-ahead[1], ahead[0], 0.0]) / length * thick_m / 2
        ring = [a - side, b - side, b + side, a + side]
        corners = [p + (0, 0, z) for z in (foot_m, height_m) for p in ring]
        parts.append((np.array(corners), _BOX))
    if not parts:
        return Mesh.merged([])
    vertices = np.concatenate([p for p, _ in parts])
    faces = np.concatenate([f + 8 * k for k, (_, f) in enumerate(parts)])
    return mesh_of(vertices, faces, int(mat))
