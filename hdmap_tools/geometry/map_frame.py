"""Where the city frame lies on earth."""

from __future__ import annotations

import reprlib
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from hdmap_tools.errors import CRSMismatchError, FormatError, NoOriginError, ShapeError
from hdmap_tools.types import NDArrayFloat

if TYPE_CHECKING:
    from pyproj import CRS, Transformer

CITY_CRS_NAME: Final = "hdmap city frame"
"""Name of a projection made on an origin, as QGIS shows it; PROJ alone calls it "unknown"."""


@dataclass(frozen=True)
class MapFrame:
    """The local metric frame ``city`` (x east, y north, z up) and its place on earth.

    A city point is a point of ``crs`` minus ``offset_m``. Without a CRS the map
    lives in metres only, and geographic exports raise `NoOriginError`.

    Attributes:
        crs_wkt: WKT of a projected CRS in metres, or None.
        offset_m: (x, y, z) of the city origin in that CRS and above the vertical
            datum, metres.
        vertical_datum: What heights refer to; ``WGS84`` is the ellipsoid.
    """

    crs_wkt: str | None = None
    offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    vertical_datum: str = "WGS84"

    def __post_init__(self) -> None:
        if len(self.offset_m) != 3 or not np.isfinite(self.offset_m).all():
            raise ShapeError(f"offset_m must be three finite metres, found {self.offset_m}.")
        if self.crs_wkt is not None:
            if not self.crs.is_projected:
                raise CRSMismatchError(
                    f"A map frame needs a projected CRS in metres, found {self.crs.name!r} "
                    f"({self.crs.type_name}); use MapFrame.from_origin for a latitude and longitude."
                )
            units = {axis.unit_name for axis in self.crs.axis_info[:2]}
            if units != {"metre"}:
                raise CRSMismatchError(
                    f"A map frame needs a CRS in metres, found {self.crs.name!r} in {sorted(units)}."
                )

    @classmethod
    def from_origin(
        cls, lat_deg: float, lon_deg: float, alt_m: float = 0.0, vertical_datum: str = "WGS84"
    ) -> MapFrame:
        """A transverse Mercator with scale 1 on the origin, which becomes city (0, 0, 0)."""
        from pyproj import CRS

        if not (-85.0 <= lat_deg <= 85.0 and -180.0 <= lon_deg <= 180.0):
            raise NoOriginError(
                f"Origin latitude {lat_deg}, longitude {lon_deg} is not usable: expected latitude "
                "-85..85 and longitude -180..180 degrees, in this order."
            )
        unnamed = CRS.from_proj4(
            # float(): the repr of a numpy number is not a number to PROJ.
            f"+proj=tmerc +lat_0={float(lat_deg)!r} +lon_0={float(lon_deg)!r} +k=1 +x_0=0 +y_0=0 "
            "+datum=WGS84 +units=m +no_defs"
        )
        crs = CRS.from_json_dict({**unnamed.to_json_dict(), "name": CITY_CRS_NAME})
        return cls(crs.to_wkt(), (0.0, 0.0, float(alt_m)), vertical_datum)

    @classmethod
    def from_crs(
        cls, crs: Any, origin_lat_lon: tuple[float, float] | None = None, alt_m: float = 0.0
    ) -> MapFrame:
        """Any projected CRS of pyproj; the city origin is put at a latitude and longitude."""
        from pyproj import CRS
        from pyproj.exceptions import CRSError

        try:
            wkt = CRS.from_user_input(crs).to_wkt()
        except CRSError as error:
            raise CRSMismatchError(
                f"{crs!r} is no coordinate reference system that pyproj knows: {error}"
            ) from error
        if origin_lat_lon is None:
            return cls(wkt, (0.0, 0.0, alt_m))
        x, y = cls(wkt)._from_wgs84.transform(origin_lat_lon[1], origin_lat_lon[0])
        return cls(wkt, (float(x), float(y), alt_m))

    @classmethod
    def from_json(cls, document: dict[str, Any]) -> MapFrame:
        """From what `to_json` gave."""
        try:
            x, y, z = document["offset_m"]
            wkt, datum = document["crs_wkt"], document["vertical_datum"]
            offset_m = float(x), float(y), float(z)
        except (KeyError, TypeError, ValueError) as error:
            raise FormatError(
                "A map frame needs crs_wkt, offset_m (three metres) and vertical_datum, found "
                f"{reprlib.repr(document)}."
            ) from error
        return cls(wkt, offset_m, datum)

    def to_json(self) -> dict[str, Any]:
        """A plain document that `from_json` reads back."""
        return {
            "crs_wkt": self.crs_wkt,
            "offset_m": list(self.offset_m),
            "vertical_datum": self.vertical_datum,
        }

    @cached_property
    def crs(self) -> CRS:
        """The projected CRS.

        Raises:
            NoOriginError: If the frame has none.
            CRSMismatchError: If its WKT cannot be read.
        """
        from pyproj import CRS
        from pyproj.exceptions import CRSError

        if self.crs_wkt is None:
            raise NoOriginError(
                "The map has no origin on earth, so it cannot be written in a geographic format; "
                "give one with --origin LAT,LON[,ALT]."
            )
        try:
            return CRS.from_wkt(self.crs_wkt)
        except CRSError as error:
            raise CRSMismatchError(
                f"The map frame's CRS is not WKT that pyproj reads: {reprlib.repr(self.crs_wkt)}."
            ) from error

    @property
    def is_georeferenced(self) -> bool:
        """Whether the frame's place on earth is known."""
        return self.crs_wkt is not None

    @cached_property
    def _to_wgs84(self) -> Transformer:
        from pyproj import Transformer

        return Transformer.from_crs(self.crs, "EPSG:4326", always_xy=True)

    @cached_property
    def _from_wgs84(self) -> Transformer:
        from pyproj import Transformer

        return Transformer.from_crs("EPSG:4326", self.crs, always_xy=True)

    def to_wgs84(self, points_city: NDArrayFloat) -> NDArrayFloat:
        """City points (N, 3), metres, to (N, 3) longitude, latitude (degrees) and height (metres)."""
        points = _checked(points_city) + self.offset_m
        lon, lat = self._to_wgs84.transform(points[:, 0], points[:, 1])
        return self._finite(np.column_stack([lon, lat, points[:, 2]]), points_city)

    def from_wgs84(self, lon_lat_height: NDArrayFloat) -> NDArrayFloat:
        """Longitude, latitude (degrees) and height (metres), (N, 3), to city points (N, 3)."""
        geographic = _checked(lon_lat_height)
        x, y = self._from_wgs84.transform(geographic[:, 0], geographic[:, 1])
        return self._finite(np.column_stack([x, y, geographic[:, 2]]), geographic) - self.offset_m

    def _finite(self, result: NDArrayFloat, given: NDArrayFloat) -> NDArrayFloat:
        # PROJ answers inf for what lies outside a projection, and for NaN.
        bad = np.flatnonzero(~np.isfinite(result).all(axis=1))
        if len(bad):
            raise CRSMismatchError(
                f"{len(bad)} points have no place in {self.crs.name!r}, the first is "
                f"{np.asarray(given)[bad[0]].tolist()}; expected finite coordinates within its area."
            )
        return result

    def require_same(self, other: MapFrame) -> None:
        """Raise `CRSMismatchError` unless the other frame is this one."""
        same_crs = self.crs_wkt == other.crs_wkt or (
            self.crs_wkt is not None and other.crs_wkt is not None and self.crs == other.crs
        )
        same_offset = np.allclose(self.offset_m, other.offset_m, rtol=0, atol=1e-6)
        same_datum = self.crs_wkt is None or self.vertical_datum == other.vertical_datum
        if not (same_crs and same_offset and same_datum):
            one, two = self.describe(), other.describe()
            if one == two:  # they differ by less than people are shown
                one, two = self.describe(decimals=12), other.describe(decimals=12)
            raise CRSMismatchError(f"Two frames were mixed: {one} and {two}.")

    def describe(self, decimals: int = 6) -> str:
        """One line for people.

        Args:
            decimals: Of degrees (6 are 0.1 m); metres get half as many.
        """
        shift = ", ".join(f"{v:.{decimals // 2}f}" for v in self.offset_m)
        if self.crs_wkt is None:
            moved = f" shifted by ({shift})" if any(self.offset_m) else ""
            return "local metres without an origin" + moved
        moved = f" with city origin at ({shift})" if any(self.offset_m) else ""
        return f"{self._projection(decimals)}{moved}, heights above {self.vertical_datum}"

    def _projection(self, decimals: int) -> str:
        """The name of the CRS; of a projection made on an origin, what it is and where."""
        if self.crs.name not in (CITY_CRS_NAME, "unknown"):
            return self.crs.name
        operation = self.crs.coordinate_operation
        values = {p.name: float(p.value) for p in operation.params} if operation else {}
        lat = values.get("Latitude of natural origin")
        lon = values.get("Longitude of natural origin")
        method = operation.method_name if operation else "unnamed projection"
        if lat is None or lon is None:
            return method
        method = "transverse Mercator" if method == "Transverse Mercator" else method
        return f"{method} at latitude {lat:.{decimals}f}, longitude {lon:.{decimals}f}"


def _checked(points: NDArrayFloat) -> NDArrayFloat:
    points = np.asarray(points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise ShapeError(f"Points must be (N, 3), found {points.shape}.")
    return points
