"""What things are made of: label, colour, and what a lidar sees of them. One table for all sensors."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Final


class Mat(IntEnum):
    """Materials; ids of triangles and of the cells of the surface raster (uint8)."""

    GROUND = 0  # of triangles only: look the cell of the surface raster up
    ASPHALT = 1
    ASPHALT_PATCH = 2
    CONCRETE_ROAD = 3
    PAINT_WHITE = 4
    PAINT_YELLOW = 5
    ZEBRA_PAINT = 6
    ZEBRA_GAP = 7
    STOP_PAINT = 8
    SYMBOL_PAINT = 9
    MANHOLE = 10
    KERB = 11
    SIDEWALK = 12
    GRASS = 13
    SOIL = 14
    GRAVEL = 15
    BUILDING_PLASTER = 20
    BUILDING_BRICK = 21
    BUILDING_CONCRETE = 22
    WINDOW = 23
    ROOF = 24
    FENCE = 25
    WALL = 26
    GUARD_RAIL = 27
    FOLIAGE = 30
    TRUNK = 31
    HEDGE = 32
    POLE = 33
    SIGN = 34
    SIGN_BACK = 35
    TRAFFIC_LIGHT = 36
    CAR_BODY_WHITE = 40
    CAR_BODY_BLACK = 41
    CAR_BODY_RED = 42
    CAR_BODY_BLUE = 43
    CAR_BODY_GREY = 44
    CAR_GLASS = 45
    TYRE = 46
    TRUCK_BODY = 47
    BUS_BODY = 48
    LIGHT_RED = 49
    SKIN = 50
    CLOTHES_DARK = 51
    CLOTHES_BRIGHT = 52
    BICYCLE = 53
    TRUCK_GLASS = 54
    TRUCK_TYRE = 55
    BUS_GLASS = 56
    SKY = 255  # no hit


@dataclass(frozen=True)
class Material:
    """How one material looks.

    Attributes:
        label: Name in the label set ``paz2020``.
        albedo: Linear sRGB reflectance, red, green, blue, 0..1.
        texture: Relative amplitude of the fine variation of albedo (one sigma).
        reflectivity: Of the lidar's near infrared at normal incidence, 0..1; above 1
            for retroreflective sheeting.
        is_retroreflective: Whether intensity keeps up at grazing angles (paint with
            glass beads, signs).
    """

    label: str
    albedo: tuple[float, float, float]
    texture: float = 0.05
    reflectivity: float = 0.2
    is_retroreflective: bool = False


MATERIALS: Final[dict[Mat, Material]] = {
    Mat.ASPHALT: Material("road", (0.105, 0.105, 0.110), 0.12, 0.12),
    Mat.ASPHALT_PATCH: Material("road", (0.065, 0.065, 0.070), 0.10, 0.08),
    Mat.CONCRETE_ROAD: Material("road", (0.30, 0.29, 0.27), 0.08, 0.25),
    Mat.PAINT_WHITE: Material("lane marking", (0.62, 0.62, 0.60), 0.08, 0.55, True),
    Mat.PAINT_YELLOW: Material("lane marking", (0.58, 0.40, 0.06), 0.08, 0.45, True),
    Mat.ZEBRA_PAINT: Material("crosswalk", (0.60, 0.60, 0.58), 0.08, 0.52, True),
    Mat.ZEBRA_GAP: Material("crosswalk", (0.105, 0.105, 0.110), 0.12, 0.12),
    Mat.STOP_PAINT: Material("lane marking", (0.62, 0.62, 0.60), 0.08, 0.55, True),
    Mat.SYMBOL_PAINT: Material("lane marking", (0.62, 0.62, 0.60), 0.08, 0.55, True),
    Mat.MANHOLE: Material("manhole", (0.13, 0.12, 0.11), 0.15, 0.10),
    Mat.KERB: Material("curb", (0.34, 0.33, 0.31), 0.08, 0.28),
    Mat.SIDEWALK: Material("sidewalk", (0.27, 0.25, 0.23), 0.10, 0.24),
    Mat.GRASS: Material("vegetation", (0.07, 0.13, 0.035), 0.30, 0.35),
    Mat.SOIL: Material("vegetation", (0.16, 0.12, 0.08), 0.20, 0.22),
    Mat.GRAVEL: Material("sidewalk", (0.30, 0.28, 0.25), 0.25, 0.24),
    Mat.BUILDING_PLASTER: Material("building", (0.48, 0.43, 0.36), 0.06, 0.35),
    Mat.BUILDING_BRICK: Material("building", (0.25, 0.11, 0.07), 0.12, 0.28),
    Mat.BUILDING_CONCRETE: Material("building", (0.33, 0.33, 0.33), 0.06, 0.30),
    Mat.WINDOW: Material("building", (0.05, 0.07, 0.09), 0.02, 0.05),
    Mat.ROOF: Material("building", (0.22, 0.09, 0.06), 0.10, 0.20),
    Mat.FENCE: Material("building", (0.22, 0.22, 0.20), 0.10, 0.25),
    Mat.WALL: Material("building", (0.36, 0.33, 0.29), 0.10, 0.28),
    Mat.GUARD_RAIL: Material("building", (0.45, 0.45, 0.45), 0.04, 0.40),
    Mat.FOLIAGE: Material("vegetation", (0.05, 0.11, 0.03), 0.35, 0.35),
    Mat.TRUNK: Material("vegetation", (0.11, 0.08, 0.055), 0.20, 0.25),
    Mat.HEDGE: Material("vegetation", (0.045, 0.095, 0.03), 0.35, 0.35),
    Mat.POLE: Material("pole", (0.25, 0.26, 0.26), 0.05, 0.30),
    Mat.SIGN: Material("traffic sign", (0.65, 0.62, 0.60), 0.03, 2.5, True),
    Mat.SIGN_BACK: Material("traffic sign", (0.35, 0.35, 0.35), 0.03, 0.30),
    Mat.TRAFFIC_LIGHT: Material("pole", (0.05, 0.05, 0.05), 0.03, 0.10),
    Mat.CAR_BODY_WHITE: Material("car", (0.65, 0.65, 0.65), 0.02, 0.50),
    Mat.CAR_BODY_BLACK: Material("car", (0.02, 0.02, 0.025), 0.02, 0.06),
    Mat.CAR_BODY_RED: Material("car", (0.35, 0.03, 0.03), 0.02, 0.40),
    Mat.CAR_BODY_BLUE: Material("car", (0.04, 0.08, 0.28), 0.02, 0.25),
    Mat.CAR_BODY_GREY: Material("car", (0.25, 0.26, 0.27), 0.02, 0.30),
    Mat.CAR_GLASS: Material("car", (0.03, 0.04, 0.05), 0.01, 0.04),
    Mat.TYRE: Material("car", (0.02, 0.02, 0.02), 0.05, 0.05),
    Mat.TRUCK_BODY: Material("truck", (0.45, 0.44, 0.40), 0.03, 0.40),
    Mat.TRUCK_GLASS: Material("truck", (0.03, 0.04, 0.05), 0.01, 0.04),
    Mat.TRUCK_TYRE: Material("truck", (0.02, 0.02, 0.02), 0.05, 0.05),
    Mat.BUS_BODY: Material("bus", (0.50, 0.42, 0.10), 0.03, 0.40),
    Mat.BUS_GLASS: Material("bus", (0.03, 0.04, 0.05), 0.01, 0.04),
    Mat.LIGHT_RED: Material("car", (0.45, 0.02, 0.02), 0.02, 0.80),
    Mat.SKIN: Material("person", (0.40, 0.26, 0.19), 0.05, 0.40),
    Mat.CLOTHES_DARK: Material("person", (0.05, 0.05, 0.07), 0.10, 0.15),
    Mat.CLOTHES_BRIGHT: Material("person", (0.40, 0.32, 0.22), 0.10, 0.40),
    Mat.BICYCLE: Material("bicycle", (0.10, 0.10, 0.10), 0.05, 0.20),
    Mat.SKY: Material("sky", (0.0, 0.0, 0.0), 0.0, 0.0),
}
"""Albedo: typical values of broadband and visible reflectance of urban materials
(asphalt 0.05 to 0.15, worn concrete 0.25 to 0.35, fresh paint 0.6 to 0.8)."""
