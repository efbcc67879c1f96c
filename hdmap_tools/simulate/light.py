"""Weather as numbers: sun, sky, air, wetness, and how the camera answers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from hdmap_tools.simulate.settings import Difficulty, Weather

RGB = tuple[float, float, float]


@dataclass(frozen=True)
class CameraLook:
    """What the pictures of one drive have in common.

    Attributes:
        weather: Light and air.
        difficulty: Image noise, blur, dirt on the lens.
        seed: Where the sun stands, clouds, colours of the light, dirt.
    """

    weather: Weather = Weather.CLEAR
    difficulty: Difficulty = Difficulty.DEFAULT
    seed: int = 0


class Light(NamedTuple):
    """Light and air in relative linear units; a tuple, so that compiled code takes it.

    Light falling on a white surface is its own unit: a matte surface shows
    ``albedo * light``, and the sky is given as a white surface of that brightness.

    Attributes:
        sun_direction: Unit vector towards the sun, city frame.
        sun: Light on a surface that faces the sun, red, green, blue.
        sun_blur: Radius of the sun's disk with its aureole, radians.
        zenith, horizon: Brightness of the sky.
        ambient: Light of the whole sky on level ground.
        cloud: Part of the sky that is cloudy, 0..1, and `cloud_rgb` its brightness.
        haze_per_m: Part of the light lost on a metre of air, and `haze` what replaces it.
        wet: Wetness of the ground, 0..1.
        noise_seed: Of clouds and of all variation of surfaces.
    """

    sun_direction: RGB
    sun: RGB
    sun_blur: float
    zenith: RGB
    horizon: RGB
    ambient: RGB
    cloud: float
    cloud_rgb: RGB
    haze_per_m: float
    haze: RGB
    wet: float
    noise_seed: int


@dataclass(frozen=True)
class _Sky:
    """Light of one weather before its seeded variation; see `Light`."""

    elevation_deg: tuple[float, float]
    sun: RGB
    sun_blur: float
    zenith: RGB
    horizon: RGB
    ambient: RGB
    cloud: tuple[float, float]
    cloud_rgb: RGB
    haze_per_m: float
    wet: float = 0.0


# A clear sky gives level ground about a fifth of what the sun gives a surface that faces
# it, an overcast one nearly all there is. Haze by Koschmieder's law: 3.9 / visual range,
# 15 km when clear, 600 m in haze.
_SKIES: Final[dict[Weather, _Sky]] = {
    Weather.CLEAR: _Sky(
        (32.0, 62.0),
        (2.9, 2.7, 2.4),
        0.004,
        (0.48, 0.72, 1.20),
        (1.50, 1.65, 1.80),
        (0.55, 0.65, 0.85),
        (0.15, 0.5),
        (2.5, 2.5, 2.55),
        0.00026,
    ),
    Weather.OVERCAST: _Sky(
        (35.0, 60.0),
        (0.10, 0.10, 0.10),
        0.3,
        (1.30, 1.33, 1.38),
        (1.05, 1.08, 1.12),
        (1.20, 1.23, 1.28),
        (0.95, 1.0),
        (1.45, 1.47, 1.5),
        0.0006,
    ),
    Weather.HAZE: _Sky(
        (22.0, 45.0),
        (1.5, 1.35, 1.12),
        0.008,
        (0.85, 0.95, 1.10),
        (1.45, 1.45, 1.40),
        (0.85, 0.87, 0.88),
        (0.3, 0.6),
        (1.5, 1.5, 1.45),
        0.0065,
    ),
    Weather.WET: _Sky(
        (30.0, 50.0),
        (0.06, 0.06, 0.06),
        0.3,
        (0.95, 0.98, 1.05),
        (0.85, 0.88, 0.93),
        (0.90, 0.93, 0.98),
        (0.9, 1.0),
        (1.1, 1.12, 1.16),
        0.0013,
        1.0,
    ),
    Weather.DUSK: _Sky(
        (4.0, 9.0),
        (0.50, 0.26, 0.11),
        0.006,
        (0.16, 0.22, 0.40),
        (0.75, 0.52, 0.38),
        (0.24, 0.27, 0.36),
        (0.2, 0.5),
        (0.5, 0.4, 0.38),
        0.0004,
    ),
}


def light_of(look: CameraLook) -> Light:
    """The light of a drive; one seed gives one light."""
    sky = _SKIES[look.weather]
    rng = np.random.default_rng([look.seed, 0x5C1])
    elevation = np.radians(rng.uniform(*sky.elevation_deg))
    azimuth = rng.uniform(0.0, 2 * np.pi)
    warmth = rng.normal(0.0, 0.03)
    power = float(np.exp(rng.normal(0.0, 0.08)))
    sun = (
        sky.sun[0] * power * (1 + warmth),
        sky.sun[1] * power,
        sky.sun[2] * power * (1 - warmth),
    )
    return Light(
        sun_direction=(
            float(np.cos(elevation) * np.cos(azimuth)),
            float(np.cos(elevation) * np.sin(azimuth)),
            float(np.sin(elevation)),
        ),
        sun=sun,
        sun_blur=sky.sun_blur,
        zenith=sky.zenith,
        horizon=sky.horizon,
        ambient=sky.ambient,
        cloud=float(rng.uniform(*sky.cloud)),
        cloud_rgb=sky.cloud_rgb,
        haze_per_m=sky.haze_per_m,
        haze=sky.horizon,
        wet=sky.wet,
        noise_seed=int(rng.integers(1, 2**20)),
    )
