"""Streets made of triangles, driven through with a lidar of known noise: truth for refinement."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from hdmap_tools.geometry.map_frame import MapFrame
from hdmap_tools.geometry.se3 import Trajectory
from hdmap_tools.open3d_import import open3d
from hdmap_tools.readers.drive import Drive, Sweep, SweepRef

MOUNT_M = 1.9


class Street:
    """Triangles of a street along x: ground with kerbs, and what stands beside it."""

    def __init__(
        self, length_m: float, *, is_bare: bool = False, seed: int = 0, wave_m: float = 0.15
    ) -> None:
        self._scene = open3d().t.geometry.RaycastingScene()
        rng = np.random.default_rng(seed)
        self._add_ground(length_m, is_bare, wave_m)
        if is_bare:
            return
        for side in (-1, 1):
            x = -15.0
            while x < length_m + 15:
                width = rng.uniform(7, 14)
                front = rng.uniform(9, 12)
                self._box((x, side * front), (x + width, side * (front + 10)), rng.uniform(4, 9))
                x += width + rng.uniform(2, 6)
            for x in np.arange(-10, length_m + 10, 17.0) + rng.uniform(0, 5):
                self._box((x, side * 5.0), (x + 0.15, side * 5.15), 6.0)
            for x in np.arange(-5, length_m, 24.0) + rng.uniform(0, 9):
                self._box((x, side * 3.0), (x + 4.3, side * 4.8), 1.5)

    def _add_ground(self, length_m: float, is_bare: bool, wave_m: float) -> None:
        # Road with crown, kerb 12 cm (a shallow bank between lawns), ground beyond, gentle waves.
        y = np.array([-60, -4.2, -4.1, 0, 4.1, 4.2, 60.0])
        z = np.array([0.3, 0.12, 0, 0.08, 0, 0.12, 0.3])
        if is_bare:
            y = np.array([-60, -6, -4.1, 0, 4.1, 6, 60.0])
        x = np.arange(-80, length_m + 80, 4.0)
        waves = 0.0 if is_bare else wave_m * np.sin(x / 23.0)
        grid = np.stack(
            np.broadcast_arrays(x[:, None], y[None], z[None] + np.c_[waves + 0 * x]), -1
        )
        index = np.arange(grid.shape[0] * grid.shape[1]).reshape(grid.shape[:2])
        a, b = index[:-1, :-1].ravel(), index[1:, :-1].ravel()
        c, d = index[1:, 1:].ravel(), index[:-1, 1:].ravel()
        self._mesh(grid.reshape(-1, 3), np.concatenate([np.c_[a, b, c], np.c_[a, c, d]]))

    def _box(self, low: tuple[float, float], high: tuple[float, float], top: float) -> None:
        xs, ys = sorted((low[0], high[0])), sorted((low[1], high[1]))
        corners = np.array([(x, y, z) for x in xs for y in ys for z in (-1.0, top)])
        faces = [(0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (1, 3, 7, 5)]
        self._mesh(corners, np.array([t for a, b, c, d in faces for t in ((a, b, c), (a, c, d))]))

    def _mesh(self, vertices: np.ndarray, triangles: np.ndarray) -> None:
        o3d = open3d()
        self._scene.add_triangles(
            o3d.core.Tensor(vertices.astype(np.float32)),
            o3d.core.Tensor(triangles.astype(np.uint32)),
        )

    def ranges(self, origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
        """Metres to what each ray (N, 3) hits first, or inf."""
        from_origin = np.broadcast_to(origin, rays.shape)
        tensor = open3d().core.Tensor(np.hstack([from_origin, rays]).astype(np.float32))
        return self._scene.cast_rays(tensor)["t_hit"].numpy().astype(float)


@dataclass(frozen=True)
class Errors:
    """Of given poses: noise that forgets itself after half a second, and a walk."""

    noise_m: float = 0.02
    noise_deg: float = 0.05
    drift_m: float = 0.1


def true_path(
    length_m: float,
    *,
    y_m: float = -1.7,
    speed_mps: float = 8.0,
    is_back: bool = False,
    t0_s: int = 0,
) -> Trajectory:
    """Along the street at 10 Hz, weaving a little, or back on the other side."""
    count = int(length_m / speed_mps * 10)
    times = t0_s * 10**9 + 10**18 + np.arange(count) * 10**8
    x = np.linspace(0, length_m, count)
    y = y_m + 0.3 * np.sin(x / 15.0)
    yaw = np.arctan2(np.gradient(y), np.gradient(x))
    z = 0.15 * np.sin(x / 23.0)
    if is_back:
        x, y, yaw, z = x[::-1], y[::-1] + 2 * -y_m, yaw[::-1] + np.pi, z[::-1]
    turns = Rotation.from_euler("zyx", np.c_[yaw, 0.004 * np.sin(x / 5), 0.003 * np.cos(x / 7)])
    return Trajectory(times, turns.as_matrix(), np.c_[x, y, z])


def with_errors(truth: Trajectory, errors: Errors, seed: int) -> Trajectory:
    """What a positioning system would give."""
    rng = np.random.default_rng(seed)
    count = len(truth)
    memory = np.exp(-0.1 / 0.5)
    noise = rng.standard_normal((count, 6))
    for i in range(1, count):
        noise[i] = memory * noise[i - 1] + np.sqrt(1 - memory**2) * noise[i]
    start = truth.translations[:1]
    steps = np.linalg.norm(np.diff(truth.translations, axis=0, prepend=start), axis=1)
    walk = np.cumsum(rng.standard_normal((count, 3)) * np.sqrt(steps / 100)[:, None], axis=0)
    turns = Rotation.from_rotvec(np.deg2rad(errors.noise_deg) * noise[:, 3:])
    return Trajectory(
        truth.timestamps_ns,
        turns.as_matrix() @ truth.rotations,
        truth.translations + errors.noise_m * noise[:, :3] + errors.drift_m * walk,
    )


def drive_through(
    street: Street,
    truth: Trajectory,
    given: Trajectory,
    *,
    name: str = "street",
    rings: int = 16,
    azimuths: int = 360,
    seed: int = 0,
) -> Drive:
    """A drive whose sweeps are cast when read, from the true poses, with 2 cm range noise."""
    elevation = np.deg2rad(np.linspace(-22, 8, rings))
    azimuth = np.linspace(0, 2 * np.pi, azimuths, endpoint=False)
    e, a = (part.ravel() for part in np.meshgrid(elevation, azimuth, indexing="ij"))
    rays = np.c_[np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)]
    ring = np.repeat(np.arange(rings), azimuths).astype(np.uint8)
    index_of = {int(t): i for i, t in enumerate(truth.timestamps_ns)}

    def read(ref: SweepRef) -> Sweep:
        index = index_of[ref.timestamp_ns]
        rng = np.random.default_rng((seed, index))
        turned = Rotation.from_euler("z", rng.uniform(0, 0.02)).apply(rays)
        pose = truth.pose(index)
        lidar = np.array([0.0, 0.0, MOUNT_M])
        origin = pose.transform_from(lidar[None])[0]
        ranges = street.ranges(origin, turned @ pose.rotation.T)
        kept = (ranges < 70) & (ranges > 1.5) & (rng.random(len(ranges)) > 0.05)
        noisy = ranges[kept] + 0.02 * rng.standard_normal(kept.sum())
        points = lidar + turned[kept] * noisy[:, None]
        grey = np.full(len(points), 40, np.uint8)
        return Sweep(ref.timestamp_ns, points, grey, ring[kept])

    refs = tuple(SweepRef(int(t), Path(f"{t}"), "lidar") for t in truth.timestamps_ns)
    return Drive(
        name=name,
        layout="toy",
        root=Path(name),
        frame=MapFrame(),
        trajectory=given,
        cameras={},
        images=(),
        sweeps=refs,
        read_sweep=read,
    )


def aligned_errors(poses: Trajectory, truth: Trajectory) -> tuple[float, float]:
    """RMS of translation (m) and rotation (deg) after the best rigid alignment of the whole."""
    a, b = poses.translations, truth.translations
    ma, mb = a.mean(0), b.mean(0)
    # A straight path does not say the roll about itself: take the turn from the rotations.
    r = (
        Rotation.from_matrix(truth.rotations @ poses.rotations.transpose(0, 2, 1))
        .mean()
        .as_matrix()
    )
    off = (a - ma) @ r.T - (b - mb)
    turned = Rotation.from_matrix(truth.rotations.transpose(0, 2, 1) @ r @ poses.rotations)
    return (
        float(np.sqrt((off**2).sum(1).mean())),
        float(np.rad2deg(np.sqrt((turned.magnitude() ** 2).mean()))),
    )


def mutual_error_m(
    first: Trajectory, second: Trajectory, true_first: Trajectory, true_second: Trajectory
) -> float:
    """RMS of how differently two drives are off where they come nearest to each other."""
    apart = np.linalg.norm(
        true_first.translations[:, None] - true_second.translations[None], axis=2
    )
    off = first.translations - true_first.translations
    other = (second.translations - true_second.translations)[apart.argmin(axis=1)]
    return float(np.sqrt(((off - other) ** 2).sum(axis=1).mean()))
