"""A whole simulated drive: world in, Argoverse 2 sensor log and truth out.

    world ─► route ─► true poses ─► for each stretch of the route: scene ─► images, sweeps
                          └─► pose errors ─► poses that are handed out

The route is cut into stretches, and the scene of one is built, seen by all sensors and
dropped before the next, so that memory does not grow with the drive. A scene follows from
the seed and the place alone, so that neighbouring stretches show the same world.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np

from hdmap_tools.formats.gpkg import write_gpkg
from hdmap_tools.geometry.se3 import SE3
from hdmap_tools.output_folder import is_result_of, require_free, result_folder
from hdmap_tools.readers.av2 import TRUE_MAP_FILE
from hdmap_tools.simulate import truth_files, write_log
from hdmap_tools.simulate.camera_image import render_image
from hdmap_tools.simulate.drive_plan import DrivePlan, Shot, plan_drive
from hdmap_tools.simulate.lidar_sweep import scan_sweep
from hdmap_tools.simulate.light import CameraLook
from hdmap_tools.simulate.log_map import write_log_map
from hdmap_tools.simulate.pose_errors import disturbed_mount, disturbed_trajectory
from hdmap_tools.simulate.ray_caster import RayCaster
from hdmap_tools.simulate.read_world import read_world
from hdmap_tools.simulate.settings import SimulationSettings
from hdmap_tools.simulate.truth_raster import write_truth_raster
from hdmap_tools.simulate.truth_vectors import truth_vector_map

_log = logging.getLogger(__name__)

COMMAND: Final = "simulate"
_MAX_PENDING: Final = 6
"""Encoded images that may wait for the disk."""


class SimulationProgress(Protocol):
    """What a progress bar needs to be told."""

    def __call__(self, what: str, done: int, total: int) -> None:
        """How many ``tiles`` of the true ground, ``images`` or ``sweeps`` are done."""
        ...


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
        _write_true_map(truth, plan, progress)
        _Recorder(log, truth, plan, progress).record()
    return out


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
    write_log_map(log, plan.log_id, plan.world, plan.route.xy, plan.builder.terrain.height_at)
    write_log.write_poses(truth, plan.city_SE3_ego)
    write_log.write_json(
        truth / "simulation.json",
        truth_files.simulation_document(
            world_path, plan.world, plan.route, settings, plan.cameras, plan.lidar
        ),
    )
    truth_files.write_label_folder_head(truth)


def _write_true_map(truth: Path, plan: DrivePlan, progress: SimulationProgress | None) -> None:
    """Class raster and vector map of what the sensors are going to see."""

    def told(done: int, total: int) -> None:
        if progress is not None:
            progress("tiles", done, total)

    write_truth_raster(truth / "raster", plan.builder, plan.route, progress=told)
    write_gpkg(truth_vector_map(plan.builder, plan.route), truth / Path(TRUE_MAP_FILE).name)


class _Recorder:
    """Drives the route and writes what the sensors see; files are written by threads."""

    def __init__(
        self,
        log: Path,
        truth: Path,
        plan: DrivePlan,
        progress: SimulationProgress | None,
    ) -> None:
        self._log, self._truth, self._plan = log, truth, plan
        self._progress = progress
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
        scene = plan.builder.scene(plan.route, stretch_m, plan.actors)
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
            points = self._given_SE3_ego.transform_from(points.astype(np.float64)).astype(
                np.float32
            )
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
