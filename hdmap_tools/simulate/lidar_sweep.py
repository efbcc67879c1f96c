"""Lidar sweeps of a scene: rolling rays, noisy ranges, intensities, with true materials."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from hdmap_tools.errors import PoseError
from hdmap_tools.geometry.se3 import Trajectory
from hdmap_tools.simulate.light import CameraLook, light_of
from hdmap_tools.simulate.materials import MATERIALS, Mat
from hdmap_tools.simulate.ray_caster import RayCaster
from hdmap_tools.simulate.sensor_rigs import LidarModel
from hdmap_tools.simulate.settings import Weather
from hdmap_tools.types import NDArrayAny, NDArrayByte, NDArrayFloat32

_LOSS = 0.004
"""Part of the returns lost for no reason that a model has."""


@dataclass(frozen=True, eq=False)
class SimulatedSweep:
    """One turn of the lidar, and what its points truly lie on; firing order.

    Attributes:
        timestamp_ns: When the turn began.
        points_ego: (N, 3) float32 metres, true ego frame at timestamp_ns: ego-motion compensated.
        intensity: (N,) uint8.
        laser_number: (N,) uint8, the topmost laser is 0.
        offset_ns: (N,) int32 time of each point, from timestamp_ns.
        materials: (N,) uint8 ids of `Mat`.
    """

    timestamp_ns: int
    points_ego: NDArrayFloat32
    intensity: NDArrayByte
    laser_number: NDArrayByte
    offset_ns: NDArrayAny
    materials: NDArrayByte


def scan_sweep(
    caster: RayCaster,
    lidar: LidarModel,
    trajectory: Trajectory,
    timestamp_ns: int,
    seed: int,
    *,
    weather: Weather = Weather.CLEAR,
    with_noise: bool = True,
    drive_start_ns: int | None = None,
) -> SimulatedSweep:
    """One turn of the lidar, each ray cast from where the lidar is at its own time.

    Actors stand where they are in the middle of the turn: at 10 Hz and 10 m/s a point
    on one is at most half a metre from where it was when its ray hit. They are no part
    of any map.

    Args:
        caster: The scene.
        lidar: The sensor.
        trajectory: True ``city_SE3_ego``, covering the turn.
        timestamp_ns: When the turn begins.
        seed: Of this sweep's noise.
        weather: Haze and water take light away.
        with_noise: Off, every ray that hits returns its exact range and intensity.
        drive_start_ns: Second zero of the actors; the trajectory's first time if not given.

    Raises:
        PoseError: If the trajectory does not cover the turn.
    """
    from hdmap_tools.simulate.compiled import in_bands
    from hdmap_tools.simulate.lidar_kernels import collect, receive, turn_rays

    num_rings, num_azimuths = lidar.num_rings, lidar.num_azimuths
    count = num_rings * num_azimuths
    azimuth_ns = np.arange(num_azimuths, dtype=np.int64) * lidar.turn_ns // num_azimuths
    times_ns = timestamp_ns + azimuth_ns
    if times_ns[0] < trajectory.timestamps_ns[0] or times_ns[-1] > trajectory.timestamps_ns[-1]:
        raise PoseError(
            f"A turn of the lidar from {times_ns[0]} to {times_ns[-1]} ns is not covered by the "
            f"trajectory, {trajectory.timestamps_ns[0]} to {trajectory.timestamps_ns[-1]} ns."
        )
    ego_rotations, ego_translations = trajectory.interpolate_many(times_ns)
    mount = lidar.ego_SE3_lidar
    rotations = ego_rotations @ mount.rotation
    origins = ego_rotations @ mount.translation + ego_translations - caster.scene.origin_city
    elevations = np.radians(lidar.elevations_deg)
    rays = np.empty((count, 6), np.float32)
    in_bands(
        lambda first, last: turn_rays(first, last, elevations, rotations, origins, rays),
        num_azimuths,
    )
    start_ns = int(trajectory.timestamps_ns[0]) if drive_start_ns is None else drive_start_ns
    hits = caster.cast_rays(rays, (timestamp_ns + lidar.turn_ns // 2 - start_ns) / 1e9)

    light = light_of(CameraLook(weather=weather))
    table = _materials()
    rng = np.random.default_rng(seed)
    random = np.zeros((3, count), np.float32)
    if with_noise:
        rng.standard_normal(dtype=np.float32, out=random[0])
        rng.standard_normal(dtype=np.float32, out=random[1])
        rng.random(dtype=np.float32, out=random[2])
    range_m = np.empty(count, np.float32)
    intensity = np.empty(count, np.uint8)
    limits = np.array([lidar.min_range_m, lidar.max_range_m])

    def receive_band(first: int, last: int) -> None:
        receive(
            first,
            last,
            num_rings,
            rays,
            hits.t,
            hits.normal,
            hits.material,
            hits.wear,
            table.reflectivity,
            table.is_retro,
            table.is_glass,
            table.is_paint,
            float(table.reflectivity[Mat.ASPHALT]),
            lidar.ring_gains,
            limits,
            lidar.range_sigma_m,
            light.haze_per_m,
            light.wet,
            _LOSS,
            random,
            range_m,
            intensity,
        )

    in_bands(receive_band, count)
    kept = np.flatnonzero(np.isfinite(range_m))
    sweep = SimulatedSweep(
        timestamp_ns=timestamp_ns,
        points_ego=np.empty((len(kept), 3), np.float32),
        intensity=np.empty(len(kept), np.uint8),
        laser_number=np.empty(len(kept), np.uint8),
        offset_ns=np.empty(len(kept), np.int32),
        materials=np.empty(len(kept), np.uint8),
    )
    collect(
        kept,
        num_rings,
        rays,
        range_m,
        ego_rotations[0],
        ego_translations[0] - caster.scene.origin_city,
        intensity,
        hits.material,
        azimuth_ns,
        sweep.points_ego,
        sweep.intensity,
        sweep.materials,
        sweep.laser_number,
        sweep.offset_ns,
    )
    return sweep


@dataclass(frozen=True, eq=False)
class _Table:
    """(256,) by material."""

    reflectivity: NDArrayFloat32
    is_retro: NDArrayAny
    is_glass: NDArrayAny
    is_paint: NDArrayAny


@lru_cache(maxsize=1)
def _materials() -> _Table:
    table = _Table(
        np.zeros(256, np.float32), np.zeros(256, bool), np.zeros(256, bool), np.zeros(256, bool)
    )
    for mat, material in MATERIALS.items():
        table.reflectivity[mat] = material.reflectivity
        table.is_retro[mat] = material.is_retroreflective
    table.is_glass[[Mat.WINDOW, Mat.CAR_GLASS, Mat.TRUCK_GLASS, Mat.BUS_GLASS]] = True
    table.is_paint[
        [Mat.PAINT_WHITE, Mat.PAINT_YELLOW, Mat.ZEBRA_PAINT, Mat.STOP_PAINT, Mat.SYMBOL_PAINT]
    ] = True
    return table
