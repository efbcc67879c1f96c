"""Errors like a network's: in blobs, at edges, more of them far away, and as many as a matrix says.

For a pixel of true label t the probability of each wrong label p is

    scale[t, p] · reach(pixel) · (everywhere + beside_p(pixel) + around_p(pixel)), at most 1 in all

`reach` grows with the distance on flat ground; `beside` and `around` say whether p is the
true label of something within a few, or some twenty, pixels: boundaries blur, and things
are confused with their neighbours. `scale` is fitted to a sample of the drive's label
images such that the mean over the drive is the matrix that is asked for.

Whether a pixel is wrong, and as what, is drawn from two correlated Gaussian fields, turned
into uniform numbers by their distribution: each pixel's probabilities hold exactly, and
errors come in blobs. A field is the sum of textures of several scales in the image, new
ones for each image, and of one that lies on the ground: worn paint is missed again and
again, which no fusion of many frames averages out.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.geometry.se3 import SE3
from hdmap_tools.types import NDArrayAny, NDArrayBool, NDArrayByte, NDArrayFloat, NDArrayFloat32

GROUND_SHARE: Final = 0.25
"""Of the variance of the fields that lies on the ground, the same in all images of a place."""

_GROUND_Z_EGO_M: Final = -0.33
_MAX_RANGE_M: Final = 50.0
_NEAR: Final = 0.4
_REFERENCE_WIDTH_PX: Final = 960
_TEXTURE_CELLS: Final = 1024
_IMAGE_SCALES: Final = ((2.5, 0.1), (7.0, 0.4), (20.0, 0.5))
"""Blur in pixels of an image 960 wide, and share of the variance of what is in the image."""
_GROUND_CELL_M: Final = 0.1
_GROUND_BLUR_CELLS: Final = 5.0
_BESIDE_PX, _AROUND_PX = 3, 12
_FIT_ROUNDS: Final = 12


@dataclass(frozen=True, eq=False)
class ViewedGround:
    """What a camera's pixels see if the ground is flat; (H, W) each.

    Attributes:
        x, y: Float32 metres in the ego frame; 0 where there is no ground.
        is_ground: Bool: below the horizon and within reach.
        reach: Float32 factor of the error rate, about 0.5 near the vehicle, 3.4 at 50 m.
    """

    x: NDArrayFloat32
    y: NDArrayFloat32
    is_ground: NDArrayBool
    reach: NDArrayFloat32

    @classmethod
    def of_camera(cls, camera: PinholeCamera) -> ViewedGround:
        """For a camera on a vehicle whose ego origin is 0.33 m above the ground."""
        shape = (camera.height_px, camera.width_px)
        v, u = np.indices(shape)
        rays = camera.rays_ego(np.column_stack([u.ravel(), v.ravel()]).astype(np.float64))
        origin = camera.ego_SE3_cam.translation
        is_down = rays[:, 2] < -1e-6  # NaN, where the lens has no ray, is not
        along = np.where(
            is_down, (_GROUND_Z_EGO_M - origin[2]) / np.where(is_down, rays[:, 2], 1), 0
        )
        steps = np.nan_to_num(along[:, None] * rays[:, :2])
        range_m = np.where(is_down, np.hypot(steps[:, 0], steps[:, 1]), _MAX_RANGE_M)
        is_ground = is_down & (range_m < _MAX_RANGE_M)
        reach = _NEAR + (np.minimum(range_m, _MAX_RANGE_M) / 20.0) ** 1.2
        # Above the horizon stand things of any distance.
        reach = np.where(is_down, reach, 1.0)
        x, y = np.where(is_ground[:, None], origin[:2] + steps, 0.0).T
        return cls(
            x.reshape(shape).astype(np.float32),
            y.reshape(shape).astype(np.float32),
            is_ground.reshape(shape),
            reach.reshape(shape).astype(np.float32),
        )


def neighbourhoods(labels: NDArrayByte, num_labels: int, radius_px: int) -> NDArrayByte:
    """(H, W, P) uint8: 255 where a pixel of label p is within the radius, falling to 0 at twice it."""
    import cv2

    size = 2 * radius_px + 1
    kernel = np.ones((size, size), np.uint8)
    near = np.zeros((*labels.shape, num_labels), np.uint8)
    present = np.flatnonzero(np.bincount(labels.ravel(), minlength=256)[:num_labels])
    for label in present.tolist():
        mask = (labels == label).view(np.uint8) * np.uint8(255)
        near[:, :, label] = cv2.blur(cv2.dilate(mask, kernel), (size, size))
    return near


class NoiseFields:
    """Correlated standard normal fields over images.

    Args:
        seed: Everything follows from it.
        width_px: Of the images; textures are as coarse as they are wide.
        height_px: Of the images.
    """

    def __init__(self, seed: int, width_px: int, height_px: int) -> None:
        self._seed = seed
        self._scale = width_px / _REFERENCE_WIDTH_PX
        self._margins = ((0, height_px), (0, width_px))

    def draw(self, key: str, ground: ViewedGround, city_SE3_ego: SE3) -> list[NDArrayFloat32]:
        """Two independent fields (H, W) float32 of one image.

        Args:
            key: Names the image; another one gives other fields, except for what lies on
                the ground.
            ground: Where its pixels meet the ground.
            city_SE3_ego: Where the vehicle is.
        """
        rng = np.random.default_rng([self._seed, zlib.crc32(key.encode())])
        ahead, aside = city_SE3_ego.rotation[:2, 0], city_SE3_ego.rotation[:2, 1]
        rise = city_SE3_ego.rotation[:2, 2] * _GROUND_Z_EGO_M + city_SE3_ego.translation[:2]
        # One period of the texture is enough, and float32 is coarse far from the origin.
        start = np.mod(rise, _GROUND_CELL_M * _TEXTURE_CELLS)
        place = [
            (
                ground.x * np.float32(ahead[k])
                + ground.y * np.float32(aside[k])
                + np.float32(start[k])
            )
            / np.float32(_GROUND_CELL_M)
            for k in range(2)
        ]
        return [self._field(rng, ground, place, index) for index in range(2)]

    def _field(
        self,
        rng: np.random.Generator,
        ground: ViewedGround,
        place: Sequence[NDArrayFloat32],
        index: int,
    ) -> NDArrayFloat32:
        shape = ground.reach.shape
        field = np.zeros(shape, np.float32)
        for texture, (_, share) in zip(self._image_textures, _IMAGE_SCALES, strict=True):
            field += np.float32(np.sqrt(share * (1 - GROUND_SHARE))) * _cut(texture, shape, rng)
        # What meets no ground gets a field of its own in place of the ground's.
        fixed = _cut(self._image_textures[-1], shape, rng)
        on_ground = _sampled(self._ground_textures[index], place)
        fixed = np.where(ground.is_ground, on_ground, fixed)
        field += np.float32(np.sqrt(GROUND_SHARE)) * fixed
        return field

    @cached_property
    def _image_textures(self) -> list[NDArrayFloat32]:
        return [
            np.pad(_texture(self._seed, number, blur * self._scale), self._margins, mode="wrap")
            for number, (blur, _) in enumerate(_IMAGE_SCALES)
        ]

    @cached_property
    def _ground_textures(self) -> list[NDArrayFloat32]:
        return [_texture(self._seed, 100 + number, _GROUND_BLUR_CELLS) for number in range(2)]


@dataclass(frozen=True, eq=False)
class Sample:
    """Pixels of a drive's true label images, for fitting; rows match.

    Attributes:
        true: (N,) uint8 ids.
        reach: (N,) float32.
        beside, around: (N, P) uint8.
    """

    true: NDArrayByte
    reach: NDArrayFloat32
    beside: NDArrayByte
    around: NDArrayByte

    @classmethod
    def of_image(
        cls, labels: NDArrayByte, ground: ViewedGround, num_labels: int, stride: int
    ) -> Sample:
        """Every stride-th pixel of every stride-th row."""
        beside, around = nearby(labels, num_labels)
        every = (slice(stride // 2, None, stride), slice(stride // 2, None, stride))
        return cls(
            labels[every].ravel(),
            ground.reach[every].ravel(),
            beside[every].reshape(-1, num_labels),
            around[every].reshape(-1, num_labels),
        )

    @classmethod
    def joined(cls, samples: Sequence[Sample]) -> Sample:
        """All of them as one."""
        return cls(
            np.concatenate([s.true for s in samples]),
            np.concatenate([s.reach for s in samples]),
            np.concatenate([s.beside for s in samples]),
            np.concatenate([s.around for s in samples]),
        )


def nearby(labels: NDArrayByte, num_labels: int) -> tuple[NDArrayByte, NDArrayByte]:
    """What is beside and around each pixel, (H, W, P) uint8 each."""
    scale = labels.shape[1] / _REFERENCE_WIDTH_PX
    beside, around = (max(1, round(px * scale)) for px in (_BESIDE_PX, _AROUND_PX))
    return neighbourhoods(labels, num_labels, beside), neighbourhoods(labels, num_labels, around)


def fitted_scale(sample: Sample, shares: NDArrayFloat) -> NDArrayFloat:
    """(T, P) scale such that the sample's expected confusion is the one asked for.

    Args:
        sample: Pixels of the drive.
        shares: (T, P) share of each true label's pixels that shall be each label; rows add
            up to 1, the diagonal is what stays right.

    Returns:
        The scale; 0 on the diagonal and for labels without a pixel.
    """
    from hdmap_tools.segmentation.label_noise_kernels import expected_confusion

    wanted = shares.copy()
    np.fill_diagonal(wanted, 0.0)
    pixels = np.bincount(sample.true, minlength=256)[: len(shares)].astype(np.float64)
    wanted[pixels == 0] = 0.0
    scale = wanted.copy()
    for _ in range(_FIT_ROUNDS):
        found = (
            expected_confusion(sample.true, sample.reach, sample.beside, sample.around, scale)
            / np.maximum(pixels, 1.0)[:, None]
        )
        scale *= np.divide(wanted, found, out=np.zeros_like(wanted), where=found > 0)
    return scale


def _texture(seed: int, number: int, blur_cells: float) -> NDArrayFloat32:
    """Blurred noise that repeats without a seam, its values exactly as a normal distribution's."""
    from scipy.ndimage import gaussian_filter
    from scipy.special import ndtri

    rng = np.random.default_rng([seed, 0x7EC5, number])
    noise = rng.standard_normal((_TEXTURE_CELLS, _TEXTURE_CELLS)).astype(np.float32)
    smooth = gaussian_filter(noise, blur_cells, mode="wrap").ravel()
    ranks = np.empty(smooth.size, dtype=np.int64)
    ranks[np.argsort(smooth, kind="stable")] = np.arange(smooth.size)
    values = ndtri((np.arange(smooth.size) + 0.5) / smooth.size).astype(np.float32)
    texture: NDArrayFloat32 = values[ranks].reshape(noise.shape)
    return texture


def _cut(texture: NDArrayFloat32, shape: tuple[int, ...], rng: np.random.Generator) -> NDArrayAny:
    """A piece of a texture that goes on for `shape` beyond its period, turned over or not."""
    row, column, turns = (int(n) for n in rng.integers((_TEXTURE_CELLS, _TEXTURE_CELLS, 4)))
    piece = texture[row : row + shape[0], column : column + shape[1]]
    return piece[:: -1 if turns & 1 else 1, :: -1 if turns & 2 else 1]


def _sampled(texture: NDArrayFloat32, place: Sequence[NDArrayFloat32]) -> NDArrayAny:
    """Values at cell positions x and y; so blurred a texture loses no spread between its cells."""
    import cv2

    # np.mod does the same in six times the time.
    period = np.float32(_TEXTURE_CELLS)
    x, y = (p - period * np.floor(p / period) for p in place)
    return cv2.remap(texture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
