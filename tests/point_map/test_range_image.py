"""Directions of returns to the bin, and the nearest return in any window of them."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hdmap_tools.geometry.se3 import SE3
from hdmap_tools.point_map.moving import _compare
from hdmap_tools.point_map.range_image import (
    BIN_DEG,
    COLUMNS,
    EMPTY_ROWS,
    LOWEST_DEG,
    MARGIN,
    ROWS,
    RangeImage,
    Windows,
    bin_of,
    nearest_within,
)
from hdmap_tools.readers.drive import Sweep

LIDAR = np.array([1.2, -0.1, 1.7])


def arctan2(y: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Of the C library, as compiled code has it; numpy's own may differ in the last bit."""
    return np.array([math.atan2(*pair) for pair in zip(y.tolist(), x.tolist(), strict=True)])


def image_of(points_lidar: np.ndarray, pose: SE3 | None = None) -> RangeImage:
    number = len(points_lidar)
    sweep = Sweep(0, points_lidar + LIDAR, np.zeros(number, np.uint8), np.zeros(number, np.uint8))
    return RangeImage.of(sweep, pose or SE3(np.eye(3), np.zeros(3)), LIDAR)


def whole(image: RangeImage) -> np.ndarray:
    """Of all directions, without margins."""
    inner = image.range_m[EMPTY_ROWS:-EMPTY_ROWS, MARGIN:-MARGIN]
    result = np.full((ROWS, COLUMNS), np.inf, np.float32)
    first = image.first_row + EMPTY_ROWS
    result[first : first + len(inner)] = inner
    return result


def expected(points_lidar: np.ndarray) -> np.ndarray:
    """The same in double precision."""
    x, y, z = ((points_lidar + LIDAR) - LIDAR).T
    distance = np.sqrt(x * x + y * y + z * z)
    row = (np.rad2deg(arctan2(z, np.sqrt(x * x + y * y))) - LOWEST_DEG) / BIN_DEG
    column = ((np.rad2deg(arctan2(y, x)) + 180.0) / BIN_DEG).astype(int) % COLUMNS
    use = (distance >= 1.5) & (row > -1.0) & (row < ROWS)
    result = np.full((ROWS, COLUMNS), np.inf, np.float32)
    at = row[use].astype(int), column[use]
    np.minimum.at(result, at, distance[use].astype(np.float32))
    return result


def test_returns_are_in_their_bins_and_beside_the_edges_of_bins_too():
    rng = np.random.default_rng(3)
    spread = rng.normal(size=(60_000, 3)) * rng.choice([2.0, 20.0], size=(60_000, 1))
    azimuth = np.deg2rad(np.arange(0.0, 360.0, BIN_DEG))
    elevation = np.deg2rad(np.arange(-42.0, 22.0, BIN_DEG))[::16, None]
    for off in (0.0, 1e-9, -1e-7, 3e-6):
        on_edges = np.stack(
            np.broadcast_arrays(
                np.cos(azimuth + off) * np.cos(elevation + off),
                np.sin(azimuth + off) * np.cos(elevation + off),
                np.sin(elevation + off),
            ),
            axis=-1,
        ).reshape(-1, 3)
        points = np.concatenate([spread, on_edges * 7.0])
        np.testing.assert_array_equal(whole(image_of(points)), expected(points))


@pytest.mark.parametrize(
    "points",
    [
        np.zeros((0, 3)),
        np.zeros((5, 3)),
        np.array([[0.0, 0.0, 9.0], [0.0, 0.0, -9.0]]),
        np.array([[-9.0, 0.0, 0.0], [-9.0, -0.0, 0.0], [9.0, 0.0, 0.0], [1e30, 1.0, 1.0]]),
        np.stack(np.meshgrid(*[np.arange(-3.0, 4.0)] * 3), axis=-1).reshape(-1, 3),
    ],
    ids=["none", "at the lidar", "overhead", "behind", "diagonals"],
)
def test_odd_directions(points):
    np.testing.assert_array_equal(whole(image_of(points)), expected(points))


@settings(max_examples=200, deadline=None)
@given(st.floats(-np.pi, np.pi), st.floats(-0.69, 0.34), st.floats(2.5, 80.0))
def test_a_direction_has_the_bin_that_an_image_puts_it_in(azimuth, elevation, distance):
    flat = distance * np.cos(elevation)
    x, y, z = flat * np.cos(azimuth), flat * np.sin(azimuth), distance * np.sin(elevation)
    row, column = bin_of(x, y, z)
    assert row == int((np.rad2deg(math.atan2(z, np.sqrt(x * x + y * y))) - LOWEST_DEG) / BIN_DEG)
    assert column == int((np.rad2deg(math.atan2(y, x)) + 180.0) / BIN_DEG)


def nearest(image: np.ndarray, rows: range, columns: range) -> float:
    rows = [row for row in rows if 0 <= row < ROWS]
    return float(
        min((image[row, [k % COLUMNS for k in columns]].min() for row in rows), default=np.inf)
    )


@pytest.fixture(scope="module")
def busy():
    rng = np.random.default_rng(4)
    points = rng.normal(size=(30_000, 3)) * (12.0, 12.0, 1.5)
    return image_of(points), expected(points)


@settings(max_examples=300, deadline=None)
@given(
    first=st.integers(-20, ROWS),
    number=st.integers(1, 60),
    column=st.integers(0, COLUMNS),
    wide=st.integers(0, 30),
)
def test_the_nearest_return_of_any_window(busy, first, number, column, wide):
    image, truth = busy
    windows = Windows().of(image)
    start = first - image.first_row
    found = nearest_within(windows, start, start + number - 1, column + MARGIN, wide)
    columns = range(column - wide, column + wide + 1)
    assert found == nearest(truth, range(first, first + number), columns)


def compared(centres, origin, rotation, image, gap_rows):
    """Of each block whether it was met, and whether seen through, pixel by pixel."""
    met, seen = np.zeros(len(centres), int), np.zeros(len(centres), int)
    for i, centre in enumerate(centres.astype(float)):
        x, y, z = rotation.T @ (centre - origin)
        distance, flat = np.sqrt(x * x + y * y + z * z), max(np.hypot(x, y), 0.1)
        if not 2.5 <= distance <= 40.0:
            continue
        row, column = bin_of(x, y, z)

        def bins(half_m, away):
            return int(np.rad2deg(half_m / away) / BIN_DEG + 0.5)

        tall, wide = max(bins(0.1, distance), 1), max(bins(0.1, flat), 1)
        if row < tall or row + tall >= ROWS:
            continue
        across = range(column - wide, column + wide + 1)
        near = nearest(image, range(row - tall, row + tall + 1), across)
        if distance - 0.3 <= near <= distance + 0.3:
            met[i] = 1
        high, broad = bins(0.05, distance), bins(0.05, flat)
        middle = range(row - high, row + high + 1), range(column - broad, column + broad + 1)
        beside = row - tall - gap_rows if z < 0.0 else row + tall + 1
        clear = min(near, nearest(image, range(beside, beside + gap_rows), across))
        seen[i] = clear > distance + 0.3 and np.isfinite(nearest(image, *middle))
    return met, seen


@pytest.mark.parametrize("gap_rows", [1, 5, 17])
def test_blocks_met_and_seen_through(gap_rows):
    """A wall behind, a wall before a part of it, and blocks all around."""
    rng = np.random.default_rng(5)
    azimuth, elevation = np.meshgrid(
        np.deg2rad(np.arange(-180.0, 180.0, 0.2)), np.deg2rad(np.arange(-25.0, 10.0, 0.5))
    )
    away = np.where(rng.random(azimuth.shape) < 0.1, 9.0, 20.0)
    away = np.where(np.abs(azimuth) < 0.5, 6.0, away)
    flat = away * np.cos(elevation)
    points = np.stack(
        [flat * np.cos(azimuth), flat * np.sin(azimuth), away * np.sin(elevation)], axis=-1
    ).reshape(-1, 3)
    points = points[rng.random(len(points)) < 0.9]
    pose = SE3.from_yaw(0.4, (3.0, 2.0, 0.5))
    image = image_of(points, pose)
    centres = (rng.normal(size=(2500, 3)) * (12.0, 12.0, 2.0) + (5.0, 5.0, 1.0)).astype(np.float32)
    lidar = image.city_SE3_lidar
    counts = np.zeros((2, len(centres)), np.uint16)
    counts[0, :700] = 65535
    windows = Windows().of(image)
    _compare(centres, lidar.translation, lidar.rotation, windows, image.first_row, gap_rows, counts)
    met, seen = compared(centres, lidar.translation, lidar.rotation, expected(points), gap_rows)
    assert min(met.sum(), seen.sum()) > 25
    np.testing.assert_array_equal(counts[1], seen)
    np.testing.assert_array_equal(counts[0], [65535] * 700 + met[700:].tolist())


def test_windows_serve_images_of_different_height(busy):
    """One after another, small ones in the room of large ones."""
    low = np.array([[9.0, 0.0, -1.0]])
    windows = Windows()
    for points in (low, None, low):
        image = busy[0] if points is None else image_of(points)
        truth = busy[1] if points is None else expected(points)
        found = windows.of(image)
        for row in range(0, ROWS, 7):
            for column in range(0, COLUMNS, 61):
                start = row - image.first_row
                got = nearest_within(found, start - 4, start + 4, column + MARGIN, 5)
                around = range(column - 5, column + 6)
                assert got == nearest(truth, range(row - 4, row + 5), around)
