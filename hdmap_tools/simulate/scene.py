"""The world around one piece of a route, as sensors see it: meshes, ground surface, moving actors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hdmap_tools.errors import ShapeError
from hdmap_tools.geometry.grid import BevGrid
from hdmap_tools.types import NDArrayAny, NDArrayByte, NDArrayFloat


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles with a material each.

    Attributes:
        vertices: (V, 3) float32 metres; from the scene's origin, or in an actor's frame.
        triangles: (T, 3) uint32 indices of vertices, counter-clockwise seen from outside.
        materials: (T,) uint8 ids of `Mat`.
    """

    vertices: NDArrayAny
    triangles: NDArrayAny
    materials: NDArrayByte

    def __post_init__(self) -> None:
        if (
            self.vertices.ndim != 2
            or self.vertices.shape[1] != 3
            or self.triangles.ndim != 2
            or self.triangles.shape[1] != 3
            or self.materials.shape != (len(self.triangles),)
        ):
            raise ShapeError(
                f"A mesh needs vertices (V, 3), triangles (T, 3) and materials (T,), found "
                f"{self.vertices.shape}, {self.triangles.shape}, {self.materials.shape}."
            )

    @classmethod
    def merged(cls, meshes: list[Mesh]) -> Mesh:
        """All of them as one."""
        starts = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes])
        if not meshes:
            return cls(
                np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint32), np.zeros(0, np.uint8)
            )
        return cls(
            np.concatenate([mesh.vertices for mesh in meshes]).astype(np.float32),
            np.concatenate(
                [mesh.triangles + start for mesh, start in zip(meshes, starts, strict=False)]
            ).astype(np.uint32),
            np.concatenate([mesh.materials for mesh in meshes]).astype(np.uint8),
        )


@dataclass(frozen=True, eq=False)
class SurfaceRaster:
    """What the ground is made of, cell by cell; the truth that images, sweeps and maps share.

    Attributes:
        grid: Cells of 2 cm, city frame; rows go north, row 0 is the southernmost.
        codes: (rows, cols) uint8 ids of `Mat`.
        wear: (rows, cols) uint8: how much of the paint is left, 255 all, 0 none; only
            means something where the code is a paint. Labels do not follow wear:
            a worn mark is a mark.
    """

    grid: BevGrid
    codes: NDArrayByte
    wear: NDArrayByte


@dataclass(frozen=True, eq=False)
class Actor:
    """Something that moves on its own.

    Attributes:
        mesh: In the actor's frame: x ahead, y left, z up, the ground at z = 0.
        times_s: (K,) float64, rising; seconds of the drive.
        xyz_city: (K, 3) float64 metres.
        yaw_rad: (K,) float64, unwrapped.
    """

    mesh: Mesh
    times_s: NDArrayFloat
    xyz_city: NDArrayFloat
    yaw_rad: NDArrayFloat

    def place_at(self, time_s: float) -> tuple[NDArrayFloat, float]:
        """Position (3,) and yaw at a time; it stands still before its first and after its last."""
        xyz = np.array([np.interp(time_s, self.times_s, c) for c in self.xyz_city.T])
        return xyz, float(np.interp(time_s, self.times_s, self.yaw_rad))


@dataclass(frozen=True, eq=False)
class Scene:
    """All that sensors can meet around one piece of a route.

    Attributes:
        origin_city: (3,) float64 whole metres, city frame: subtracted from what is cast, so
            that float32 keeps its precision far from the city origin.
        static: Ground and all that stands, from the origin. Triangles of material
            ``GROUND`` take theirs from the surface raster at the hit's x and y.
        surface: Materials of the ground.
        actors: Moving things.
        stretch_m: Arc lengths of the route between which the vehicle may be.
    """

    origin_city: NDArrayFloat
    static: Mesh
    surface: SurfaceRaster
    actors: tuple[Actor, ...] = ()
    stretch_m: tuple[float, float] = (0.0, float("inf"))


def label_ids_by_material(label_names: tuple[str, ...]) -> NDArrayByte:
    """(256,) uint8 table from material to label id; 255 for ids that are no material.

    Args:
        label_names: Names of the label set, ``paz2020``, in the order of its ids.
    """
    from hdmap_tools.simulate.materials import MATERIALS

    table = np.full(256, 255, dtype=np.uint8)
    for mat, material in MATERIALS.items():
        table[mat] = label_names.index(material.label)
    return table
