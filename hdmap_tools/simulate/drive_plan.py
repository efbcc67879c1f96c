"""All of a simulated drive that is settled before anything is seen: route, poses, sensors, times."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final

import numpy as np

from hdmap_tools.errors import WorldError
from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.geometry.se3 import Trajectory
from hdmap_tools.simulate.build_scene import SceneBuilder
from hdmap_tools.simulate.route import Route, motion_along, places_along, plan_route
from hdmap_tools.simulate.scene import Actor
from hdmap_tools.simulate.sensor_rigs import LidarModel, cameras_of, lidar_of
from hdmap_tools.simulate.settings import LidarPreset, SimulationSettings
from hdmap_tools.simulate.traffic import build_actors
from hdmap_tools.simulate.vehicle_motion import vehicle_trajectory
from hdmap_tools.simulate.world_map import WorldMap
from hdmap_tools.types import NDArrayFloat

STRETCH_M: Final = 110.0
POSE_HZ: Final = 100

_EPOCH_NS: Final = 315_966_000_000_000_000
"""Times of Argoverse 2 look like this; a drive begins up to a day later, by its seed."""
_DAY_S: Final = 86_400


@dataclass(frozen=True)
class Shot:
    """One thing that a sensor has to do.

    Attributes:
        timestamp_ns: When; of a sweep, when its turn begins.
        camera: Index of the camera, or None for a sweep.
        number: Counts the shots of that sensor.
    """

    timestamp_ns: int
    camera: int | None
    number: int


@dataclass(frozen=True, eq=False)
class DrivePlan:
    """All of a drive that is settled before anything is seen.

    Attributes:
        world, settings: As given.
        route: Where it goes.
        builder: Of the scenes; its terrain is the ground.
        actors: All that moves during the drive.
        start_ns: Time of second 0.
        times_s, arc_m: (K,) when the vehicle is how far along the route.
        city_SE3_ego: True poses, at `POSE_HZ` and at the time of every shot.
        cameras, lidar: With their true mounts; the lidar None where there is none.
        shots: What the sensors do, by time.
    """

    world: WorldMap
    settings: SimulationSettings
    route: Route
    builder: SceneBuilder
    actors: tuple[Actor, ...]
    start_ns: int
    times_s: NDArrayFloat
    arc_m: NDArrayFloat
    city_SE3_ego: Trajectory
    cameras: tuple[PinholeCamera, ...]
    lidar: LidarModel | None
    shots: tuple[Shot, ...]

    @property
    def log_id(self) -> str:
        """Names the files of the log's map; the folder's own name would change bytes."""
        name = re.sub(r"[^A-Za-z0-9.-]+", "-", self.world.name)[:60].strip("-.") or "world"
        return f"{name}-{self.settings.seed}"

    def seconds(self, timestamp_ns: int) -> float:
        """Seconds of the drive."""
        return (timestamp_ns - self.start_ns) / 1e9

    def arc_at(self, timestamp_ns: int) -> float:
        """How far along the route the vehicle is, metres."""
        return float(np.interp(self.seconds(timestamp_ns), self.times_s, self.arc_m))

    def stretches(self) -> list[tuple[tuple[float, float], list[Shot]]]:
        """Pieces of the route of about `STRETCH_M`, each with what is done on it."""
        count = max(1, round(self.route.length_m / STRETCH_M))
        length = self.route.length_m / count
        shots: list[list[Shot]] = [[] for _ in range(count)]
        for shot in self.shots:
            shots[min(int(self.arc_at(shot.timestamp_ns) / length), count - 1)].append(shot)
        # The turn of a sweep that begins on a stretch may end beyond it.
        turn_s = self.lidar.turn_ns / 1e9 if self.lidar is not None else 0.0
        reach = self.settings.speed_mps * turn_s
        return [
            ((k * length, min((k + 1) * length + reach, self.route.length_m)), shots[k])
            for k in range(count)
            if shots[k]
        ]


def plan_drive(world: WorldMap, settings: SimulationSettings) -> DrivePlan:
    """Settle route, motion, sensors and times of a drive.

    Raises:
        WorldError: If the world has no such route, or it is over before a sensor has
            seen anything.
    """
    route = plan_route(world, settings.length_m, settings.start, settings.seed)
    builder = SceneBuilder(world, settings)
    terrain = builder.terrain
    cameras = cameras_of(
        settings.camera_rig,
        settings.image_width_px,
        settings.image_height_px,
        settings.camera_height_m,
    )
    lidar = None
    if settings.lidar != LidarPreset.NONE:
        lidar = lidar_of(settings.lidar, settings.lidar_hz, settings.seed)
    start_ns = start_time_ns(settings.seed)
    times_s, arc_m = motion_along(route, settings.speed_mps, POSE_HZ)
    knots_ns = start_ns + np.round(times_s * 1e9).astype(np.int64)
    xy, yaw_rad = places_along(route, arc_m)
    moved = vehicle_trajectory(knots_ns, xy, yaw_rad, terrain.height_at)
    turn_ns = lidar.turn_ns if lidar is not None else None
    shots = planned_shots(settings, len(cameras), turn_ns, start_ns, int(knots_ns[-1]))
    if not shots:
        raise WorldError(
            f"The drive through {world.name} takes {times_s[-1]:.2f} s, in which no camera and no "
            "lidar sees anything; choose a longer route, a lower speed or higher rates."
        )
    # Recorded logs have a pose at the very time of each image and sweep, and the data
    # set's package looks for it.
    all_ns = np.union1d(knots_ns, [shot.timestamp_ns for shot in shots])
    poses = Trajectory(all_ns, *moved.interpolate_many(all_ns))
    return DrivePlan(
        world=world,
        settings=settings,
        route=route,
        builder=builder,
        actors=build_actors(world, route, times_s, arc_m, settings, terrain, builder.index),
        start_ns=start_ns,
        times_s=times_s,
        arc_m=arc_m,
        city_SE3_ego=poses,
        cameras=tuple(cameras),
        lidar=lidar,
        shots=tuple(shots),
    )


def start_time_ns(seed: int) -> int:
    """When a drive begins, nanoseconds: whole seconds that follow from its seed."""
    return _EPOCH_NS + int(np.random.default_rng([seed, 0x71E]).integers(_DAY_S)) * 10**9


def planned_shots(
    settings: SimulationSettings,
    num_cameras: int,
    turn_ns: int | None,
    start_ns: int,
    end_ns: int,
) -> tuple[Shot, ...]:
    """Images and sweeps by time; each camera has a phase of its own, sweeps follow each other.

    Args:
        settings: The rates.
        num_cameras: Of the rig.
        turn_ns: Time of one sweep; None is no lidar, so no sweeps.
        start_ns: When the drive begins.
        end_ns: When it ends; a sweep whose turn is not over then is left out.
    """
    shots: list[Shot] = []
    if turn_ns is not None:
        count = int((end_ns - start_ns) // turn_ns)
        shots += [Shot(start_ns + k * turn_ns, None, k) for k in range(count)]
    step_ns = 1e9 / settings.camera_hz
    for camera in range(num_cameras):
        first_ns = step_ns * (camera + 0.5) / num_cameras
        count = int(np.floor((end_ns - start_ns - first_ns) / step_ns)) + 1
        shots += [
            Shot(start_ns + round(first_ns + k * step_ns), camera, k) for k in range(max(count, 0))
        ]
    return tuple(
        sorted(
            shots, key=lambda shot: (shot.timestamp_ns, -1 if shot.camera is None else shot.camera)
        )
    )
