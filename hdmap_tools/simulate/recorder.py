"""Drives a planned route and writes what the sensors see, all cores at work.

The route is cut into stretches, and the scene of one is built, seen by all sensors and
dropped, so that memory does not grow with the drive. A scene follows from the seed and the
place alone, so that neighbouring stretches show the same world.

    one thread builds:   scene 1 │ true map │ scene 2    │ scene 3 …
    some threads record:         │ images and sweeps of 1 │ of 2 …

Each image and each sweep is a task of its own, from its rays to its file: what one thread
does alone (numpy, encoding, the disk) meets what fills all cores (rays) of another. No file
depends on the order in which that happens.
"""

from __future__ import annotations

import logging
import os
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from pathlib import Path
from threading import Event
from typing import Final, Protocol

import numpy as np

from hdmap_tools.geometry.se3 import SE3
from hdmap_tools.simulate import truth_files, write_log
from hdmap_tools.simulate.camera_image import prepare_textures, render_image
from hdmap_tools.simulate.drive_plan import DrivePlan, Shot
from hdmap_tools.simulate.lidar_sweep import scan_sweep
from hdmap_tools.simulate.light import CameraLook
from hdmap_tools.simulate.pose_errors import disturbed_mount
from hdmap_tools.simulate.ray_caster import RayCaster

_log = logging.getLogger(__name__)

_MOST_AT_ONCE: Final = 4
"""Images and sweeps in the making; an image takes 60 MB."""


class SimulationProgress(Protocol):
    """What a progress bar needs to be told; from one thread at a time, not always the same."""

    def __call__(self, what: str, done: int, total: int) -> None:
        """How many ``tiles`` of the true ground, ``images`` or ``sweeps`` are done."""
        ...


class Recorder:
    """Drives the route and writes what the sensors see.

    Args:
        log: Folder of the log.
        truth: Folder of its truth.
        plan: The drive.
        write_true_map: Told how to report tiles done and their number. It runs in the thread
            that builds the scenes: what they share is made and kept by one thread only. None
            writes none.
        progress: Told about tiles, images and sweeps.
    """

    def __init__(
        self,
        log: Path,
        truth: Path,
        plan: DrivePlan,
        write_true_map: Callable[[Callable[[int, int], None]], None] | None,
        progress: SimulationProgress | None,
    ) -> None:
        self._log, self._truth, self._plan = log, truth, plan
        self._write_true_map = write_true_map
        self._progress = progress
        num_sweeps = sum(shot.camera is None for shot in plan.shots)
        self._total = {"images": len(plan.shots) - num_sweeps, "sweeps": num_sweeps}
        self._done = dict.fromkeys(self._total, 0)
        self._tiles = (0, 0)
        self._look = CameraLook(plan.settings.weather, plan.settings.difficulty, plan.settings.seed)
        self._given_SE3_ego = _given_SE3_ego(plan)
        self._stopped = Event()

    def record(self) -> None:
        """Write all images, sweeps and their truth, and the true map.

        Raises:
            OSError: If something cannot be written; what was begun is left unfinished.
        """
        stretches = self._plan.stretches()
        workers = min((os.cpu_count() or 1) + 1, _MOST_AT_ONCE)
        with (
            ThreadPoolExecutor(1, thread_name_prefix="build") as builder,
            ThreadPoolExecutor(workers, thread_name_prefix="record") as recorders,
        ):
            try:
                scene = builder.submit(self._build, *stretches[0])
                if self._write_true_map is None:
                    true_map: Future[None] = Future()
                    true_map.set_result(None)
                else:
                    true_map = builder.submit(self._write_true_map, self._tiles_done)
                for k, (_, shots) in enumerate(stretches):
                    caster = scene.result()
                    if true_map.done():
                        true_map.result()  # not only at the end of a long drive
                    if k + 1 < len(stretches):
                        scene = builder.submit(self._build, *stretches[k + 1])
                    self._record_stretch(recorders, workers, caster, shots)
                    del caster
                true_map.result()
                self._tell()
            except BaseException:
                self._stopped.set()
                for pool in (recorders, builder):
                    pool.shutdown(wait=True, cancel_futures=True)
                raise

    def _build(self, stretch_m: tuple[float, float], shots: Sequence[Shot]) -> RayCaster:
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
        prepare_textures(caster)
        return caster

    def _record_stretch(
        self, pool: ThreadPoolExecutor, at_once: int, caster: RayCaster, shots: Sequence[Shot]
    ) -> None:
        pending: deque[tuple[str, Future[None]]] = deque()

        def finish_first() -> None:
            what, future = pending.popleft()
            future.result()
            self._done[what] += 1
            self._tell()

        for shot in shots:
            while len(pending) > at_once:
                finish_first()
            if shot.camera is None:
                pending.append(("sweeps", pool.submit(self._take_sweep, caster, shot)))
            else:
                task = pool.submit(self._take_image, caster, shot, shot.camera)
                pending.append(("images", task))
        while pending:
            finish_first()

    def _take_image(self, caster: RayCaster, shot: Shot, index: int) -> None:
        plan, camera, time_ns = self._plan, self._plan.cameras[index], shot.timestamp_ns
        image = render_image(
            caster,
            camera,
            plan.city_SE3_ego.interpolate(time_ns),
            plan.seconds(time_ns),
            self._look,
            _seed_of(plan.settings.seed, 1 + index, shot.number),
        )
        write_log.write_jpeg(write_log.image_path(self._log, camera.name, time_ns), image.rgb)
        truth_files.write_true_labels(self._truth, camera.name, time_ns, image.labels)

    def _take_sweep(self, caster: RayCaster, shot: Shot) -> None:
        plan = self._plan
        assert plan.lidar is not None  # who has no lidar has no sweeps to take
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
        if self._given_SE3_ego is not None:
            points = self._given_SE3_ego.transform_from(points.astype(np.float64)).astype(
                np.float32
            )
        write_log.write_sweep(
            self._log,
            shot.timestamp_ns,
            points,
            sweep.intensity,
            sweep.laser_number,
            sweep.offset_ns,
        )

    def _tiles_done(self, done: int, total: int) -> None:
        """Of the true map; called in the building thread, told by the recording one."""
        if self._stopped.is_set():
            raise CancelledError
        self._tiles = (done, total)

    def _tell(self) -> None:
        if self._progress is None:
            return
        if self._tiles[1]:
            self._progress("tiles", *self._tiles)
        for what, done in self._done.items():
            self._progress(what, done, self._total[what])


def _given_SE3_ego(plan: DrivePlan) -> SE3 | None:
    """From true points in the ego frame to those that a given, wrong mount makes of them.

    None where the mount that is given is the true one.
    """
    if plan.lidar is None:
        return None
    mount = plan.lidar.ego_SE3_lidar
    error = disturbed_mount(
        mount,
        plan.lidar.name,
        plan.settings.calibration_error_m,
        plan.settings.calibration_error_deg,
        plan.settings.seed,
    )
    return error @ mount.inverse() if error is not mount else None


def _seed_of(seed: int, sensor: int, number: int) -> int:
    """A seed of its own for each shot of each sensor."""
    state = np.random.SeedSequence([seed, sensor, number]).generate_state(2, np.uint32)
    return int(state[0]) | int(state[1] & 0x7FFFFFFF) << 32
