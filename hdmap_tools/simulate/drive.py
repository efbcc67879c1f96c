"""A whole simulated drive: world in, Argoverse 2 sensor log and truth out.

A route through the world gives true poses; along it `recorder` builds scenes and writes what
the sensors see; errors on the poses give those that are handed out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Final

from hdmap_tools.formats.gpkg import write_gpkg
from hdmap_tools.geometry.se3 import SE3
from hdmap_tools.output_folder import is_result_of, require_free, result_folder
from hdmap_tools.readers.av2 import TRUE_MAP_FILE
from hdmap_tools.simulate import truth_files, write_log
from hdmap_tools.simulate.drive_plan import DrivePlan, plan_drive
from hdmap_tools.simulate.log_map import write_log_map
from hdmap_tools.simulate.pose_errors import disturbed_mount, disturbed_trajectory
from hdmap_tools.simulate.read_world import read_world
from hdmap_tools.simulate.recorder import Recorder, SimulationProgress
from hdmap_tools.simulate.settings import SimulationSettings
from hdmap_tools.simulate.truth_raster import write_truth_raster
from hdmap_tools.simulate.truth_vectors import truth_vector_map

__all__ = ["COMMAND", "SimulationProgress", "simulate_drive"]

COMMAND: Final = "simulate"


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
        Recorder(
            log,
            truth,
            plan,
            (lambda told: _write_true_map(truth, plan, told)) if settings.true_map else None,
            progress,
        ).record()
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
        given(plan.lidar.ego_SE3_lidar, plan.lidar.name) if plan.lidar is not None else None,
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


def _write_true_map(truth: Path, plan: DrivePlan, told: Callable[[int, int], None]) -> None:
    """Class raster and vector map of what the sensors see."""
    write_truth_raster(truth / "raster", plan.builder, plan.route, progress=told)
    write_gpkg(truth_vector_map(plan.builder, plan.route), truth / Path(TRUE_MAP_FILE).name)
