"""A vector map in another city frame."""

from __future__ import annotations

from hdmap_tools.errors import CRSMismatchError
from hdmap_tools.formats.records import map_geometry
from hdmap_tools.geometry.map_frame import MapFrame
from hdmap_tools.map_model.vector_map import VectorMap


def reproject(vector_map: VectorMap, frame: MapFrame) -> VectorMap:
    """The same map in another frame, through WGS84; unchanged if the frame is its own.

    Raises:
        NoOriginError: If one of two different frames has no place on earth.
        CRSMismatchError: If their heights refer to different things, or the map lies
            where the new frame has no coordinates.
    """
    old = vector_map.frame
    if old == frame:
        return vector_map
    _ = (old.crs, frame.crs)
    if old.vertical_datum != frame.vertical_datum:
        raise CRSMismatchError(
            f"Heights above {old.vertical_datum!r} cannot be turned into heights above "
            f"{frame.vertical_datum!r}; give a frame with the map's vertical datum."
        )
    moved = []
    for element in vector_map:
        geometry = map_geometry(element.geometry, lambda c: frame.from_wgs84(old.to_wgs84(c)))
        moved.append(element.model_copy(update={"geometry": geometry}))
    return VectorMap(frame, tuple(moved), vector_map.provenance)
