"""CamVid's labels, its own 32 and the eleven classes of SegNet, brought onto the paper's 19."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

CAMVID: Final = "camvid-11"
CAMVID_32: Final = "camvid-32"
CAMVID_VOID_ID: Final = 11
"""In the label images: not one of the eleven classes."""

CAMVID_TO_PAZ2020: Final[Mapping[str, str | None]] = MappingProxyType(
    {
        "sky": "sky",
        "building": "building",
        "pole": "pole",
        "road": "road",
        "pavement": "sidewalk",
        "tree": "vegetation",
        "sign symbol": "traffic sign",
        "fence": None,
        "car": "car",
        "pedestrian": "person",
        "bicyclist": "bicyclist",
    }
)
"""The fate of every label of ``camvid-11``.

Its classes are wider than the names they get: car holds lorries and buses too, building
walls and bridges, sign symbol traffic lights, bicyclist motorcyclists and the cycles
themselves. Road includes the paint, as in Cityscapes.
"""

CAMVID_32_TO_PAZ2020: Final[Mapping[str, str | None]] = MappingProxyType(
    {
        "Animal": None,
        "Archway": "building",
        "Bicyclist": "bicyclist",
        "Bridge": "building",
        "Building": "building",
        "Car": "car",
        "CartLuggagePram": None,
        "Child": "person",
        "Column_Pole": "pole",
        "Fence": None,
        "LaneMkgsDriv": "lane marking",
        "LaneMkgsNonDriv": "lane marking",
        "Misc_Text": None,
        "MotorcycleScooter": "motorcycle",
        "OtherMoving": None,
        "ParkingBlock": None,
        "Pedestrian": "person",
        "Road": "road",
        "RoadShoulder": None,
        "Sidewalk": "sidewalk",
        "SignSymbol": "traffic sign",
        "Sky": "sky",
        "SUVPickupTruck": "car",
        "TrafficCone": None,
        "TrafficLight": None,
        "Train": None,
        "Tree": "vegetation",
        "Truck_Bus": None,
        "Tunnel": None,
        "VegetationMisc": "vegetation",
        "Void": None,
        "Wall": None,
    }
)
"""The fate of every label of ``camvid-32``, the one form of CamVid that has paint.

Its paint holds crosswalks too. Lorries and buses are one label there, and dropped.
"""
