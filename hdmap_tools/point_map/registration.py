"""Pieces of plane surface found in many sweeps, and what each sweep's points say about its pose.

Point-to-plane registration: a sweep's points on a piece of surface lie off its plane by
``n . (p - m)``, which moves with the pose by ``[n, q x n]`` (q from the vehicle to the
point, both in city axes; the pose is changed by a shift and a turn about the vehicle).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from hdmap_tools.point_map.refine_config import RefineConfig
from hdmap_tools.types import NDArrayBool, NDArrayFloat, NDArrayInt

DIRECTIONS: Final = ("along", "across", "up", "roll", "pitch", "yaw")

_MIN_POINTS: Final = 8
_MIN_SWEEPS: Final = 3
_MIN_SPREAD: Final = 0.12
"""Of a surface's points, in its size, across its narrower side: less is a line, whose
plane may turn about it (points spread evenly over a square have 0.29)."""

_TIGHT: Final = 1e7
_LOOSE: Final = 1e-4
"""Of a bond, in units of the given poses' information: a hundredth of a millimetre, and metres."""

_BITS: Final = 21
_OFFSET: Final = 1 << 20


@dataclass(frozen=True, eq=False)
class SweepPoints:
    """Thinned points of several sweeps, one sweep after another.

    Attributes:
        points_ego: (M, 3) metres, each in the ego frame of its own sweep.
        weights: (M,) how many points of the sweep each stands for, at most 5.
        sweeps: (M,) int64, index of its sweep, not decreasing.
    """

    points_ego: NDArrayFloat
    weights: NDArrayFloat
    sweeps: NDArrayInt

    @classmethod
    def joined(cls, thinned: Sequence[tuple[NDArrayFloat, NDArrayFloat]]) -> SweepPoints:
        """Of thinned sweeps (points and weights), numbered in order."""
        counts = [len(points) for points, _ in thinned]
        if not counts:
            return cls(np.zeros((0, 3)), np.zeros(0), np.zeros(0, np.int64))
        return cls(
            np.concatenate([points for points, _ in thinned]).astype(np.float64),
            np.concatenate([weights for _, weights in thinned]).astype(np.float64),
            np.repeat(np.arange(len(counts)), counts),
        )

    def in_city(
        self, rotations: NDArrayFloat, translations: NDArrayFloat
    ) -> tuple[NDArrayFloat, NDArrayFloat]:
        """Points (M, 3) in the city frame, by the poses (S, 3, 3), (S, 3) of the sweeps."""
        counts = np.bincount(self.sweeps, minlength=len(translations))
        ends = np.cumsum(counts)
        points = np.empty_like(self.points_ego)
        for index, (end, count) in enumerate(zip(ends, counts, strict=True)):
            part = slice(end - count, end)
            points[part] = self.points_ego[part] @ rotations[index].T + translations[index]
        return points, translations[self.sweeps]


def thin_sweep(points_ego: NDArrayFloat, config: RefineConfig) -> tuple[NDArrayFloat, NDArrayFloat]:
    """Average a sweep's points over cells.

    Args:
        points_ego: (N, 3) metres.
        config: Gives range, cell size and how many cells at most.

    Returns:
        Points (M, 3) float32 and weights (M,): points averaged, at most 5.
    """
    squared = np.einsum("ij,ij->i", points_ego[:, :2], points_ego[:, :2])
    points = points_ego[(squared < config.max_range_m**2) & (squared > 2.0)]
    if len(points) == 0:
        return np.zeros((0, 3), np.float32), np.zeros(0)
    keys = _pack(np.floor(points / config.thin_m).astype(np.int64))
    order = np.argsort(keys, kind="stable")
    starts = np.flatnonzero(np.diff(keys[order], prepend=keys[order[0]] - 1))
    counts = np.diff(starts, append=len(keys))
    means = np.add.reduceat(points[order], starts, axis=0) / counts[:, None]
    if len(means) > config.max_points:
        # Evenly over the sorted cells, so evenly in space.
        kept = np.linspace(0, len(means) - 1, config.max_points).astype(np.int64)
        means, counts = means[kept], counts[kept]
    return means.astype(np.float32), np.minimum(counts, 5).astype(np.float64)


@dataclass(frozen=True, eq=False)
class SurfaceMap:
    """Pieces of plane surface of a place.

    Attributes:
        means: (V, 3) metres, city frame: a point of each plane.
        normals: (V, 3) unit.
        tilts: (V, 2, 3) tangents, scaled by the sigma of the normal's tilt towards them.
        keys: Per level the voxels that hold a surface, ascending.
        firsts: Per level the index of the first of its surfaces.
        sizes_m: Per level the size of a voxel.
        origin: (3,) corner that voxels count from.
    """

    means: NDArrayFloat
    normals: NDArrayFloat
    tilts: NDArrayFloat
    keys: tuple[NDArrayInt, ...]
    firsts: tuple[int, ...]
    sizes_m: tuple[float, ...]
    origin: NDArrayFloat

    def __len__(self) -> int:
        return len(self.means)

    def surface_of(self, points_city: NDArrayFloat) -> NDArrayInt:
        """The surface (N,) whose voxel each point lies in, or -1."""
        found = np.full(len(points_city), -1, np.int64)
        for keys, first, size in zip(self.keys, self.firsts, self.sizes_m, strict=True):
            if len(keys) == 0:
                continue
            left = np.flatnonzero(found < 0)
            wanted = _pack(np.floor((points_city[left] - self.origin) / size).astype(np.int64))
            at = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
            hit = keys[at] == wanted
            found[left[hit]] = first + at[hit]
        return found


@dataclass(frozen=True, eq=False)
class Observations:
    """What sweeps saw of surfaces: one row a sweep and surface, sorted by surface, then sweep.

    Attributes:
        starts: (V + 1,) where each surface's rows begin.
        surface, sweep: (O,) indices.
        means: (O, 3) mean point, city frame.
        counts: (O,) points behind it.
    """

    starts: NDArrayInt
    surface: NDArrayInt
    sweep: NDArrayInt
    means: NDArrayFloat
    counts: NDArrayFloat


def find_surfaces(
    points_city: NDArrayFloat,
    weights: NDArrayFloat,
    sweeps: NDArrayInt,
    visits: NDArrayInt,
    *,
    origin: NDArrayFloat,
    thickness_m: float,
    config: RefineConfig,
) -> tuple[SurfaceMap, Observations]:
    """Cut the points into voxels, large ones first, and keep those that hold a plane.

    Args:
        points_city: (M, 3) metres.
        weights: (M,).
        sweeps: (M,) int64, not decreasing.
        visits: (S,) number of the visit that each sweep belongs to, not decreasing.
        origin: (3,) corner that voxels count from. A plane on the face between two voxels
            is cut in two halves that do not follow a moved sweep, so it should differ
            from pass to pass.
        thickness_m: Largest sigma of points about a plane.
        config: Gives the sizes.
    """
    from hdmap_tools.point_map.surfel_kernels import observe, pooled_moments

    rest = np.arange(len(points_city))
    keys_of, firsts_of, sizes = [], [0], []
    planes: list[tuple[NDArrayFloat, NDArrayFloat, NDArrayFloat]] = []
    seen: list[tuple[NDArrayInt, NDArrayInt, NDArrayFloat, NDArrayFloat]] = []
    for level in range(config.surface_levels):
        size = config.surface_size_m / 2**level
        sizes.append(size)
        keys = _pack(np.floor((points_city[rest] - origin) / size).astype(np.int64))
        order = np.argsort(keys, kind="stable")
        keys, order = keys[order], rest[order]
        starts = np.flatnonzero(np.diff(keys, prepend=-1)) if len(keys) else np.zeros(0, np.int64)
        ends = np.append(starts[1:], len(keys))
        num_sweeps, means, covariance = pooled_moments(
            points_city, weights, sweeps, visits, order, np.append(starts, len(keys))
        )
        values, vectors = np.linalg.eigh(covariance)
        thickness = np.sqrt(np.maximum(values[:, 0], 1e-6))
        is_plane: NDArrayBool = (
            (ends - starts >= _MIN_POINTS)
            & (num_sweeps >= _MIN_SWEEPS)
            & (thickness <= thickness_m)
            & (values[:, 1] >= (_MIN_SPREAD * size) ** 2)
        )
        chosen = np.flatnonzero(is_plane)
        tilt = thickness[chosen, None] / np.sqrt(
            (ends - starts)[chosen, None] * values[chosen][:, 1:]
        )
        tangents = vectors[chosen][:, :, 1:].transpose(0, 2, 1)
        planes.append((means[chosen], vectors[chosen][:, :, 0], tangents * tilt[:, :, None]))
        surface, sweep, count, mean = observe(
            points_city, weights, sweeps, order, starts[chosen], ends[chosen]
        )
        seen.append((surface + firsts_of[-1], sweep, count, mean))
        keys_of.append(keys[starts[chosen]])
        firsts_of.append(firsts_of[-1] + len(chosen))
        # Points in order of sweeps again, as the loops over them expect.
        rest = np.sort(order[np.repeat(~is_plane, ends - starts)])
    all_means, normals, tilts = (np.concatenate(part) for part in zip(*planes, strict=True))
    surfaces = SurfaceMap(
        all_means,
        np.ascontiguousarray(normals),
        np.ascontiguousarray(tilts),
        keys=tuple(keys_of),
        firsts=tuple(firsts_of[:-1]),
        sizes_m=tuple(sizes),
        origin=origin,
    )
    rows = Observations(
        np.zeros(0, np.int64),
        np.concatenate([part[0] for part in seen]),
        np.concatenate([part[1] for part in seen]),
        np.concatenate([part[3] for part in seen]),
        np.concatenate([part[2] for part in seen]),
    )
    row_starts = np.searchsorted(rows.surface, np.arange(len(surfaces) + 1))
    return surfaces, replace(rows, starts=row_starts)


def observe_known(
    surfaces: SurfaceMap, points_city: NDArrayFloat, weights: NDArrayFloat, sweep: int
) -> Observations:
    """What one sweep saw of known surfaces; `starts` is left empty."""
    found = surfaces.surface_of(points_city)
    hit = found >= 0
    found, points, weights = found[hit], points_city[hit], weights[hit]
    unique, inverse = np.unique(found, return_inverse=True)
    counts = np.bincount(inverse, weights, minlength=len(unique)).astype(np.float64)
    means = np.column_stack(
        [np.bincount(inverse, weights * points[:, k], minlength=len(unique)) for k in range(3)]
    )
    return Observations(
        np.zeros(0, np.int64),
        unique,
        np.full(len(unique), sweep, np.int64),
        means / counts[:, None],
        counts,
    )


def variances(counts: NDArrayFloat, config: RefineConfig) -> NDArrayFloat:
    """Variance (O,) of a mean point along the normal, square metres."""
    return config.range_noise_m**2 / counts + config.surface_noise_m**2


def jacobians(normals: NDArrayFloat, arms: NDArrayFloat) -> NDArrayFloat:
    """(O, 6) how the distance from the plane changes with a shift and a turn of the vehicle."""
    return np.concatenate([normals, np.cross(arms, normals)], axis=1)


@dataclass(frozen=True, eq=False)
class Hold:
    """Which directions of each pose the scene holds.

    Attributes:
        keep: (S, 6, 6) takes a change of pose to the part of it that is held.
        ties: (S, 6, 6) information of a bond that is tight in what is held, loose else.
        is_full: All directions of all poses are held.
    """

    keep: NDArrayFloat
    ties: NDArrayFloat
    is_full: bool


def held_directions(
    information: NDArrayFloat, sigmas: NDArrayFloat, min_information: float
) -> Hold:
    """Find them by the eigenvalues of each pose's information.

    Args:
        information: (S, 6, 6) of each pose, from registration.
        sigmas: (S, 6) of the given poses, which make metres and radians comparable.
        min_information: A direction is held when its information, times the variance
            of the given poses in it, is at least this.
    """
    outer = sigmas[:, :, None] * sigmas[:, None, :]
    scaled = information * outer
    values, vectors = np.linalg.eigh((scaled + scaled.transpose(0, 2, 1)) / 2)
    is_held = values >= min_information

    def with_values(diagonal: NDArrayFloat) -> NDArrayFloat:
        result: NDArrayFloat = (vectors * diagonal[:, None, :]) @ vectors.transpose(0, 2, 1)
        return result

    keep = with_values(is_held.astype(np.float64)) * sigmas[:, :, None] / sigmas[:, None, :]
    ties = with_values(np.where(is_held, _TIGHT, _LOOSE)) / outer
    return Hold(keep, ties, bool(is_held.all()))


def _pack(cells: NDArrayInt) -> NDArrayInt:
    """One key (N,) of cells (N, 3), each within a million of zero."""
    shifted = cells + _OFFSET
    result: NDArrayInt = (shifted[:, 0] << (2 * _BITS)) | (shifted[:, 1] << _BITS) | shifted[:, 2]
    return result
