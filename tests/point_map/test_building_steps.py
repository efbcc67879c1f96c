"""The same point map, byte for byte, into whatever runs sweeps are cut and whoever dies on the way."""

from contextlib import suppress
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from hdmap_tools.config import PointsConfig
from hdmap_tools.errors import PointMapError
from hdmap_tools.geometry.se3 import SE3, Trajectory
from hdmap_tools.point_map.build import build_point_map
from hdmap_tools.point_map.building_steps import Alone, Run, Site
from hdmap_tools.point_map.moving import Blocks, is_moving
from hdmap_tools.point_map.posed_drive import PosedDrive
from hdmap_tools.point_map.thinning import VoxelGrid, Voxels, VoxelTiles, read_voxels, write_voxels

from .scenes import Scene, drive_through


def traffic(t):
    return (
        (14.0, 2.5, 18.5, 4.3, 1.5),
        (8 + 12 * t, -0.9, 12.5 + 12 * t, 0.9, 1.5),
        (-20.0, 9.0, 70.0, 9.3, 4.0),
    )


@pytest.fixture(scope="module")
def drives():
    """Two over the same place, fast enough to leave tiles behind; one at poses of its own."""
    rays = {"rings": 16, "speed_m_s": 40.0}
    one = drive_through(Scene(traffic), 11, name="one", **rays)
    two = drive_through(Scene(traffic), 7, name="two", origin=(12.0, 1.0), **rays)
    shift = SE3.from_yaw(1e-3, (0.0123, -0.0077, 0.003))
    poses = [shift @ two.trajectory.pose(k) for k in range(len(two.trajectory))]
    refined = Trajectory(
        two.trajectory.timestamps_ns,
        np.array([pose.rotation for pose in poses]),
        np.array([pose.translation for pose in poses]),
    )
    return PosedDrive.as_given(one), PosedDrive(two, refined, is_refined=True)


def content(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


def built(tmp_path_factory, drives, config, crew_at=Alone) -> dict[str, bytes]:
    parent = tmp_path_factory.mktemp("points")
    (parent / "map").mkdir()
    build_point_map(drives, parent / "map", config, crew_at=crew_at)
    assert [path.name for path in parent.iterdir()] == ["map"]
    return content(parent / "map")


@pytest.fixture(scope="module")
def whole(drives, tmp_path_factory):
    """Made in one run a drive, by whether what moved is removed."""
    return {
        remove: built(tmp_path_factory, drives, PointsConfig(remove_moving=remove))
        for remove in (False, True)
    }


class Died(BaseException):
    """As a process that is killed: nothing catches it."""


class Unsteady:
    """Does steps in any order, in runs of any length, many of them twice, some half and then again."""

    def __init__(self, site: Site, rng: np.random.Generator) -> None:
        self.rng, self.left = rng, -1
        self.site = replace(site, threads=0, told=self.told)

    def told(self):
        self.left -= 1
        if self.left == 0:
            raise Died

    def runs(self, drive, number):
        cuts = np.flatnonzero(self.rng.random(number - 1) < self.rng.random()) + 1
        edges = [0, *cuts.tolist(), number]
        return [Run(drive, range(a, b)) for a, b in pairwise(edges)]

    def over_runs(self, step, items):
        items = list(items)
        for k in self.rng.permutation(len(items)):
            for _ in range(int(self.rng.integers(3))):
                self.left = int(self.rng.integers(1, 4))
                with suppress(Died):
                    step(self.site, *items[k])
            self.left = -1
            yield step(self.site, *items[k])

    over_tiles = over_runs


@settings(max_examples=6, deadline=None, phases=(Phase.generate,))
@given(seed=st.integers(0, 2**32 - 1), remove=st.booleans())
def test_who_does_what_and_when_changes_no_byte(drives, whole, tmp_path_factory, seed, remove):
    def crew_at(site):
        return Unsteady(site, np.random.default_rng(seed))

    config = PointsConfig(remove_moving=remove)
    assert built(tmp_path_factory, drives, config, crew_at) == whole[remove]


def test_removing_what_moved_made_a_difference(whole):
    """Else the tests above would say nothing of the second pass."""
    assert whole[True] != whole[False]
    assert whole[True].keys() == whole[False].keys()


def test_what_fails_leaves_nothing_aside(drives, tmp_path):
    class Failing(Alone):
        def over_tiles(self, step, items):
            raise PointMapError("as a worker says it")

    (tmp_path / "map").mkdir()
    with pytest.raises(PointMapError, match="as a worker"):
        build_point_map(drives, tmp_path / "map", PointsConfig(), crew_at=Failing)
    assert [path.name for path in tmp_path.iterdir()] == ["map"]


@pytest.mark.parametrize("voxel_mm", [50, 1000])
def test_sums_are_right_however_long_a_vehicle_stands(voxel_mm, tmp_path):
    """More returns of one voxel than 32 bits hold the sums of."""
    grid = VoxelGrid(voxel_mm, 1000)
    number = grid.most_hits // 2 + 7
    point = np.array([[(voxel_mm - 1) / 1000.0, 0.0, 0.0]])
    tiles = VoxelTiles(grid, tmp_path)
    for _ in range(6):
        tiles.add(
            np.repeat(point, number, axis=0),
            np.full(number, 255, np.uint8),
            np.ones(number, bool),
            np.zeros(number),
        )
    ((index, files),) = tiles.finish().items()
    assert index == (0, 0)
    assert len(files) > 1
    total = 6 * number
    wanted = [64 * total, 64 * (voxel_mm - 1) * total, 0, 0, 64 * 255 * total, total, total]
    assert max(wanted) > 2**31
    voxels = read_voxels(files)
    np.testing.assert_array_equal(voxels.sums, [wanted])
    write_voxels(tmp_path / "again.npy", voxels)
    np.testing.assert_array_equal(read_voxels([tmp_path / "again.npy"]).sums, [wanted])


def test_sweeps_are_counted_no_higher_by_two_than_by_one(tmp_path):
    """Counts of blocks end at 65535, and so must their sum."""
    one = Voxels(np.array([1 << 23]), np.array([[64, 0, 0, 0, 0, 1, 0]]))
    blocks = Blocks.of(one, VoxelGrid(50, 200))
    np.save(tmp_path / "a.npy", np.array([[65535], [40000]], np.uint16))
    np.save(tmp_path / "b.npy", np.array([[65535], [0]], np.uint16))
    files = [tmp_path / "a.npy", tmp_path / "b.npy"]
    np.testing.assert_array_equal(is_moving(one, blocks, files[:1]), [True])
    np.testing.assert_array_equal(is_moving(one, blocks, files), [True])
    np.testing.assert_array_equal(is_moving(one, blocks, []), [False])
