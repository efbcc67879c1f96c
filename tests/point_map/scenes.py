"""Streets with several boxes, some of which move, swept by a lidar that drives."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hdmap_tools.geometry.map_frame import MapFrame
from hdmap_tools.geometry.se3 import SE3, Trajectory
from hdmap_tools.readers.drive import Drive, Sweep, SweepRef

START_NS = 1_700_000_000_000_000_000
STEP_NS = 100_000_000
LIDAR_EGO = np.array([0.9, 0.0, 1.9])

Box = tuple[float, float, float, float, float]
"""(x0, y0, x1, y1, top), standing on the ground, city metres."""


@dataclass(frozen=True)
class Scene:
    """Level or sloping ground with boxes given for each time, seconds.

    Attributes:
        boxes: What stands there at a time.
        slope: Ground rises so much a metre along x.
        intensity: Raw intensity of ground by (ring, range, y); 20 if None.
    """

    boxes: Callable[[float], Sequence[Box]] = lambda t: ()
    slope: float = 0.0
    intensity: Callable[..., np.ndarray] | None = None

    def height(self, x):
        return self.slope * np.asarray(x)

    def sweep(self, pose: SE3, time_s: float, rings: int, noise_m: float, rng) -> Sweep:
        elevation = np.deg2rad(np.linspace(-25.0, 8.0, rings))
        azimuth = np.deg2rad(np.arange(0.0, 360.0, 0.4))
        e, a = (g.ravel() for g in np.meshgrid(elevation, azimuth, indexing="ij"))
        rays_ego = np.column_stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
        rays = rays_ego @ pose.rotation.T
        eye = pose.transform_from(LIDAR_EGO[None])[0]
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (self.slope * eye[0] - eye[2]) / (rays[:, 2] - self.slope * rays[:, 0])
            t = np.where(t > 0, t, np.inf)
            for x0, y0, x1, y1, top in self.boxes(time_s):
                low, high = np.array([x0, y0, -50.0]), np.array([x1, y1, top])
                one, two = (low - eye) / rays, (high - eye) / rays
                near, far = np.minimum(one, two).max(axis=1), np.maximum(one, two).min(axis=1)
                t = np.minimum(t, np.where((near <= far) & (near > 0), near, np.inf))
        hit = t < 90.0
        ring = np.repeat(np.arange(rings), len(azimuth))[hit]
        points = eye_ego_points(t[hit] + rng.normal(0.0, noise_m, hit.sum()), rays_ego[hit])
        raw = np.full(hit.sum(), 20.0)
        if self.intensity is not None:
            city = pose.transform_from(points)
            raw = self.intensity(ring, t[hit], city[:, 1])
        raw = np.clip(np.rint(raw), 0, 255).astype(np.uint8)
        return Sweep(0, points, raw, ring.astype(np.uint8))


def eye_ego_points(t, rays_ego):
    return LIDAR_EGO + t[:, None] * rays_ego


def drive_through(
    scene: Scene,
    num_sweeps: int = 60,
    *,
    speed_m_s: float = 8.0,
    rings: int = 32,
    noise_m: float = 0.01,
    name: str = "made",
    origin: tuple[float, float] = (0.0, 0.0),
) -> Drive:
    """A drive along x with a sweep every 0.1 s, kept in memory."""
    rng = np.random.default_rng(3)
    sweeps, poses = {}, []
    for k in range(num_sweeps):
        x = origin[0] + speed_m_s * 0.1 * k
        pitch = np.arctan(scene.slope)
        rotation = np.array(
            [
                [np.cos(pitch), 0.0, -np.sin(pitch)],
                [0.0, 1.0, 0.0],
                [np.sin(pitch), 0.0, np.cos(pitch)],
            ]
        )
        pose = SE3(rotation, np.array([x, origin[1], scene.slope * x]))
        made = scene.sweep(pose, 0.1 * k, rings, noise_m, rng)
        time = START_NS + k * STEP_NS
        sweeps[time] = Sweep(time, made.points_ego, made.intensity, made.ring)
        poses.append(pose)
    trajectory = Trajectory(
        np.array(sorted(sweeps)),
        np.array([pose.rotation for pose in poses]),
        np.array([pose.translation for pose in poses]),
    )
    return Drive(
        name=name,
        layout="made",
        root=Path("made"),
        frame=MapFrame(),
        trajectory=trajectory,
        cameras={},
        images=(),
        sweeps=tuple(SweepRef(time, Path("made"), "lidar") for time in sorted(sweeps)),
        read_sweep=lambda ref: sweeps[ref.timestamp_ns],
    )
