"""From light to the picture: lens, exposure, noise, white balance and tone curve."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from hdmap_tools.simulate.light import CameraLook
from hdmap_tools.simulate.settings import Difficulty, Weather
from hdmap_tools.types import NDArrayByte, NDArrayFloat32


@dataclass(frozen=True)
class Optics:
    """How good the camera is.

    Attributes:
        blur_px: One sigma of the point spread.
        shot, read: Noise at full well and in the dark, one sigma, full well is 1.
        vignetting: Light lost in the corners.
        num_spots: Of dirt on the lens.
        exposure_jitter: One sigma of the exposure from image to image, natural log.
        balance_jitter: The same of the white balance.
    """

    blur_px: float
    shot: float
    read: float
    vignetting: float
    num_spots: int
    exposure_jitter: float
    balance_jitter: float


_OPTICS = {
    Difficulty.EASY: Optics(0.55, 0.010, 0.002, 0.15, 0, 0.02, 0.005),
    Difficulty.DEFAULT: Optics(0.70, 0.018, 0.004, 0.25, 0, 0.06, 0.015),
    Difficulty.HARD: Optics(0.95, 0.035, 0.009, 0.35, 12, 0.15, 0.03),
}
_WHITE_BALANCE = {
    Weather.CLEAR: (0.97, 1.0, 1.06),
    Weather.OVERCAST: (1.0, 1.0, 1.0),
    Weather.HAZE: (0.97, 1.0, 1.04),
    Weather.WET: (1.0, 1.0, 1.0),
    Weather.DUSK: (0.92, 1.0, 1.06),
}
"""Gains of red, green, blue: cameras take out most of the light's colour, not all of it."""

_MEAN_LIGHT = 0.15
"""Where automatic exposure puts the mean of the lower two thirds: ground and what stands on it."""


def form_image(light: NDArrayFloat32, look: CameraLook, rng: np.random.Generator) -> NDArrayByte:
    """The picture (h, w, 3) uint8 sRGB that a camera makes of linear light (h, w, 3).

    Args:
        light: Float32, relative units; not changed.
        look: Weather and quality of the camera.
        rng: Exposure, white balance and noise of this image.
    """
    import cv2

    from hdmap_tools.simulate.compiled import in_bands
    from hdmap_tools.simulate.image_kernels import finish

    optics = _OPTICS[look.difficulty]
    height, width = light.shape[:2]
    blurred: NDArrayFloat32 = np.asarray(
        cv2.GaussianBlur(light, (0, 0), optics.blur_px), dtype=np.float32
    ).reshape(-1, 3)
    lower = light[height // 3 :: 8, ::8]
    # The sun in a window must not darken the road.
    mean = float(np.minimum(lower.mean(axis=2), 2.0).mean())
    exposure = _MEAN_LIGHT / max(mean, 1e-4) * np.exp(rng.normal(0.0, optics.exposure_jitter))
    balance = np.exp(rng.normal(0.0, optics.balance_jitter, 3))
    gains = exposure * balance / balance.mean() * np.array(_WHITE_BALANCE[look.weather])
    # Short of light, the gain is turned up, and the noise with it.
    gain = 1.6 if look.weather is Weather.DUSK else 1.0
    seed = int(rng.integers(1, 2**20))
    falloff = _falloff(height, width, look)
    curve = _tone_curve()
    picture = np.empty((height * width, 3), np.uint8)

    def develop(first: int, last: int) -> None:
        finish(
            first,
            last,
            width,
            blurred,
            falloff,
            gains,
            optics.shot * gain,
            optics.read * gain,
            seed,
            curve,
            picture,
        )

    in_bands(develop, height * width)
    return picture.reshape(height, width, 3)


@lru_cache(maxsize=1)
def _tone_curve() -> NDArrayByte:
    """(4096,) uint8 over the square root of light, 0..2: a shoulder, then sRGB's curve (IEC 61966-2-1)."""
    light = (np.arange(4096) / 2047.5) ** 2
    shown = 1.0 - np.exp(-1.35 * light)
    srgb = np.where(shown <= 0.0031308, 12.92 * shown, 1.055 * shown ** (1 / 2.4) - 0.055)
    # A little contrast, as cameras add.
    srgb = srgb + 0.08 * np.sin(2 * np.pi * (srgb - 0.5)) * 0.5
    curve: NDArrayByte = np.clip(np.rint(255 * srgb), 0, 255).astype(np.uint8)
    return curve


@lru_cache(maxsize=8)
def _falloff(height: int, width: int, look: CameraLook) -> NDArrayFloat32:
    """(h * w,) part of the light that the lens and the dirt on it let through."""
    optics = _OPTICS[look.difficulty]
    v, u = np.mgrid[0:height, 0:width]
    u = (u - (width - 1) / 2) / (width / 2)
    v = (v - (height - 1) / 2) / (width / 2)
    corner2 = 1.0 + (height / width) ** 2
    passed = 1.0 - optics.vignetting * (u * u + v * v) / corner2
    rng = np.random.default_rng([look.seed, 0xD127])
    for _ in range(optics.num_spots):
        x, y = rng.uniform(-1, 1), rng.uniform(-height / width, height / width)
        radius, depth = rng.uniform(0.01, 0.06), rng.uniform(0.1, 0.5)
        passed *= 1.0 - depth * np.exp(-((((u - x) ** 2 + (v - y) ** 2) / radius**2) ** 1.5))
    result: NDArrayFloat32 = passed.ravel().astype(np.float32)
    result.setflags(write=False)
    return result
