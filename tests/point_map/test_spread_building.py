"""Point maps on Dask workers: those of one process, byte for byte, whoever dies on the way."""

import os
import signal
from pathlib import Path

import pytest

pytest.importorskip("distributed", reason="needs the extra `distributed`")

from hdmap_tools.config import Config, PointsConfig
from hdmap_tools.distributed import points
from hdmap_tools.distributed.cluster import Workers, connected
from hdmap_tools.errors import ClusterError, HDMapError
from hdmap_tools.geometry.se3 import Trajectory
from hdmap_tools.point_map.build import build_point_map
from hdmap_tools.point_map.posed_drive import PosedDrive
from hdmap_tools.readers.open_drive import open_drive
from hdmap_tools.testing.drives import write_av2

from .scenes import Scene, drive_through
from .test_building_steps import built, traffic

NAMES = ("one", "two")


@pytest.fixture(scope="module")
def paths(tmp_path_factory) -> list[Path]:
    """Two drives over the same place, on disk."""
    root = tmp_path_factory.mktemp("drives")
    for k, name in enumerate(NAMES):
        made = drive_through(
            Scene(traffic), 12, name=name, rings=16, speed_m_s=30.0, origin=(12.0 * k, float(k))
        )
        sweeps = [made.read_sweep(ref) for ref in made.sweeps]
        write_av2(root / name, trajectory=made.trajectory, sweeps=sweeps)
    return [root / name for name in NAMES]


@pytest.fixture(scope="module")
def drives(paths):
    """The second at poses that stand in no file of it."""
    one, two = (open_drive(path) for path in paths)
    moved = two.trajectory.translations + [0.0123, -0.0077, 0.003]
    refined = Trajectory(two.trajectory.timestamps_ns, two.trajectory.rotations, moved)
    return PosedDrive.as_given(one), PosedDrive(two, refined, is_refined=True)


@pytest.fixture(scope="module")
def client():
    with connected(Workers(2)) as client:
        yield client


@pytest.fixture(scope="module")
def whole(drives, tmp_path_factory):
    return built(tmp_path_factory, drives, PointsConfig())


def spread(client, paths, drives, tmp_path_factory, **settings):
    config = Config(points=PointsConfig(**settings))
    with points.spread_over(client, paths, config) as crew_at:
        return built(tmp_path_factory, drives, config.points, crew_at)


@pytest.mark.parametrize("remove", [True, False])
def test_workers_make_the_same_map(client, paths, drives, whole, tmp_path_factory, remove):
    if not remove:
        whole = built(tmp_path_factory, drives, PointsConfig(remove_moving=False))
    assert spread(client, paths, drives, tmp_path_factory, remove_moving=remove) == whole


@pytest.mark.parametrize(
    "when",
    [
        "sum_returns",
        pytest.param("sum_tile", marks=pytest.mark.slow),
        pytest.param("look_through", marks=pytest.mark.slow),
        "finish_tile",
    ],
)
def test_workers_that_are_killed_change_nothing(
    client, paths, drives, whole, tmp_path_factory, monkeypatch, when
):
    original, killed = points._Spread._each, []
    pids = client.run(os.getpid)

    def killing(self, step, items):
        for made in original(self, step, items):
            if step.__name__ == when and not killed:
                busy = [worker for worker, tasks in client.processing().items() if tasks]
                killed.append(pids[busy[0]])
                os.kill(killed[0], signal.SIGKILL)
            yield made

    monkeypatch.setattr(points._Spread, "_each", killing)
    assert spread(client, paths, drives, tmp_path_factory) == whole
    assert killed
    assert not set(killed) & set(client.run(os.getpid).values())


def test_all_sweeps_of_both_passes_are_told(client, paths, drives, tmp_path):
    told = []
    (tmp_path / "map").mkdir()
    config = Config(points=PointsConfig(normalize_intensity=False))
    with points.spread_over(client, paths, config) as crew_at:
        build_point_map(
            drives,
            tmp_path / "map",
            config.points,
            crew_at=crew_at,
            progress=lambda done, total: told.append((done, total)),
        )
        client.sync(_nothing)
    assert {total for _, total in told} == {48}
    assert [done for done, _ in told] == list(range(1, len(told) + 1))
    assert len(told) >= 44  # the last may still be on their way when the map is there


async def _nothing() -> None:
    """Whatever has arrived before is dealt with."""


def test_an_error_of_a_worker_is_ours_and_leaves_nothing(client, paths, drives, tmp_path):
    sweeps = sorted((paths[0] / "sensors" / "lidar").iterdir())
    kept = sweeps[5].read_bytes()
    sweeps[5].write_bytes(b"damaged")
    try:
        (tmp_path / "map").mkdir()
        config = Config(points=PointsConfig(normalize_intensity=False))
        with (
            pytest.raises(HDMapError, match=sweeps[5].name),
            points.spread_over(client, paths, config) as crew_at,
        ):
            build_point_map(drives, tmp_path / "map", config.points, crew_at=crew_at)
        assert [path.name for path in tmp_path.iterdir()] == ["map"]
    finally:
        sweeps[5].write_bytes(kept)


def test_a_worker_that_finds_another_drive_says_so(client, paths, drives, tmp_path_factory):
    with pytest.raises(ClusterError, match=r"does not find .*/elsewhere.* share"):
        spread(client, [paths[0], paths[1] / "elsewhere"], drives, tmp_path_factory)
    shorter = paths[0].parent / "shorter"
    (shorter / "sensors").mkdir(parents=True, exist_ok=True)
    for path in paths[1].iterdir():
        if not (shorter / path.name).exists():
            (shorter / path.name).symlink_to(path)
    (shorter / "sensors" / "lidar").mkdir(exist_ok=True)
    for path in sorted((paths[1] / "sensors" / "lidar").iterdir())[1:]:
        (shorter / "sensors" / "lidar" / path.name).symlink_to(path)
    with pytest.raises(ClusterError, match=r"11 sweeps .* expected 12"):
        spread(client, [paths[0], shorter], drives, tmp_path_factory)
