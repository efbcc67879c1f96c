import json
from pathlib import Path

import numpy as np
import pytest

from hdmap_tools.compare.reference import load_reference
from hdmap_tools.errors import CRSMismatchError, FormatError
from hdmap_tools.geometry.grid import BevGrid
from hdmap_tools.geometry.map_frame import MapFrame
from hdmap_tools.labels.label_set import DRIVABLE_CLASSES, MapClass

from .conftest import WriteMask

ORIGIN = (49.0, 8.4)


def test_row_0_of_the_picture_is_the_north_edge(write_mask: WriteMask) -> None:
    path = write_mask([[255, 0, 0], [0, 0, 0], [0, 0, 255]], resolution_m=1.0, origin=(10.0, 20.0))
    reference = load_reference(path, BevGrid(1.0, 9, 19, 14, 24))
    rows, cols = np.nonzero(reference.groups[0].truth)
    # North-west pixel: x 10..11, y 22..23; south-east pixel: x 12..13, y 20..21.
    assert sorted(zip(rows + 19, cols + 9, strict=True)) == [(20, 12), (22, 10)]
    expected = np.zeros((5, 5), dtype=bool)
    expected[1:4, 1:4] = True
    np.testing.assert_array_equal(reference.is_covered, expected)
    assert reference.groups[0].name == "drivable"
    assert reference.groups[0].classes == DRIVABLE_CLASSES


@pytest.mark.parametrize("ratio", [1, 2, 3, 5])
@pytest.mark.parametrize("first_cell", [-7, 0, 3, 4115])
def test_whole_multiples_count_the_marked_pixels_of_each_cell(
    write_mask: WriteMask, ratio: int, first_cell: int
) -> None:
    rng = np.random.default_rng(ratio * 10000 + first_cell)
    picture = (rng.random((8 * ratio, 6 * ratio)) < 0.5) * np.uint8(255)
    cell_m = 0.1 * ratio
    path = write_mask(picture, origin=(first_cell * cell_m, -first_cell * cell_m))
    grid = BevGrid(cell_m, first_cell, -first_cell, first_cell + 6, -first_cell + 8)
    marked = (picture[::-1] > 0).reshape(8, ratio, 6, ratio).sum(axis=(1, 3))
    for min_share, needed in [(0.5, ratio**2 / 2), (1.0, ratio**2), (0.0, 0.5)]:
        reference = load_reference(path, grid, min_share=min_share)
        assert reference.is_covered.all()
        np.testing.assert_array_equal(reference.groups[0].truth, marked >= needed)


def test_a_mask_half_a_cell_off_is_weighed_by_area_not_shifted(write_mask: WriteMask) -> None:
    # Pixels 0.2 m, cells 0.2 m, but the mask starts at 0.05: the marked pixel covers
    # 0.45..0.65, three quarters of cell 2 and one quarter of cell 3.
    path = write_mask([[0, 0, 255, 0, 0]], resolution_m=0.2, origin=(0.05, 0.0))
    grid = BevGrid(0.2, 0, 0, 5, 1)
    truth = {s: load_reference(path, grid, min_share=s).groups[0].truth[0] for s in (0.2, 0.5, 0.8)}
    assert truth[0.2].tolist() == [False, False, True, True, False]
    assert truth[0.5].tolist() == [False, False, True, False, False]
    assert truth[0.8].tolist() == [False, False, False, False, False]
    assert load_reference(path, grid).is_covered[0].tolist() == [False, True, True, True, True]


def test_pixels_larger_than_cells(write_mask: WriteMask) -> None:
    path = write_mask([[0, 255], [0, 0]], resolution_m=1.0)
    truth = load_reference(path, BevGrid(0.25, 0, 0, 8, 8)).groups[0].truth
    expected = np.zeros((8, 8), dtype=bool)
    expected[4:, 4:] = True
    np.testing.assert_array_equal(truth, expected)


def test_marks_may_be_1_or_255_and_three_equal_channels(write_mask: WriteMask) -> None:
    grid = BevGrid(0.1, 0, 0, 2, 2)
    flat = np.array([[1, 0], [0, 0]])
    first = load_reference(write_mask(flat), grid).groups[0].truth
    second = load_reference(write_mask(np.dstack([flat * 255] * 3)), grid).groups[0].truth
    assert first.tolist() == second.tolist() == [[False, False], [True, False]]


def test_classes_come_from_the_sidecar_or_the_caller(write_mask: WriteMask) -> None:
    grid = BevGrid(0.1, 0, 0, 2, 2)
    path = write_mask(np.ones((2, 2)), classes=["crosswalk"])
    assert load_reference(path, grid).groups[0].name == "crosswalk"
    given = load_reference(path, grid, classes=[MapClass.ROAD, MapClass.SIDEWALK])
    assert given.groups[0].name == "road+sidewalk"


def test_the_same_place_through_wgs84(write_mask: WriteMask) -> None:
    """A frame whose origin is 100 m further east sees the mask 100 m further west."""
    picture = np.zeros((80, 80), dtype=np.uint8)
    picture[10:60, 20:30] = 255  # asymmetric: a bar in the west, nearer to the north
    path = write_mask(picture, origin=(100.0, 50.0), map_origin_latlon=ORIGIN)
    here = MapFrame.from_origin(*ORIGIN)
    lon, lat, _ = here.to_wgs84(np.array([[100.0, 50.0, 0.0]]))[0]
    there = MapFrame.from_origin(lat, lon)
    direct = load_reference(path, BevGrid(0.2, 500, 250, 540, 290, here))
    turned = load_reference(path, BevGrid(0.2, 0, 0, 40, 40, there))
    assert direct.notes == ()
    assert "WGS84" in turned.notes[0]
    # Grid convergence over 100 m is far below a pixel, but an edge may fall on a cell's middle.
    assert (direct.groups[0].truth != turned.groups[0].truth).mean() < 0.01
    shifted = np.roll(direct.groups[0].truth, 2, axis=1)
    assert (shifted != turned.groups[0].truth).mean() > 0.05
    # A mere difference in height of the origin is no other place.
    raised = MapFrame.from_origin(*ORIGIN, alt_m=120.0)
    assert load_reference(path, BevGrid(0.2, 500, 250, 540, 290, raised)).notes == ()


def test_one_side_without_a_place_on_earth_is_refused_unless_told_otherwise(
    write_mask: WriteMask,
) -> None:
    grid = BevGrid(0.1, 0, 0, 2, 2)
    path = write_mask(np.ones((2, 2)), map_origin_latlon=ORIGIN)
    with pytest.raises(CRSMismatchError, match=r"map has no origin.*--origin"):
        load_reference(path, grid)
    assert "as asked for" in load_reference(path, grid, assume_same_frame=True).notes[0]
    bare = write_mask(np.ones((2, 2)))
    with pytest.raises(CRSMismatchError, match="map_origin_latlon"):
        load_reference(bare, BevGrid(0.1, 0, 0, 2, 2, MapFrame.from_origin(*ORIGIN)))
    assert "Neither" in load_reference(bare, grid).notes[0]


GRID = BevGrid(0.1, 0, 0, 4, 4)


def one_line(error: pytest.ExceptionInfo[FormatError]) -> str:
    text = str(error.value)
    assert "\n" not in text
    assert len(text) < 600
    assert "0" * 20 not in text
    return text


SIDECAR = {"resolution_m": 0.1, "origin_xy_m": [0, 0], "size_px": [4, 4]}


def test_no_sidecar(write_mask: WriteMask) -> None:
    path = write_mask(np.ones((4, 4)))
    path.with_suffix(".json").unlink()
    with pytest.raises(FormatError, match=r"no mask\.json beside it") as error:
        load_reference(path, GRID)
    one_line(error)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("{", "not JSON"),
        ("[" * 100000, "not JSON"),
        (json.dumps(SIDECAR)[:-1] + ', "note": ' + "9" * 9000 + "}", "not JSON"),
        (json.dumps(SIDECAR | {"resolution_m": 1e300}), "resolution_m: .* 1000"),
        (json.dumps(SIDECAR | {"resolution_m": 1e-9}), "resolution_m"),
        (json.dumps(SIDECAR | {"resolution_m": 10**300}), "resolution_m"),
        (json.dumps(SIDECAR | {"origin_xy_m": [0, -1e8]}), "origin_xy_m.1"),
        (json.dumps(SIDECAR | {"origin_xy_m": [10**300, 0]}), "origin_xy_m.0"),
        (json.dumps(SIDECAR | {"size_px": [10**300, 4]}), "size_px.0"),
        (json.dumps(SIDECAR | {"size_px": ["x"] * 3000}), "size_px"),
        ("[]", "does not describe a mask"),
        ("{}", "resolution_m: Field required"),
        ('{"resolution_m": NaN, "origin_xy_m": [0, 0], "size_px": [4, 4]}', "resolution_m"),
        ('{"resolution_m": 0, "origin_xy_m": [0, 0], "size_px": [4, 4]}', "resolution_m"),
        ('{"resolution_m": 0.1, "origin_xy_m": [0], "size_px": [4, 4]}', "origin_xy_m"),
        (
            '{"resolution_m": 0.1, "origin_xy_m": [0, 0], "size_px": [4, 4], "classes": ["lava"]}',
            "classes",
        ),
        (
            '{"resolution_m": 0.1, "origin_xy_m": [0, 0], "size_px": [4, 4], "classes": []}',
            "classes",
        ),
    ],
)
def test_a_broken_sidecar(write_mask: WriteMask, text: str, says: str) -> None:
    path = write_mask(np.ones((4, 4)))
    path.with_suffix(".json").write_text(text)
    with pytest.raises(FormatError, match=says) as error:
        load_reference(path, GRID)
    one_line(error)


def test_bytes_that_are_no_text(write_mask: WriteMask) -> None:
    path = write_mask(np.ones((4, 4)))
    path.with_suffix(".json").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(FormatError, match="not a readable text file"):
        load_reference(path, GRID)


def test_a_size_that_does_not_fit(write_mask: WriteMask) -> None:
    path = write_mask(np.ones((4, 6)), size_px=[4, 6])
    with pytest.raises(FormatError, match=r"6 x 4 pixels.*\[4, 6\]") as error:
        load_reference(path, GRID)
    one_line(error)


def test_damaged_pictures(write_mask: WriteMask) -> None:
    path = write_mask(np.random.default_rng(0).integers(0, 2, (40, 40)))
    whole = path.read_bytes()
    flipped = bytearray(whole)
    flipped[60] ^= 0xFF
    for data, says in [
        (b"", "not a PNG"),
        (b"GIF89a", "not a PNG"),
        (whole[:-1], "damaged or cut off"),
        (whole[: len(whole) // 2], "damaged or cut off"),
        (whole[:8], "damaged or cut off"),
        (bytes(flipped), "damaged or cut off"),
    ]:
        path.write_bytes(data)
        with pytest.raises(FormatError, match=says) as error:
            load_reference(path, GRID)
        one_line(error)
    path.unlink()
    with pytest.raises(FormatError, match="cannot be read"):
        load_reference(path, GRID)


def test_pictures_that_are_no_masks(write_mask: WriteMask) -> None:
    with pytest.raises(FormatError, match=r"3 different values \(0, 1, 2\)"):
        load_reference(write_mask([[0, 1], [2, 0]]), GRID)
    with pytest.raises(FormatError, match="coloured"):
        load_reference(write_mask(np.array([[[255, 0, 0]]])), GRID)


def test_another_place(write_mask: WriteMask) -> None:
    with pytest.raises(FormatError, match="does not overlap the map") as error:
        load_reference(write_mask(np.ones((4, 4)), origin=(500.0, 0.0)), GRID)
    assert "500.0..500.4" in one_line(error)
    path = write_mask(np.ones((4, 4)), origin=(500.0, 0.0), map_origin_latlon=ORIGIN)
    far_away = BevGrid(0.1, 0, 0, 4, 4, MapFrame.from_origin(-33.0, 151.0))
    with pytest.raises(FormatError, match="does not overlap"):
        load_reference(path, far_away)


@pytest.mark.realdata
def test_the_real_mask_lies_where_its_json_says(data_root: Path) -> None:
    import cv2

    folder = data_root / "nuscenes"
    sidecar = json.loads((folder / "drivable_mask.json").read_text())
    picture = cv2.imread(str(folder / "drivable_mask.png"), cv2.IMREAD_UNCHANGED)
    x0, y0 = sidecar["origin_xy_m"]
    frame = MapFrame.from_origin(*sidecar["map_origin_latlon"])
    grid = BevGrid.from_bounds((x0 + 20, y0 + 35, x0 + 90, y0 + 140), 0.2, frame)
    reference = load_reference(folder / "drivable_mask.png", grid)
    assert reference.is_covered.all()
    # The data's own formula, at the four pixel centres of each cell.
    marked = np.zeros(grid.shape)
    for dx in (-0.05, 0.05):
        for dy in (-0.05, 0.05):
            cols = np.floor((grid.x_centres_m + dx - x0) * 10).astype(int)
            rows = np.floor((y0 + 200 - (grid.y_centres_m + dy)) * 10).astype(int)
            marked += picture[np.ix_(rows, cols)] > 0
    np.testing.assert_array_equal(reference.groups[0].truth, marked >= 2)
    assert 0.05 < reference.groups[0].truth.mean() < 0.95


@pytest.mark.realdata
def test_lidar_points_on_the_ground_lie_on_the_real_mask_and_others_do_not(data_root: Path) -> None:
    """What is known of the data: most near-ground points lie on it, high ones and shifted ones do not."""
    from hdmap_tools.readers.open_drive import open_drive

    drive = open_drive(data_root / "nuscenes")
    sweep = drive.read_sweep(drive.sweeps[0])
    pose = drive.trajectory.interpolate(sweep.timestamp_ns, 0.5)
    x, y = pose.translation[:2]
    grid = BevGrid.from_bounds((x - 40, y - 40, x + 40, y + 40), 0.2, drive.frame)
    reference = load_reference(data_root / "nuscenes" / "drivable_mask.png", grid)
    assert reference.notes == ()  # the drive and its mask are in one frame
    points = pose.transform_from(sweep.points_ego)
    height = sweep.points_ego[:, 2]

    def share_on_mask(rows: np.ndarray, east_m: float) -> float:
        at = grid.rows_cols_of(points[rows, :2] + (east_m, 0.0))
        at = at[grid.contains(at)]
        return float(reference.groups[0].truth[at[:, 0], at[:, 1]].mean())

    assert share_on_mask(np.abs(height) < 0.2, 0.0) > 0.8
    assert share_on_mask(np.abs(height) < 0.2, 15.0) < 0.1
    assert share_on_mask(height > 2.0, 0.0) < 0.15
