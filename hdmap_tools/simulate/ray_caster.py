"""Rays cast into a scene: what they hit, how far away, what it is made of.

All sensors see the scene through this; open3d's ``RaycastingScene`` (Embree) does the work.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from threading import Lock
from typing import Any, Final

import numpy as np

from hdmap_tools.errors import ShapeError
from hdmap_tools.open3d_import import open3d
from hdmap_tools.simulate.scene import Mesh, Scene
from hdmap_tools.types import NDArrayAny, NDArrayBool, NDArrayByte, NDArrayFloat, NDArrayFloat32

ACTOR_RANGE_M: Final = 250.0
"""Actors further than this from the first ray's origin are left out."""

_KEPT_TIMES: Final = 8
"""Instants whose actors are kept; more than there are threads that ask."""

SHADOW_START_M: Final = 0.02
"""Shadow rays start this far from the surface, or float32 hits it again."""


@dataclass(frozen=True, eq=False)
class Hits:
    """What N rays hit.

    Attributes:
        t: (N,) float32: the hit is at ``origin + t * direction``; infinite without one.
        material: (N,) uint8 ids of `Mat`, the ground's taken from the surface raster;
            ``SKY`` without a hit.
        normal: (N, 3) float32 unit normals in the city frame, turned to the ray's origin.
        wear: (N,) uint8: how much of the paint is left, 255 all.
        on_ground: (N,) bool: whether the material is the surface raster's.
        on_actor: (N,) bool: whether it is something that moves.
    """

    t: NDArrayFloat32
    material: NDArrayByte
    normal: NDArrayFloat32
    wear: NDArrayByte
    on_ground: NDArrayBool
    on_actor: NDArrayBool


@dataclass(frozen=True, eq=False)
class _PlacedActors:
    """The actors where they are at one time."""

    caster: Any
    materials: NDArrayByte
    spheres: NDArrayFloat32


class RayCaster:
    """A scene that rays can be cast into; it is built once and serves all sensors and threads.

    Args:
        scene: What is there. Static meshes are indexed once, actors anew for each time.
    """

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self._static = _indexed(scene.static)
        self._has_static = len(scene.static.triangles) > 0
        grid, origin = scene.surface.grid, scene.origin_city
        self._raster = np.array(
            [
                grid.resolution_m,
                grid.x_min * grid.resolution_m - origin[0],
                grid.y_min * grid.resolution_m - origin[1],
            ]
        )
        self._spheres = [_bounding_sphere(actor.mesh) for actor in scene.actors]
        self._placed: OrderedDict[float, _PlacedActors | None] = OrderedDict()
        self._placing = Lock()

    @property
    def raster_frame(self) -> NDArrayFloat:
        """(3,) cell size of the surface raster and where it begins, x and y, from the scene's origin."""
        return self._raster

    def cast(
        self, origins_city: NDArrayFloat, directions_city: NDArrayFloat, time_s: float
    ) -> Hits:
        """Cast rays from city points (N, 3) or one point (3,) along directions (N, 3).

        Args:
            origins_city: Metres, float64.
            directions_city: Of any length but zero; `Hits.t` counts in it.
            time_s: Seconds of the drive; where the actors are.
        """
        directions = np.asarray(directions_city)
        if directions.ndim != 2 or directions.shape[1] != 3:
            raise ShapeError(f"Directions must be (N, 3), found {directions.shape}.")
        rays = np.empty((len(directions), 6), np.float32)
        rays[:, :3] = np.asarray(origins_city, np.float64) - self.scene.origin_city
        rays[:, 3:] = directions
        return self.cast_rays(rays, time_s)

    def cast_rays(self, rays: NDArrayFloat32, time_s: float) -> Hits:
        """Cast rays (N, 6) float32: origin, metres from the scene's origin, and direction."""
        from hdmap_tools.simulate.compiled import in_bands
        from hdmap_tools.simulate.ray_kernels import resolve_materials

        scene = self.scene
        count = len(rays)
        t, triangle, normal = _cast(self._static, rays)
        material = np.empty(count, np.uint8)
        wear = np.empty(count, np.uint8)
        on_ground = np.empty(count, np.bool_)

        def resolve(first: int, last: int) -> None:
            resolve_materials(
                first,
                last,
                rays,
                t,
                triangle,
                scene.static.materials,
                scene.surface.codes,
                scene.surface.wear,
                self._raster,
                material,
                wear,
                on_ground,
            )

        in_bands(resolve, count)
        hits = Hits(t, material, normal, wear, on_ground, np.zeros(count, np.bool_))
        self._add_actors(hits, rays, time_s)
        return hits

    def _add_actors(self, hits: Hits, rays: NDArrayFloat32, time_s: float) -> None:
        actors = self.actors_at(time_s, rays[0, :3] if len(rays) else np.zeros(3))
        if actors is None:
            return
        rows = _rows_near(rays, hits.t, actors.spheres)
        if len(rows) == 0:
            return
        t, triangle, normal = _cast(actors.caster, rays[rows])
        nearer = t < hits.t[rows]
        rows = rows[nearer]
        hits.t[rows] = t[nearer]
        hits.normal[rows] = normal[nearer]
        hits.material[rows] = actors.materials[triangle[nearer]]
        hits.wear[rows] = 255
        hits.on_ground[rows] = False
        hits.on_actor[rows] = True

    def is_hidden(
        self,
        points: NDArrayFloat32,
        direction: NDArrayFloat,
        time_s: float,
        *,
        reach_m: float = np.inf,
    ) -> NDArrayBool:
        """Which points (N, 3), from the scene's origin, have something in one unit direction.

        Args:
            points: Float32 metres; just off their surface.
            direction: (3,) unit vector, towards the sun.
            time_s: Seconds of the drive.
            reach_m: How far to look.
        """
        rays = np.empty((len(points), 6), np.float32)
        rays[:, :3] = points
        rays[:, 3:] = direction
        return self.is_blocked(rays, time_s, reach_m=reach_m)

    def is_blocked(
        self, rays: NDArrayFloat32, time_s: float, *, reach_m: float = np.inf
    ) -> NDArrayBool:
        """Which rays (N, 6), from the scene's origin, hit anything within `reach_m` lengths."""
        if len(rays) == 0:
            return np.zeros(0, np.bool_)
        tensor = open3d().core.Tensor.from_numpy(rays)
        blocked: NDArrayBool = self._static.test_occlusions(
            tensor, tnear=SHADOW_START_M, tfar=reach_m
        ).numpy()
        actors = self.actors_at(time_s, rays[0, :3])
        if actors is not None:
            reach = np.full(len(rays), reach_m, np.float32)
            reach[blocked] = 0.0
            rows = _rows_near(rays, reach, actors.spheres)
            if len(rows):
                tensor = open3d().core.Tensor.from_numpy(rays[rows])
                blocked[rows] |= actors.caster.test_occlusions(
                    tensor, tnear=SHADOW_START_M, tfar=reach_m
                ).numpy()
        return blocked

    def actors_at(self, time_s: float, near: NDArrayAny) -> _PlacedActors | None:
        """The actors within `ACTOR_RANGE_M` of a point, from the scene's origin; None without any.

        Kept for the times last asked for: all cameras and the shadows of one instant share it.
        """
        with self._placing:
            if time_s not in self._placed:
                self._placed[time_s] = self._place(time_s, near)
                if len(self._placed) > _KEPT_TIMES:
                    self._placed.popitem(last=False)
            return self._placed[time_s]

    def _place(self, time_s: float, near: NDArrayAny) -> _PlacedActors | None:
        meshes: list[Mesh] = []
        spheres: list[tuple[float, ...]] = []
        for actor, (centre, radius) in zip(self.scene.actors, self._spheres, strict=True):
            xyz, yaw = actor.place_at(time_s)
            xyz = xyz - self.scene.origin_city
            if np.hypot(*(xyz[:2] - near[:2])) > ACTOR_RANGE_M:
                continue
            cos, sin = np.cos(yaw), np.sin(yaw)
            rotation = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
            vertices = actor.mesh.vertices @ rotation.T + xyz
            meshes.append(
                Mesh(vertices.astype(np.float32), actor.mesh.triangles, actor.mesh.materials)
            )
            spheres.append((*(rotation @ centre + xyz), radius))
        placed = None
        if meshes:
            merged = Mesh.merged(meshes)
            placed = _PlacedActors(
                _indexed(merged), merged.materials, np.array(spheres, dtype=np.float32)
            )
        return placed


def _indexed(mesh: Mesh) -> Any:
    o3d = open3d()
    caster = o3d.t.geometry.RaycastingScene()
    if len(mesh.triangles):
        caster.add_triangles(
            o3d.core.Tensor.from_numpy(np.ascontiguousarray(mesh.vertices, np.float32)),
            o3d.core.Tensor.from_numpy(np.ascontiguousarray(mesh.triangles, np.uint32)),
        )
        # The index is built for the first ray, which two threads must not both be.
        caster.cast_rays(o3d.core.Tensor.from_numpy(np.ones((1, 6), np.float32)))
    return caster


def _cast(caster: Any, rays: NDArrayFloat32) -> tuple[NDArrayFloat32, NDArrayAny, NDArrayFloat32]:
    """Lengths, triangles and unit normals, turned towards the rays' origins."""
    from hdmap_tools.simulate.compiled import in_bands
    from hdmap_tools.simulate.ray_kernels import turn_normals

    answer = caster.cast_rays(open3d().core.Tensor.from_numpy(np.ascontiguousarray(rays)))
    normal: NDArrayFloat32 = answer["primitive_normals"].numpy()
    in_bands(lambda first, last: turn_normals(first, last, rays, normal), len(rays))
    return answer["t_hit"].numpy(), answer["primitive_ids"].numpy(), normal


def _rows_near(rays: NDArrayFloat32, reach: NDArrayFloat32, spheres: NDArrayFloat32) -> NDArrayAny:
    from hdmap_tools.simulate.compiled import in_bands
    from hdmap_tools.simulate.ray_kernels import near_spheres

    is_near = np.empty(len(rays), np.bool_)

    def find(first: int, last: int) -> None:
        near_spheres(first, last, rays, reach, spheres, is_near)

    in_bands(find, len(rays))
    return np.flatnonzero(is_near)


def _bounding_sphere(mesh: Mesh) -> tuple[NDArrayFloat, float]:
    if len(mesh.vertices) == 0:
        return np.zeros(3), 0.0
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    centre = np.asarray((low + high) / 2, dtype=np.float64)
    return centre, float(np.linalg.norm(mesh.vertices - centre, axis=1).max()) + 1e-3
