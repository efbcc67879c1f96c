import json
from pathlib import Path

import numpy as np
import pytest
import shapely

from hdmap_tools.compare.paper import true_classes
from hdmap_tools.compare.truth_reference import (
    reference_from_truth_raster,
    references_from_truth_raster,
    true_shares,
)
from hdmap_tools.errors import CRSMismatchError, FormatError, MapMismatchError
from hdmap_tools.geometry.grid import BevGrid
from hdmap_tools.geometry.map_frame import MapFrame
from hdmap_tools.labels.label_set import DRIVABLE_CLASSES, MAP_CLASSES, MapClass, load_label_set
from hdmap_tools.map_model.elements import (
    BoundaryKind,
    Crosswalk,
    LaneMark,
    MarkStyle,
    RoadBoundary,
    StopLine,
)
from hdmap_tools.simulate.build_scene import SceneBuilder
from hdmap_tools.simulate.materials import MATERIALS, Mat
from hdmap_tools.simulate.route import Route
from hdmap_tools.simulate.settings import SimulationSettings
from hdmap_tools.simulate.truth_kernels import count_into
from hdmap_tools.simulate.truth_raster import TruthRaster, write_truth_raster
from hdmap_tools.simulate.truth_vectors import truth_vector_map
from tests.simulate.small_worlds import LANE_M, bend, curved_street, street_route

LABELS = load_label_set("paz2020")


def short_route() -> Route:
    route = street_route()
    return Route(route.xy[120:200], route.step_m, route.lane_ids)


@pytest.fixture(scope="module")
def builder() -> SceneBuilder:
    return SceneBuilder(curved_street(), SimulationSettings(seed=3))


@pytest.fixture(scope="module")
def folder(builder: SceneBuilder, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("truth") / "raster"
    write_truth_raster(path, builder, short_route(), 25.0)
    return path


@pytest.fixture
def truth(folder: Path) -> TruthRaster:
    return TruthRaster.open(folder)


def label(name: str) -> int:
    return LABELS.id_of(name)


def test_labels_are_those_of_the_surface(truth: TruthRaster, builder: SceneBuilder) -> None:
    rng = np.random.default_rng(0)
    xy = bend(rng.uniform(75, 105, 20_000), rng.uniform(-15, 15, 20_000))
    found = truth.labels_at(xy)
    surface = builder.scene(short_route(), (0.0, 10.0)).surface
    rows, cols = surface.grid.rows_cols_of(xy).T
    expected = [LABELS.id_of(MATERIALS[Mat(c)].label) for c in surface.codes[rows, cols]]
    np.testing.assert_array_equal(found, expected)
    assert len(set(expected)) >= 5


def test_outside_nothing_is_known(truth: TruthRaster) -> None:
    far = np.array([[0.0, 0.0], [-1e6, 3.0]])
    assert (truth.labels_at(far) == 255).all()
    assert np.isnan(truth.height_at(far)).all()
    assert len(truth.labels_at(np.zeros((0, 2)))) == 0


def test_height_is_the_terrain_and_kerbs_are_raised(truth: TruthRaster, builder) -> None:
    s = np.random.default_rng(1).uniform(75, 98, 2000)
    for left, raise_m in ((-1.0, 0.0), (3.4, 0.0), (-LANE_M - 0.2, 0.12), (LANE_M + 0.2, 0.03)):
        xy = bend(s, left)
        expected = builder.terrain.height_at(xy) + raise_m
        np.testing.assert_allclose(truth.height_at(xy), expected, atol=0.002)


@pytest.mark.parametrize("resolution_m", [0.02, 0.1, 0.2, 0.3])
def test_class_fractions_count_cells_exactly(truth: TruthRaster, resolution_m: float) -> None:
    middle = bend(np.array([101.0]), -2.0)[0]
    grid = BevGrid.from_bounds((*(middle - 4.1), *(middle + 3.7)), resolution_m)
    share = truth.class_fractions(grid)
    assert share.shape == (len(MAP_CLASSES), *grid.shape)
    n = round(resolution_m / 0.02)
    fine = (np.arange(n) + 0.5) * 0.02
    rng = np.random.default_rng(0)
    for row, col in rng.integers(0, grid.shape, (60, 2)):
        x, y = (np.array([grid.x_min + col, grid.y_min + row]) * resolution_m)[:, None] + fine
        points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        found = truth.labels_at(points)
        for k, map_class in enumerate(MAP_CLASSES):
            expected = np.isin(found, LABELS.ids_of_class(map_class)).mean()
            assert share[k, row, col] == pytest.approx(expected, abs=1e-6)
    assert share[MAP_CLASSES.index(MapClass.CROSSWALK)].sum() * resolution_m**2 > 5.0


def test_fractions_do_not_depend_on_the_grid_s_bounds(truth: TruthRaster) -> None:
    x, y = np.floor(bend(np.array([90.0]), 0.0)[0]).astype(int) * 5
    large = BevGrid(0.2, x - 200, y - 200, x + 200, y + 200)
    small = BevGrid(0.2, x - 33, y - 17, x + 41, y + 90)
    whole = truth.class_fractions(large, [MapClass.ROAD, MapClass.LANE_MARK])
    part = truth.class_fractions(small, [MapClass.ROAD, MapClass.LANE_MARK])
    np.testing.assert_array_equal(part, whole[:, 183:290, 167:241])
    known = truth.known_fraction(large)
    assert (whole.sum(axis=0) <= known + 1e-6).all()


def test_one_pass_gives_what_counting_each_cell_gives() -> None:
    rng = np.random.default_rng(0)
    codes = rng.integers(0, 6, (37, 52)).astype(np.uint8)
    kinds = np.full(256, 255, dtype=np.uint8)
    kinds[1:5] = [2, 0, 1, 7]  # 7 is none of the three, 255 neither
    for n, row, col in ((1, 0, 0), (5, 3, 11), (7, 20, 0), (100, 40, 30)):
        counts = np.ones((3, (row + 37) // n + 1, (col + 52) // n + 1), dtype=np.int32)
        expected = counts.copy()
        r, c = np.indices(codes.shape)
        for kind in range(3):
            is_kind = kinds[codes] == kind
            np.add.at(expected[kind], ((r[is_kind] + row) // n, (c[is_kind] + col) // n), 1)
        count_into(counts, codes, kinds, row, col, n)
        np.testing.assert_array_equal(counts, expected)


def test_several_grids_have_the_same_truth_as_each_alone(folder: Path) -> None:
    x, y = np.floor(bend(np.array([90.0]), 0.0)[0]).astype(int) * 5
    grids = [
        BevGrid(0.2, x - 120, y - 90, x + 60, y + 70),
        BevGrid(0.2, x - 33, y - 17, x + 200, y + 150),
    ]
    together = references_from_truth_raster(folder, grids)
    truth = TruthRaster.open(folder)
    for grid, reference in zip(grids, together, strict=True):
        alone = reference_from_truth_raster(folder, grid)
        shares = truth.class_fractions(grid).astype(np.float64)
        shares[:, truth.known_fraction(grid) < 1.0 - 1e-6] = np.nan
        np.testing.assert_array_equal(true_shares(truth, grid), shares)
        index = true_classes(shares, [str(c) for c in MAP_CLASSES])
        for one in (alone, reference):
            np.testing.assert_array_equal(one.is_covered, np.isfinite(shares[0]))
            for k, map_class in enumerate(MAP_CLASSES):
                np.testing.assert_array_equal(one.group(map_class).truth, index == k)
            drivable = np.isin(index, [MAP_CLASSES.index(c) for c in DRIVABLE_CLASSES])
            np.testing.assert_array_equal(one.group("drivable").truth, drivable)
            assert one.source == alone.source
    assert not together[1].is_covered.all()
    far = BevGrid(0.2, x + 10_000, y, x + 10_010, y + 10)
    with pytest.raises(FormatError, match="does not overlap"):
        references_from_truth_raster(folder, [grids[0], far])


def test_fractions_of_another_lattice_or_frame_are_refused(truth: TruthRaster) -> None:
    with pytest.raises(MapMismatchError, match=r"multiple of that; found 0\.05"):
        truth.class_fractions(BevGrid(0.05, 0, 0, 10, 10))
    frame = MapFrame.from_origin(49.0, 8.4)
    with pytest.raises(CRSMismatchError):
        truth.class_fractions(BevGrid(0.2, 0, 0, 10, 10, frame))


def test_the_same_drive_gives_the_same_bytes(folder: Path, builder, tmp_path: Path) -> None:
    write_truth_raster(
        tmp_path, SceneBuilder(curved_street(), builder.settings), short_route(), 25.0
    )
    names = sorted(p.name for p in folder.iterdir())
    assert names == sorted(p.name for p in tmp_path.iterdir())
    for name in names:
        assert (folder / name).read_bytes() == (tmp_path / name).read_bytes()


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda f: (f / "index.json").unlink(), "holds no truth raster"),
        (lambda f: (f / "index.json").write_text("{"), "is not the index of a truth raster"),
        (lambda f: (f / "index.json").write_text("[1]"), "is not the index of a truth raster"),
        (lambda f: _change(f, schema_version=2), "of version 2"),
        (lambda f: _change(f, tiles=7), "is not the index of a truth raster"),
        (lambda f: [p.unlink() for p in f.glob("*.png")], "missing or no truth tile"),
        (lambda f: [p.write_bytes(b"no") for p in f.glob("*.png")], "missing or no truth tile"),
        (lambda f: [p.write_bytes(b"no") for p in f.glob("*.npy")], "no tile of heights"),
    ],
)
def test_a_damaged_truth_is_refused(folder: Path, tmp_path: Path, spoil, message: str) -> None:
    import shutil

    copy = tmp_path / "raster"
    shutil.copytree(folder, copy)
    spoil(copy)
    with pytest.raises(FormatError, match=message):
        TruthRaster.open(copy).height_at(bend(np.array([90.0]), 0.0))


def _change(folder: Path, **values: object) -> None:
    document = json.loads((folder / "index.json").read_text())
    (folder / "index.json").write_text(json.dumps(document | values))


@pytest.fixture(scope="module")
def vectors(builder: SceneBuilder):
    return truth_vector_map(builder, short_route(), 25.0)


def xy_along(element, step_m: float = 0.1) -> np.ndarray:
    line = element.geometry
    return shapely.get_coordinates(
        shapely.line_interpolate_point(line, np.arange(0.2, line.length - 0.2, step_m))
    )


def test_everything_lies_on_the_ground(vectors, builder) -> None:
    for element in vectors:
        xyz = shapely.get_coordinates(element.geometry, include_z=True)
        np.testing.assert_allclose(xyz[:, 2], builder.terrain.height_at(xyz[:, :2]), atol=1e-9)


def test_marks_lie_on_paint_and_keep_what_they_are(vectors, truth: TruthRaster) -> None:
    marks = vectors.of_type(LaneMark)
    styles = {mark.style: mark for mark in marks}
    assert set(styles) == {MarkStyle.SOLID, MarkStyle.DASHED}
    assert styles[MarkStyle.SOLID].width_m == 0.15
    for mark in marks:
        on_paint = truth.labels_at(xy_along(mark)) == label("lane marking")
        share = 1 / 3 if mark.style == MarkStyle.DASHED else 1.0
        assert on_paint.mean() == pytest.approx(share, abs=0.12)


def test_boundaries_are_the_foot_of_the_kerb_with_the_road_on_the_right(vectors, truth) -> None:
    boundaries = vectors.of_type(RoadBoundary)
    assert {b.kind for b in boundaries} >= {BoundaryKind.KERB_HIGH, BoundaryKind.KERB_LOW}
    checked = 0
    for boundary in boundaries:
        xy = xy_along(boundary)
        if len(xy) < 5:
            continue
        ahead = np.gradient(xy, axis=0)
        left = np.column_stack([-ahead[:, 1], ahead[:, 0]])
        left /= np.linalg.norm(left, axis=1, keepdims=True)
        road = np.isin(
            truth.labels_at(xy - 0.04 * left),
            [label("road"), label("crosswalk"), label("lane marking"), label("manhole")],
        )
        kerb = truth.labels_at(xy + 0.04 * left) == label("curb")
        known = truth.labels_at(xy) != 255
        assert (road & kerb)[known].mean() > 0.98
        checked += int(known.sum())
    assert checked > 500
    # High on the right of the street, low on its left, as the map says; lowered at the crossing.
    high = shapely.union_all([b.geometry for b in boundaries if b.kind == BoundaryKind.KERB_HIGH])
    low = shapely.union_all([b.geometry for b in boundaries if b.kind == BoundaryKind.KERB_LOW])
    right, left_ = (shapely.points(bend(np.arange(75.0, 96.0), d)) for d in (-LANE_M, LANE_M))
    assert shapely.distance(high, right).max() < 0.02
    assert shapely.distance(low, left_).max() < 0.02
    assert shapely.distance(low, shapely.points(bend(np.array([102.0]), -LANE_M)))[0] < 0.02


def test_crosswalk_and_stop_line_are_the_painted_ones(vectors, truth) -> None:
    (crosswalk,) = vectors.of_type(Crosswalk)
    points = bend(
        *(
            a.ravel()
            for a in np.meshgrid(np.linspace(100.05, 103.95, 40), np.linspace(-3.4, 3.4, 40))
        )
    )
    assert shapely.contains_xy(crosswalk.geometry, points).all()
    assert crosswalk.geometry.area == pytest.approx(4.0 * 7.0, rel=0.01)
    (stop,) = vectors.of_type(StopLine)
    assert stop.width_m == 0.4
    assert (truth.labels_at(xy_along(stop)) == label("lane marking")).all()


def test_nothing_reaches_beyond_what_was_asked_for(vectors) -> None:
    around = shapely.LineString(short_route().xy).buffer(25.2)
    assert all(around.covers(element.geometry) for element in vectors)
