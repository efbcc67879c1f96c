"""Nothing but vehicles stands where vehicles drive, on whole maps."""

from pathlib import Path

import numpy as np
import pytest
import shapely

from hdmap_tools.simulate.build_scene import SceneBuilder
from hdmap_tools.simulate.materials import Mat
from hdmap_tools.simulate.read_world import read_world, shipped_world
from hdmap_tools.simulate.settings import SimulationSettings
from hdmap_tools.simulate.surface import TILE_M

HEADROOM_M = 2.2
"""Lower than this nothing may hang over the road; crowns of trees and arms of lamps do above."""


def lowest_m(corners: np.ndarray, part: shapely.Geometry) -> float:
    """How low a triangle (3, 3) reaches over a part of the ground under it."""
    (_, _, nz) = normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    if abs(nz) < 1e-3 * np.linalg.norm(normal):  # upright: anywhere above its outline
        return float(corners[:, 2].min())
    xy = shapely.get_coordinates(part) - corners[0, :2]
    return float((corners[0, 2] - (xy @ normal[:2]) / nz).min())


def assert_road_is_free(path: Path, seed: int, most_tiles: int) -> None:
    """Ask all objects of tiles along the roads of a map, and the road of its lanes themselves."""
    builder = SceneBuilder(read_world(path), SimulationSettings(seed=seed))
    lanes = [lane for lane in builder.world.lanes.values() if lane.kind == "road"]
    areas = [shapely.Polygon(np.concatenate([lane.left, lane.right[::-1]])) for lane in lanes]
    # Where bounds of unequal length run together, a lane ends in a sliver that nobody drives on.
    road = shapely.union_all(shapely.make_valid(np.array(areas))).buffer(-0.5).buffer(0.48)
    west, south, east, north = (int(np.floor(b / TILE_M)) for b in road.bounds)
    all_tiles = [(x, y) for x in range(west, east + 1) for y in range(south, north + 1)]
    tiles = [
        (x, y)
        for x, y in all_tiles
        if road.distance(shapely.box(x * TILE_M, y * TILE_M, (x + 1) * TILE_M, (y + 1) * TILE_M))
        < 5.0
    ]
    step = max(1, len(tiles) // most_tiles)
    shapely.prepare(road)
    seen: set[int] = set()
    for tile in tiles[::step]:
        mesh = builder.objects.mesh(*tile)
        corner = np.array([tile[0] * TILE_M, tile[1] * TILE_M])
        xyz = mesh.vertices[mesh.triangles].astype(np.float64)
        xyz[..., :2] += corner
        if len(xyz) == 0:
            continue
        ground = builder.terrain.height_at(xyz[:, 0, :2])
        low = np.nonzero(xyz[..., 2].min(axis=1) - ground < HEADROOM_M)[0]
        # A triangle seen from above; upright ones are lines.
        shown = shapely.convex_hull(shapely.multipoints(xyz[low][..., :2]))
        on_road = shapely.intersects(road, shown)
        blocking = [
            f"{Mat(mesh.materials[j]).name} at {xyz[j, 0]}"
            for j, part in zip(
                low[on_road], shapely.intersection(road, shown[on_road]), strict=True
            )
            if lowest_m(xyz[j], part) - ground[j] < HEADROOM_M
        ]
        assert not blocking, f"tile {tile}: {blocking}"
        seen |= set(mesh.materials[low].tolist())
    assert {Mat.TRUNK, Mat.POLE, Mat.HEDGE} <= seen


@pytest.mark.parametrize("seed", [0, 1])
def test_nothing_stands_on_the_roads_of_the_shipped_town(seed: int) -> None:
    assert_road_is_free(shipped_world(), seed, 60)


@pytest.mark.realdata
@pytest.mark.parametrize("seed", [0, 4])
def test_nothing_stands_on_the_roads_of_a_real_map(data_root: Path, seed: int) -> None:
    assert_road_is_free(data_root / "lanelet2" / "mapping_example.osm", seed, 10_000)
