"""A map vectorized by several processes: the same file, whoever dies on the way."""

import signal

import numpy as np
import pytest

from hdmap_tools.formats.gpkg import read_gpkg
from hdmap_tools.fusion.cell_counts import TILE_CELLS, CellCounts, Tile
from hdmap_tools.fusion.map_meta import MapMeta
from hdmap_tools.fusion.semantic_map import SemanticMap
from hdmap_tools.labels.label_set import load_label_set
from hdmap_tools.testing.fake_plugins import FakePlugins
from hdmap_tools.windowed import vectorize_map as windowed

pytest.importorskip("distributed", reason="needs the extra `distributed`")
psutil = pytest.importorskip("psutil")

ADAS = load_label_set("adas-0001")
WINDOWS = 4


@pytest.fixture
def street_map(tmp_path, monkeypatch):
    """A street of 205 m in four windows: road with kerbs, a solid and a dashed line."""
    monkeypatch.chdir(tmp_path)
    # So that a map quick to vectorize has several windows, here and in the processes.
    monkeypatch.setattr(windowed, "windows_of", _in_windows(windowed.windows_of))
    meta = MapMeta(
        resolution_m=0.2,
        label_set=ADAS,
        count_mode="share",
        intensity_threshold=40,
        model="road-segmentation-adas-0001",
    )
    names = {name: k for k, name in enumerate(ADAS.names)}
    counts = CellCounts(meta)
    counts.num_frames = 1
    y = (np.arange(TILE_CELLS) + 0.5) * 0.2
    for k in range(WINDOWS):
        x = (np.arange(TILE_CELLS) + 0.5 + k * TILE_CELLS) * 0.2
        labels = np.full((TILE_CELLS, TILE_CELLS), names["background"])
        labels[(y > 10) & (y < 22)] = names["road"]
        labels[np.abs(y - 13) < 0.15] = names["mark"]
        labels[np.ix_(np.abs(y - 16) < 0.15, x % 9 < 3)] = names["mark"]
        tile = Tile.zeros(len(ADAS), meta.num_bins)
        rows, cols = np.indices(labels.shape)
        tile.layers["counts"][labels, 0, rows, cols] = 5 * meta.quanta_per_vote
        tile.layers["height_n"][:] = 5
        counts.tiles[k, 0] = tile
    SemanticMap.create(tmp_path / "map", meta).add(counts, "drive")
    return tmp_path


def _in_windows(original):
    def windows_of(*arguments, **settings):
        return original(*arguments, **settings, whole_up_to=0.0)

    return windows_of


VECTORIZE = ("vectorize", "map", "--window", "51.2")


@pytest.fixture
def alone(street_map, hdmap):
    """The file of one process, and what it said."""
    code, out, err = hdmap(*VECTORIZE, "-o", "alone.gpkg")
    assert code == 0, err
    return (street_map / "alone.gpkg").read_bytes(), out.partition(" in ")[0]


def test_windows_are_made_and_their_lines_are_whole(street_map, alone):
    made = read_gpkg(street_map / "alone.gpkg")
    assert made.provenance["windows"] == {"number": WINDOWS, "window_m": 51.2}
    lengths = sorted(mark.geometry.length for mark in made if mark.element_type == "lane_mark")
    assert lengths == pytest.approx([201.0, 204.8], abs=1.5)
    kerbs = [e.geometry.length for e in made if e.element_type == "road_boundary"]
    assert kerbs == pytest.approx([204.6, 204.6], abs=0.5)


def test_workers_make_the_same_file(street_map, hdmap, alone):
    code, out, err = hdmap(*VECTORIZE, "-o", "spread.gpkg", "--workers", "2")
    assert code == 0, err
    assert out.partition(" in ")[0] == alone[1]
    assert (street_map / "spread.gpkg").read_bytes() == alone[0]


def test_one_that_needs_the_whole_map_gets_it_and_the_finished_lines(
    street_map, hdmap, tmp_path, monkeypatch
):
    fakes = FakePlugins(tmp_path / "plugins")
    fakes.folder.mkdir()
    monkeypatch.syspath_prepend(str(fakes.folder))
    monkeypatch.setattr("importlib.metadata.entry_points", fakes.entry_points)
    line = "LaneMark(geometry=LineString([(x0 + 1, 16, 0), (x1 - 1, 16, 0)]))"
    fakes.add(
        "some-dist",
        {
            "lines": f"def vectorize(self, window, upstream, options, *, rng):\n"
            f"    x0, y0, x1, y1 = window.grid.bounds_m\n    return [{line}]\n",
            "whole": "scope = 'map'\nrequires = ('lines',)\n"
            "def vectorize(self, window, upstream, options, *, rng):\n"
            "    x0, y0, x1, y1 = window.grid.bounds_m\n"
            "    (line,) = upstream\n"
            "    assert x1 - x0 > 204 and line.id and line.geometry.length > 200\n"
            "    return [LaneMark(geometry=line.geometry, id='mine', width_m=1.0)]\n",
        },
    )
    code, _, err = hdmap(*VECTORIZE, "-o", "f.gpkg")
    assert code == 0, err
    made = read_gpkg(street_map / "f.gpkg")
    assert {element.plugin for element in made} == {"lines", "whole"}
    assert "mine" in {element.id for element in made}
    assert len(made.provenance["plugins"]) == 2


@pytest.mark.parametrize("side", ["0", "-5", "nan", "inf"])
def test_a_window_without_a_size(street_map, fails, side):
    fails("vectorize", "map", "-o", "f.gpkg", "--window", side, says=("window_m",))


def test_an_empty_map_gives_an_empty_file(street_map, hdmap):
    meta = SemanticMap.open(street_map / "map").meta
    SemanticMap.create(street_map / "empty", meta)
    code, out, err = hdmap("vectorize", "empty", "-o", "f.gpkg")
    assert code == 0, err
    assert "No elements" in out


@pytest.mark.slow
def test_a_window_of_a_worker_that_dies_is_done_again(street_map, hdmap, alone, monkeypatch):
    killed = []

    def killing(done, total):
        if not killed:
            workers = psutil.Process().children(recursive=True)
            worker = max(workers, key=lambda process: process.memory_info().rss)
            killed.append(worker.pid)
            worker.send_signal(signal.SIGKILL)

    original = windowed.vectorize_map

    def told(*arguments, **more):
        return original(*arguments, **(more | {"told": killing}))

    monkeypatch.setattr("hdmap_tools.single_steps.vectorize_map", told)
    code, _, err = hdmap(*VECTORIZE, "-o", "spread.gpkg", "--workers", "1")
    assert code == 0, err
    assert killed
    assert (street_map / "spread.gpkg").read_bytes() == alone[0]


@pytest.mark.slow
def test_a_worker_without_enough_memory(street_map, fails):
    fails(
        *VECTORIZE, "-o", "f.gpkg", "--workers", 1, "--worker-memory", "170MB",
        says=("Workers died again and again", "memory", "Nothing was written"),
    )  # fmt: skip
    assert not (street_map / "f.gpkg").exists()
