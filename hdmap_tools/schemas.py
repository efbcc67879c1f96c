"""JSON Schemas of the files that users write and read, generated from the typed models.

``python -m hdmap_tools.schemas schemas`` (or ``make schemas``) writes the folder
``schemas/``; a test holds the files there equal to what `generate` gives. They are
JSON Schema draft 2020-12. What a schema cannot say (rings that close, ids used
once), the readers check.
"""

from __future__ import annotations

import json
import logging
import sys
from pathlib import Path
from typing import Any, Final, Literal

from pydantic import BaseModel

from hdmap_tools.compare.mask_file import MaskSidecar
from hdmap_tools.compare.paper import PaperScores
from hdmap_tools.compare.raster import RasterComparison
from hdmap_tools.compare.reliability import ReliabilityReport
from hdmap_tools.config import SCHEMA_VERSION, Config
from hdmap_tools.formats.atomic import atomic_output
from hdmap_tools.formats.records import METADATA_VERSION
from hdmap_tools.fusion.intensity_likelihood import IntensityDocument
from hdmap_tools.labels.label_set import LabelSet
from hdmap_tools.map_model.elements import ELEMENT_TYPES, MapElement
from hdmap_tools.point_map.point_map import POINT_MAP_VERSION, PointMapMeta
from hdmap_tools.run_metrics import RunMetrics
from hdmap_tools.segmentation.confusion import ConfusionDocument
from hdmap_tools.segmentation.segmenter import ModelProfile

logger = logging.getLogger(__name__)

DIALECT: Final = "https://json-schema.org/draft/2020-12/schema"

_Mode = Literal["validation", "serialization"]

_MODELS: Final[tuple[tuple[str, type[BaseModel], int, _Mode], ...]] = (
    # What people write is described as it is accepted, what we write as it is written.
    ("config", Config, SCHEMA_VERSION, "validation"),
    ("label_set", LabelSet, 1, "validation"),
    ("model_profile", ModelProfile, 1, "validation"),
    ("confusion_matrix", ConfusionDocument, 1, "validation"),
    ("intensity_likelihood", IntensityDocument, 1, "validation"),
    ("mask", MaskSidecar, 1, "validation"),
    ("point_map", PointMapMeta, POINT_MAP_VERSION, "validation"),
    ("raster_comparison", RasterComparison, 1, "serialization"),
    ("paper_scores", PaperScores, 1, "serialization"),
    ("reliability", ReliabilityReport, 1, "serialization"),
    ("run_metrics", RunMetrics, 1, "serialization"),
)


def generate() -> dict[str, str]:
    """All schemas: text by file name, the same on every run."""
    schemas = {
        name: _identified(name, version, model.model_json_schema(mode=mode))
        for name, model, version, mode in _MODELS
    }
    schemas["map_geojson"] = _identified("map_geojson", METADATA_VERSION, _map_geojson())
    return {
        f"{name}.schema.json": json.dumps(schema, indent=2, sort_keys=True, ensure_ascii=False)
        + "\n"
        for name, schema in sorted(schemas.items())
    }


def write(folder: Path) -> None:
    """Write all schemas into a folder, and remove those that no model stands behind any more.

    Raises:
        FormatError: If the folder does not exist or cannot be written to.
    """
    schemas = generate()
    for name, text in schemas.items():
        with atomic_output(folder / name, overwrite=True) as temporary:
            temporary.write_text(text, encoding="utf-8", newline="\n")
    for path in sorted(folder.glob("*.schema.json")):
        if path.name not in schemas:
            path.unlink()
            logger.info("removed %s", path)
    logger.info("wrote %d schemas to %s", len(schemas), folder)


def _identified(name: str, version: int, schema: dict[str, Any]) -> dict[str, Any]:
    return {
        "$schema": DIALECT,
        "$id": f"urn:hdmap-tools:schema:{name}:{version}",
        "schema_version": version,
        **schema,
    }


def _map_geojson() -> dict[str, Any]:
    """A FeatureCollection (RFC 7946) with one kind of feature for each element type.

    Coordinates are longitude, latitude (degrees, WGS84) and height (metres): always
    3D, though the RFC leaves the height open, because map elements are 3D.
    """
    definitions: dict[str, Any] = dict(_SHARED_DEFINITIONS)
    for element_type in ELEMENT_TYPES:
        definitions[f"{element_type.__name__}Feature"] = _feature(element_type, definitions)
    # A chain of if/then, not oneOf: a bad feature is then reported by its own
    # type's rules instead of "matches none of nine".
    feature = {
        "type": "object",
        "required": ["type", "properties", "geometry"],
        "properties": {
            "properties": {
                "type": "object",
                "required": ["element_type"],
                "properties": {
                    "element_type": {"enum": [t.element_type for t in ELEMENT_TYPES]},
                },
            },
        },
        "allOf": [
            {
                "if": {
                    "properties": {
                        "properties": {
                            "properties": {"element_type": {"const": t.element_type}},
                            "required": ["element_type"],
                        }
                    }
                },
                "then": {"$ref": f"#/$defs/{t.__name__}Feature"},
            }
            for t in ELEMENT_TYPES
        ],
    }
    return {
        "title": "HD map as GeoJSON",
        "type": "object",
        "required": ["type", "features"],
        "properties": {
            "type": {"const": "FeatureCollection"},
            "features": {"type": "array", "items": {"$ref": "#/$defs/Feature"}},
            "bbox": {"$ref": "#/$defs/Bbox"},
            "hdmap_tools": {
                "description": "City frame and provenance of the map.",
                "type": "object",
                "required": ["format_version", "frame", "provenance"],
                "properties": {
                    "format_version": {"const": METADATA_VERSION},
                    "frame": {"$ref": "#/$defs/Frame"},
                    "provenance": {"type": "object"},
                },
            },
            # RFC 7946, section 4: longitude and latitude are WGS84 and nothing else.
            "crs": False,
        },
        "$defs": {"Feature": feature, **definitions},
    }


def _feature(element_type: type[MapElement], definitions: dict[str, Any]) -> dict[str, Any]:
    """Schema of one element type's feature; shared definitions are added to ``definitions``."""
    properties = element_type.model_json_schema(
        mode="serialization", ref_template="#/$defs/{model}"
    )
    for name, definition in properties.pop("$defs", {}).items():
        if definitions.setdefault(name, definition) != definition:
            raise ValueError(f"two models named {name} describe different things")
    # Pydantic leaves the geometry out, because elements exclude it when they are dumped.
    assert "geometry" not in properties["properties"], element_type
    properties["properties"] = {
        "element_type": {"const": element_type.element_type},
        **properties["properties"],
        "id": {"title": "Id", "type": "string", "minLength": 1},
    }
    required = set(properties.get("required", ())) - {"geometry"}
    properties["required"] = sorted({"element_type", "id"} | required)
    return {
        "type": "object",
        "required": ["type", "properties", "geometry"],
        "properties": {
            "type": {"const": "Feature"},
            "id": {"type": "string", "minLength": 1},
            "bbox": {"$ref": "#/$defs/Bbox"},
            "properties": properties,
            "geometry": {"$ref": f"#/$defs/{element_type.geometry_type}"},
        },
    }


_SHARED_DEFINITIONS: Final[dict[str, Any]] = {
    "Frame": {
        "description": "The city frame: a point of the CRS minus the offset, in metres.",
        "type": "object",
        "required": ["crs_wkt", "offset_m", "vertical_datum"],
        "properties": {
            "crs_wkt": {"type": ["string", "null"]},
            "offset_m": {
                "type": "array",
                "items": {"type": "number"},
                "minItems": 3,
                "maxItems": 3,
            },
            "vertical_datum": {"type": "string"},
        },
        "additionalProperties": False,
    },
    "Position": {
        "description": "Longitude and latitude in degrees (WGS84), height in metres.",
        "type": "array",
        "prefixItems": [
            {"type": "number", "minimum": -180, "maximum": 180},
            {"type": "number", "minimum": -90, "maximum": 90},
            {"type": "number"},
        ],
        "minItems": 3,
        "maxItems": 3,
    },
    "LineString": {
        "type": "object",
        "required": ["type", "coordinates"],
        "properties": {
            "type": {"const": "LineString"},
            "coordinates": {
                "type": "array",
                "items": {"$ref": "#/$defs/Position"},
                "minItems": 2,
            },
            "bbox": {"$ref": "#/$defs/Bbox"},
        },
    },
    "Polygon": {
        "type": "object",
        "required": ["type", "coordinates"],
        "properties": {
            "type": {"const": "Polygon"},
            "coordinates": {
                "type": "array",
                "items": {
                    "type": "array",
                    "items": {"$ref": "#/$defs/Position"},
                    "minItems": 4,
                },
                "minItems": 1,
            },
            "bbox": {"$ref": "#/$defs/Bbox"},
        },
    },
    "Bbox": {
        "description": "West, south, (lowest,) east, north(, highest).",
        "type": "array",
        "items": {"type": "number"},
        "oneOf": [{"minItems": 4, "maxItems": 4}, {"minItems": 6, "maxItems": 6}],
    },
}


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    write(Path(sys.argv[1] if len(sys.argv) > 1 else "schemas"))
