"""Counts whose tiles lie on disk are those whose tiles are in memory."""

import numpy as np
import pytest

from hdmap_tools.errors import ConfigError
from hdmap_tools.fusion.cell_counts import CellCounts, Tile
from hdmap_tools.fusion.semantic_map import SemanticMap
from hdmap_tools.fusion.tiles_on_disk import TilesOnDisk
from hdmap_tools.memory_budget import MemoryBudget

from .builders import frames_of, meta


def counted(frames, tiles=None):
    counts = CellCounts(meta(), tiles)
    for key, observations in frames:
        counts.add(observations, key)
    return counts


@pytest.mark.parametrize("num_tiles", [0, 1, 2.5, 100])
def test_counts_are_the_same_wherever_tiles_lie(tmp_path, num_tiles):
    frames = frames_of(1, 6)
    expected = counted(frames)
    assert len(expected.tiles) >= 4
    size = sum(a.nbytes for a in next(iter(expected.tiles.values())).layers.values())
    counts = counted(frames, TilesOnDisk(tmp_path, int(num_tiles * size)))
    assert counts.equals(expected)
    assert sorted(counts.tiles) == sorted(expected.tiles)
    assert len(counts.tiles) == len(expected.tiles)
    assert bool(list(tmp_path.iterdir())) == (num_tiles < len(expected.tiles))
    made = SemanticMap.create(tmp_path / "map", meta())
    made.add(counts, "drive")
    assert made.read().equals(expected)


def test_it_is_a_mapping(tmp_path):
    tiles = TilesOnDisk(tmp_path, 0)
    a, b = Tile.zeros(2, 2, (4, 4)), Tile.zeros(2, 2, (4, 4))
    a.layers["counts"][1, 0, 2, 3] = 7
    tiles[0, 0] = a
    tiles[1, 0] = b
    assert (0, 0) in tiles
    assert (5, 5) not in tiles
    assert tiles.get((5, 5)) is None
    assert tiles[0, 0].equals(a)
    tiles[0, 0].layers["height_n"][0, 0] = 9
    assert tiles[1, 0].equals(b)
    assert tiles[0, 0].layers["height_n"][0, 0] == 9
    del tiles[0, 0]
    assert list(tiles) == [(1, 0)]
    for gone in ((0, 0), (5, 5)):
        with pytest.raises(KeyError):
            tiles[gone]
        with pytest.raises(KeyError):
            del tiles[gone]


def test_too_little_memory_is_said_with_how_much_would_do():
    with pytest.raises(ConfigError, match=r"allow at least (\d+) MB") as error:
        MemoryBudget(500 * 10**6).tiles_bytes(meta())
    least = int(str(error.value).split("at least ")[1].split(" ")[0])
    assert MemoryBudget((least + 1) * 10**6).tiles_bytes(meta()) > 0
    with pytest.raises(ConfigError):
        MemoryBudget((least - 20) * 10**6).tiles_bytes(meta())
    assert np.isfinite(MemoryBudget(2 * 10**9).points_bytes)
