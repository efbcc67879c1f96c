"""Camera images of a scene with their true labels and depth."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Final
from weakref import WeakKeyDictionary

import numpy as np

from hdmap_tools.errors import CalibrationError
from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.geometry.se3 import SE3
from hdmap_tools.labels.label_set import load_label_set
from hdmap_tools.simulate.ground_texture import GroundTexture, ground_texture
from hdmap_tools.simulate.image_formation import form_image
from hdmap_tools.simulate.light import CameraLook, Light, light_of
from hdmap_tools.simulate.materials import MATERIALS, Mat
from hdmap_tools.simulate.ray_caster import Hits, RayCaster
from hdmap_tools.simulate.scene import label_ids_by_material
from hdmap_tools.types import NDArrayByte, NDArrayFloat32

LABEL_SET: Final = "paz2020"

_SKY_REACH: Final = 2.5
"""Lengths of rays to the sky, which are 0 to 2 m each: what is further away hides little of it."""

_textures: WeakKeyDictionary[RayCaster, GroundTexture] = WeakKeyDictionary()


@dataclass(frozen=True, eq=False)
class CameraImage:
    """One image and the truth about it.

    Attributes:
        rgb: (h, w, 3) uint8 sRGB.
        labels: (h, w) uint8 ids of the label set ``paz2020``: of what the ray through the
            pixel's centre hits.
        depth_m: (h, w) float32 along the optical axis; infinite in the sky.
    """

    rgb: NDArrayByte
    labels: NDArrayByte
    depth_m: NDArrayFloat32


def render_image(
    caster: RayCaster,
    camera: PinholeCamera,
    city_SE3_ego: SE3,
    time_s: float,
    look: CameraLook,
    rng_seed: int,
) -> CameraImage:
    """What a camera sees, and what is truly there.

    Args:
        caster: The scene.
        camera: Rectified: its image is that of a pinhole.
        city_SE3_ego: True pose at the image's time.
        time_s: Seconds of the drive.
        look: Weather and quality of the camera, the same for all images of a drive.
        rng_seed: Of this image: exposure, white balance, noise.

    Raises:
        CalibrationError: If the camera has distortion.
    """
    rays = camera_rays(caster, camera, city_SE3_ego)
    hits = caster.cast_rays(rays, time_s)
    shape = (camera.height_px, camera.width_px)
    light = light_of(look)
    linear = _shaded(caster, camera, rays, hits, light, time_s).reshape(*shape, 3)
    return CameraImage(
        rgb=form_image(linear, look, np.random.default_rng(rng_seed)),
        labels=_label_table()[hits.material].reshape(shape),
        depth_m=hits.t.reshape(shape),
    )


def prepare_textures(caster: RayCaster) -> GroundTexture:
    """The ground's texture of a scene, made once; else its first image makes it."""
    texture = _textures.get(caster)
    if texture is None:
        texture = _textures[caster] = ground_texture(caster.scene.surface)
    return texture


def camera_rays(caster: RayCaster, camera: PinholeCamera, city_SE3_ego: SE3) -> NDArrayFloat32:
    """Rays (h * w, 6) float32 through the pixel centres, row by row, from the scene's origin.

    Directions have length one along the optical axis, so that `Hits.t` is the depth.
    """
    from hdmap_tools.simulate.compiled import in_bands
    from hdmap_tools.simulate.ray_kernels import pixel_rays

    if camera.is_distorted:
        raise CalibrationError(
            f"Camera {camera.name} has distortion {camera.distortion}; simulated images are "
            "rectified: expected five zeros."
        )
    city_SE3_cam = city_SE3_ego @ camera.ego_SE3_cam
    intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    origin = city_SE3_cam.translation - caster.scene.origin_city
    rotation = np.array(city_SE3_cam.rotation)
    count = camera.width_px * camera.height_px
    rays = np.empty((count, 6), np.float32)
    in_bands(
        lambda first, last: pixel_rays(
            first, last, camera.width_px, intrinsics, rotation, origin, rays
        ),
        count,
    )
    return rays


def _shaded(
    caster: RayCaster,
    camera: PinholeCamera,
    rays: NDArrayFloat32,
    hits: Hits,
    light: Light,
    time_s: float,
) -> NDArrayFloat32:
    from hdmap_tools.simulate.compiled import ENOUGH_ROWS, in_bands
    from hdmap_tools.simulate.shading import shade

    texture = prepare_textures(caster)
    answers, amplitudes = _answers()
    sunlight = _sunlight(caster, camera, rays, hits, light, time_s)
    open_sky = _open_sky(caster, camera, rays, hits, light, time_s)
    surface = caster.scene.surface
    image = np.empty((len(rays), 3), np.float32)

    def shade_band(first: int, last: int) -> None:
        shade(
            first,
            last,
            camera.width_px,
            rays,
            hits.t,
            hits.material,
            hits.normal,
            hits.on_ground,
            sunlight,
            open_sky,
            caster.scene.origin_city,
            camera.fx,
            answers,
            amplitudes,
            surface.codes,
            surface.wear,
            texture.albedo,
            texture.cells,
            texture.pyramid,
            texture.level_shapes,
            caster.raster_frame,
            light,
            image,
        )

    in_bands(shade_band, camera.height_px, ENOUGH_ROWS)
    return image


def _sunlight(
    caster: RayCaster,
    camera: PinholeCamera,
    rays: NDArrayFloat32,
    hits: Hits,
    light: Light,
    time_s: float,
) -> NDArrayFloat32:
    """(N,) how much of the sun each hit gets; all of it where shadows are not worth a ray."""
    from hdmap_tools.simulate.compiled import ENOUGH_ROWS, in_bands
    from hdmap_tools.simulate.shadow_kernels import spread_sunlight, sun_rays

    sunlight = np.ones(len(rays), np.float32)
    if max(light.sun) < 0.2:
        return sunlight
    shape = (camera.height_px, camera.width_px)
    asked = np.arange(len(rays)).reshape(shape)[::2, ::2].ravel()
    to_sun = hits.normal[asked] @ np.array(light.sun_direction, np.float32) > 0
    rows = asked[to_sun & (hits.material[asked] != Mat.SKY)]
    towards_sun = np.empty((len(rows), 6), np.float32)
    in_bands(
        lambda first, last: sun_rays(
            first, last, rows, rays, hits.t, hits.normal, light, towards_sun
        ),
        len(rows),
    )
    traced = np.full(len(rays), 2, np.uint8)
    traced[rows] = ~caster.is_blocked(towards_sun, time_s)
    arrays = (
        traced.reshape(shape),
        hits.on_ground.reshape(shape),
        hits.t.reshape(shape),
        hits.normal.reshape(*shape, 3),
        sunlight.reshape(shape),
    )
    in_bands(lambda first, last: spread_sunlight(first, last, *arrays), shape[0], ENOUGH_ROWS)
    return sunlight


def _open_sky(
    caster: RayCaster,
    camera: PinholeCamera,
    rays: NDArrayFloat32,
    hits: Hits,
    light: Light,
    time_s: float,
) -> NDArrayFloat32:
    """(N,) part of the sky that reaches each hit; all of it where the sun casts shadows.

    Without a sun, the dark under a vehicle is all that sets it on the road. A ray for one
    pixel in eight, as far as a few metres, the mean over their neighbourhood.
    """
    import cv2

    from hdmap_tools.simulate.compiled import in_bands
    from hdmap_tools.simulate.shadow_kernels import sky_rays

    if max(light.sun) >= 0.2:
        return np.ones(len(rays), np.float32)
    shape = (camera.height_px, camera.width_px)
    asked = np.zeros(shape, np.float32)
    asked[::4, ::2] = asked[2::4, 1::2] = 1.0
    asked[hits.material.reshape(shape) == Mat.SKY] = 0.0
    rows = np.flatnonzero(asked)
    towards_sky = np.empty((len(rows), 6), np.float32)
    in_bands(
        lambda first, last: sky_rays(
            first, last, rows, rays, hits.t, hits.normal, light.noise_seed, towards_sky
        ),
        len(rows),
    )
    is_open = np.zeros(len(rays), np.float32)
    is_open[rows] = ~caster.is_blocked(towards_sky, time_s, reach_m=_SKY_REACH)
    sums = cv2.blur(is_open.reshape(shape), (13, 13))
    counts = cv2.blur(asked, (13, 13))
    share = np.where(counts > 1e-3, sums / np.maximum(counts, 1e-3), 1.0)
    return np.asarray(0.25 + 0.75 * share, dtype=np.float32).ravel()


@lru_cache(maxsize=1)
def _label_table() -> NDArrayByte:
    names = tuple(label.name for label in load_label_set(LABEL_SET).labels)
    return label_ids_by_material(names)


@lru_cache(maxsize=1)
def _answers() -> tuple[NDArrayByte, NDArrayFloat32]:
    """(256,) how each material answers to light, and (256,) the amplitude of its variation."""
    from hdmap_tools.simulate import shading

    kinds = {
        shading.ASPHALT: (
            Mat.ASPHALT,
            Mat.ASPHALT_PATCH,
            Mat.CONCRETE_ROAD,
            Mat.ZEBRA_GAP,
            Mat.MANHOLE,
        ),
        shading.PAINT: (
            Mat.PAINT_WHITE,
            Mat.PAINT_YELLOW,
            Mat.ZEBRA_PAINT,
            Mat.STOP_PAINT,
            Mat.SYMBOL_PAINT,
        ),
        shading.GLASS: (Mat.WINDOW, Mat.CAR_GLASS, Mat.TRUCK_GLASS, Mat.BUS_GLASS),
        shading.LEAVES: (Mat.FOLIAGE, Mat.HEDGE),
        shading.LAWN: (Mat.GRASS, Mat.SOIL),
        shading.LACQUER: (
            Mat.CAR_BODY_WHITE,
            Mat.CAR_BODY_BLACK,
            Mat.CAR_BODY_RED,
            Mat.CAR_BODY_BLUE,
            Mat.CAR_BODY_GREY,
            Mat.TRUCK_BODY,
            Mat.BUS_BODY,
            Mat.LIGHT_RED,
        ),
        shading.PAVING: (Mat.SIDEWALK, Mat.KERB, Mat.GRAVEL),
        shading.BRICK: (Mat.BUILDING_BRICK,),
    }
    answers = np.full(256, shading.MATTE, np.uint8)
    for kind, mats in kinds.items():
        answers[list(mats)] = kind
    amplitudes = np.zeros(256, np.float32)
    for mat, material in MATERIALS.items():
        amplitudes[mat] = material.texture
    return answers, amplitudes
