"""A whole simulated drive: world in, Argoverse 2 sensor log and truth out.

    world ─► route ─► true poses ─► for each stretch of the route: scene ─► images, sweeps
                          └─► pose errors ─► poses that are handed out

The route is cut into stretches, and the scene of one is built, seen by all sensors and
dropped before the next, so that memory does not grow with the drive. A scene follows from
the seed and the place alone, so that neighbouring stretches show the same world.
"""

from __future__ import annotations

import logging
import re
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np

from hdmap_tools.errors import WorldError
from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.geometry.se3 import SE3, Trajectory
from hdmap_tools.output_folder import is_result_of, require_free, result_folder
from hdmap_tools.simulate import truth_files, write_log
from hdmap_tools.simulate.build_scene import SceneBuilder
from hdmap_tools.simulate.camera_image import render_image
from hdmap_tools.simulate.lidar_sweep import scan_sweep
from hdmap_tools.simulate.light import CameraLook
from hdmap_tools.simulate.log_map import write_log_map
from hdmap_tools.simulate.pose_errors import disturbed_mount, disturbed_trajectory
from hdmap_tools.simulate.ray_caster import RayCaster
from hdmap_tools.simulate.read_world import read_world
from hdmap_tools.simulate.route import Route, motion_along, places_along, plan_route
from hdmap_tools.simulate.scene import Actor
from hdmap_tools.simulate.sensor_rigs import LidarModel, cameras_of, lidar_of
from hdmap_tools.simulate.settings import SimulationSettings
from hdmap_tools.simulate.terrain import Terrain
from hdmap_tools.simulate.vehicle_motion import vehicle_trajectory
from hdmap_tools.simulate.world_map import WorldMap
from hdmap_tools.types import NDArrayFloat

_log = logging.getLogger(__name__)

COMMAND: Final = "simulate"
STRETCH_M: Final = 110.0
POSE_HZ: Final = 100

_EPOCH_NS: Final = 315_966_000_000_000_000
"""Times of Argoverse 2 look like this; a drive begins up to a day later, by its seed."""
_DAY_S: Final = 86_400
_MAX_PENDING: Final = 6
"""Encoded images that may wait for the disk."""


class SimulationProgress(Protocol):
    """What a progress bar needs to be told."""

    def __call__(self, what: str, done: int, total: int) -> None:
        """How many ``images`` or ``sweeps`` are done; told once with 0 done."""
        ...


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


def simulate_drive(
    world_path: Path,
    out: Path,
    settings: SimulationSettings,
    *,
    origin: tuple[float, float, float] | None = None,
    overwrite: bool = False,
    progress: SimulationProgress | None = None,
) -> Path:
    """Drive through a map and write what the sensors saw.

    Args:
        world_path: A map, as `read_world` takes it.
        out: Folder to make: a log in the Argoverse 2 sensor layout, with ``truth/``.
        settings: What the drive is like; the same settings give the same bytes.
        origin: Latitude, longitude (degrees) and height (metres) of the city frame, where
            the map does not say it.
        overwrite: Whether an earlier simulated drive may be replaced.
        progress: Told about images and sweeps.

    Returns:
        The folder.

    Raises:
        WorldError: If the map gives no world or no route.
        FormatError: If the map is damaged.
        OutputExistsError: If the folder exists and may not be replaced.
    """
    require_free(out, overwrite, is_result_of(COMMAND))
    plan = plan_drive(read_world(world_path, origin), settings)
    with result_folder(out, COMMAND, overwrite) as log:
        truth = log / truth_files.TRUTH_FOLDER
        _write_tables(log, truth, plan, world_path)
        _Recorder(log, truth, plan, progress).record()
    return out


@dataclass(frozen=True, eq=False)
class DrivePlan:
    """All of a drive that is settled before anything is seen.

    Attributes:
        world, settings: As given.
        route: Where it goes.
        terrain: The ground.
        start_ns: Time of second 0.
        times_s, arc_m: (K,) when the vehicle is how far along the route.
        city_SE3_ego: True poses, at `POSE_HZ` and at the time of every shot.
        cameras, lidar: With their true mounts.
        shots: What the sensors do, by time.
    """

    world: WorldMap
    settings: SimulationSettings
    route: Route
    terrain: Terrain
    start_ns: int
    times_s: NDArrayFloat
    arc_m: NDArrayFloat
    city_SE3_ego: Trajectory
    cameras: tuple[PinholeCamera, ...]
    lidar: LidarModel
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
        reach = self.settings.speed_mps * self.lidar.turn_ns / 1e9
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
    terrain = Terrain(settings.seed)
    cameras = cameras_of(settings.camera_rig, settings.image_width_px, settings.image_height_px)
    lidar = lidar_of(settings.lidar, settings.lidar_hz, settings.seed)
    start_ns = start_time_ns(settings.seed)
    times_s, arc_m = motion_along(route, settings.speed_mps, POSE_HZ)
    knots_ns = start_ns + np.round(times_s * 1e9).astype(np.int64)
    xy, yaw_rad = places_along(route, arc_m)
    moved = vehicle_trajectory(knots_ns, xy, yaw_rad, terrain.height_at)
    shots = planned_shots(settings, len(cameras), lidar.turn_ns, start_ns, int(knots_ns[-1]))
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
        world,
        settings,
        route,
        terrain,
        start_ns,
        times_s,
        arc_m,
        poses,
        tuple(cameras),
        lidar,
        shots,
    )


def start_time_ns(seed: int) -> int:
    """When a drive begins, nanoseconds: whole seconds that follow from its seed."""
    return _EPOCH_NS + int(np.random.default_rng([seed, 0x71E]).integers(_DAY_S)) * 10**9


def planned_shots(
    settings: SimulationSettings, num_cameras: int, turn_ns: int, start_ns: int, end_ns: int
) -> tuple[Shot, ...]:
    """Images and sweeps by time; each camera has a phase of its own, sweeps follow each other.

    Args:
        settings: The rates.
        num_cameras: Of the rig.
        turn_ns: Time of one sweep.
        start_ns: When the drive begins.
        end_ns: When it ends; a sweep whose turn is not over then is left out.
    """
    shots = [
        Shot(start_ns + k * turn_ns, None, k) for k in range(int((end_ns - start_ns) // turn_ns))
    ]
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


def _write_tables(log: Path, truth: Path, plan: DrivePlan, world_path: Path) -> None:
    """Everything but what sensors see."""
    settings = plan.settings
    sigma_m, sigma_deg = settings.calibration_error_m, settings.calibration_error_deg

    def given(mount: SE3, sensor: str) -> SE3:
        return disturbed_mount(mount, sensor, sigma_m, sigma_deg, settings.seed)

    write_log.write_poses(
        log, disturbed_trajectory(plan.city_SE3_ego, settings.pose_errors, settings.seed)
    )
    write_log.write_calibration(
        log,
        [replace(c, ego_SE3_cam=given(c.ego_SE3_cam, c.name)) for c in plan.cameras],
        given(plan.lidar.ego_SE3_lidar, plan.lidar.name),
    )
    write_log.write_map_frame(log, plan.world.frame)
    write_log_map(log, plan.log_id, plan.world, plan.route.xy, plan.terrain.height_at)
    write_log.write_poses(truth, plan.city_SE3_ego)
    write_log.write_json(
        truth / "simulation.json",
        truth_files.simulation_document(
            world_path, plan.world, plan.route, settings, plan.cameras, plan.lidar
        ),
    )
    truth_files.write_label_folder_head(truth)


class _Recorder:
    """Drives the route and writes what the sensors see; files are written by threads."""

    def __init__(
        self, log: Path, truth: Path, plan: DrivePlan, progress: SimulationProgress | None
    ) -> None:
        self._log, self._truth, self._plan = log, truth, plan
        self._progress = progress
        self._builder = SceneBuilder(plan.world, plan.settings, plan.terrain)
        self._actors: tuple[Actor, ...] = ()
        num_sweeps = sum(shot.camera is None for shot in plan.shots)
        self._total = {"images": len(plan.shots) - num_sweeps, "sweeps": num_sweeps}
        self._done = dict.fromkeys(self._total, 0)
        self._look = CameraLook(plan.settings.weather, plan.settings.difficulty, plan.settings.seed)
        error = disturbed_mount(
            plan.lidar.ego_SE3_lidar,
            plan.lidar.name,
            plan.settings.calibration_error_m,
            plan.settings.calibration_error_deg,
            plan.settings.seed,
        )
        # Points are handed out in the ego frame, to which the given mount took them.
        self._given_SE3_ego = error @ plan.lidar.ego_SE3_lidar.inverse()
        self._is_exact = error is plan.lidar.ego_SE3_lidar
        self._pending: deque[Future[None]] = deque()

    def record(self) -> None:
        for what in self._total:
            self._tell(what, 0)
        with ThreadPoolExecutor(2, thread_name_prefix="encode") as pool:
            try:
                for stretch_m, shots in self._plan.stretches():
                    self._record_stretch(pool, stretch_m, shots)
                while self._pending:
                    self._pending.popleft().result()
            except BaseException:
                pool.shutdown(wait=True, cancel_futures=True)
                raise

    def _record_stretch(
        self, pool: ThreadPoolExecutor, stretch_m: tuple[float, float], shots: Sequence[Shot]
    ) -> None:
        plan = self._plan
        scene = self._builder.scene(plan.route, stretch_m, self._actors)
        _log.info(
            "Stretch %.0f to %.0f m: %d triangles, %d actors, %d images and sweeps.",
            *stretch_m,
            len(scene.static.triangles),
            len(scene.actors),
            len(shots),
        )
        caster = RayCaster(scene)
        for shot in shots:
            if shot.camera is None:
                self._take_sweep(pool, caster, shot)
            else:
                self._take_image(pool, caster, shot, shot.camera)
            self._tell("sweeps" if shot.camera is None else "images", 1)

    def _take_image(
        self, pool: ThreadPoolExecutor, caster: RayCaster, shot: Shot, index: int
    ) -> None:
        plan, camera, time_ns = self._plan, self._plan.cameras[index], shot.timestamp_ns
        image = render_image(
            caster,
            camera,
            plan.city_SE3_ego.interpolate(time_ns),
            plan.seconds(time_ns),
            self._look,
            _seed_of(plan.settings.seed, 1 + index, shot.number),
        )
        path = write_log.image_path(self._log, camera.name, time_ns)
        self._submit(pool, write_log.write_jpeg, path, image.rgb)
        self._submit(
            pool, truth_files.write_true_labels, self._truth, camera.name, time_ns, image.labels
        )

    def _take_sweep(self, pool: ThreadPoolExecutor, caster: RayCaster, shot: Shot) -> None:
        plan = self._plan
        sweep = scan_sweep(
            caster,
            plan.lidar,
            plan.city_SE3_ego,
            shot.timestamp_ns,
            _seed_of(plan.settings.seed, 0, shot.number),
            weather=plan.settings.weather,
            drive_start_ns=plan.start_ns,
        )
        points = sweep.points_ego
        if not self._is_exact:
            points = self._given_SE3_ego.transform_from(points).astype(np.float32)
        self._submit(
            pool,
            write_log.write_sweep,
            self._log,
            shot.timestamp_ns,
            points,
            sweep.intensity,
            sweep.laser_number,
            sweep.offset_ns,
        )

    def _submit(self, pool: ThreadPoolExecutor, write: Callable[..., None], *args: Any) -> None:
        while len(self._pending) >= _MAX_PENDING:
            self._pending.popleft().result()
        self._pending.append(pool.submit(write, *args))

    def _tell(self, what: str, more: int) -> None:
        self._done[what] += more
        if self._progress is not None:
            self._progress(what, self._done[what], self._total[what])


def _seed_of(seed: int, sensor: int, number: int) -> int:
    """A seed of its own for each shot of each sensor."""
    state = np.random.SeedSequence([seed, sensor, number]).generate_state(2, np.uint32)
    return int(state[0]) | int(state[1] & 0x7FFFFFFF) << 32
