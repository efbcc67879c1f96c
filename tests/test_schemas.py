"""The checked-in schemas are the models', and hold for every document there is."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from jsonschema import Draft202012Validator
from pydantic import BaseModel, ValidationError
from shapely.geometry import LineString, Polygon

from hdmap_tools import schemas
from hdmap_tools.compare.raster import RasterComparison, compare_raster
from hdmap_tools.compare.reference import Reference, ReferenceGroup
from hdmap_tools.config import Config, load_config
from hdmap_tools.errors import FormatError
from hdmap_tools.formats.geojson import write_geojson
from hdmap_tools.geometry.map_frame import MapFrame
from hdmap_tools.labels.label_set import LabelSet, MapClass
from hdmap_tools.map_model.elements import (
    ELEMENT_TYPES,
    Crosswalk,
    Lanelet,
    LaneMark,
    MapElement,
    MarkColor,
    MarkStyle,
    RoadBoundary,
)
from hdmap_tools.map_model.vector_map import VectorMap, with_stable_ids
from hdmap_tools.run_metrics import RunMetrics, versions
from hdmap_tools.segmentation.segmenter import ModelProfile
from hdmap_tools.testing.scenes import street_scene

ROOT = Path(__file__).resolve().parents[1]
SCHEMAS = ROOT / "schemas"
PACKAGE = ROOT / "hdmap_tools"
NAMES = sorted(schemas.generate())


def validator(name: str) -> Draft202012Validator:
    return Draft202012Validator(json.loads(schemas.generate()[f"{name}.schema.json"]))


def problems(name: str, document: Any) -> list[str]:
    return [f"{e.json_path}: {e.message}" for e in validator(name).iter_errors(document)]


def as_json(document: Any) -> Any:
    return json.loads(json.dumps(document))


# The files in schemas/


def test_the_folder_holds_the_generated_files_and_no_other() -> None:
    assert sorted(path.name for path in SCHEMAS.glob("*.schema.json")) == NAMES


@pytest.mark.parametrize("name", NAMES)
def test_checked_in_file_is_what_the_models_say(name: str) -> None:
    # Bytes, so that line ends and the last line break count too.
    generated = schemas.generate()[name].encode()
    assert (SCHEMAS / name).read_bytes() == generated, f"{name} is out of date: run `make schemas`"


def test_command_writes_the_same_bytes_in_another_process_and_removes_stale_files(
    tmp_path: Path,
) -> None:
    (tmp_path / "gone.schema.json").write_text("{}")
    (tmp_path / "notes.txt").write_text("stays")
    (tmp_path / NAMES[0]).write_text("old")
    subprocess.run(
        [sys.executable, "-m", "hdmap_tools.schemas", str(tmp_path)],
        check=True,
        env={"PYTHONHASHSEED": "7", "PATH": ""},
        capture_output=True,
    )
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == {
        **{name: text.encode() for name, text in schemas.generate().items()},
        "notes.txt": b"stays",
    }


def test_a_missing_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="does not exist"):
        schemas.write(tmp_path / "none")


@pytest.mark.parametrize("name", NAMES)
def test_schema_is_valid_draft_2020_12(name: str) -> None:
    schema = json.loads((SCHEMAS / name).read_text())
    Draft202012Validator.check_schema(schema)
    assert schema["$schema"] == Draft202012Validator.META_SCHEMA["$id"]


def test_every_schema_has_its_own_id_with_its_version() -> None:
    found = {name: json.loads(text) for name, text in schemas.generate().items()}
    for name, schema in found.items():
        stem, version = name.removesuffix(".schema.json"), schema["schema_version"]
        assert schema["$id"] == f"urn:hdmap-tools:schema:{stem}:{version}"


@pytest.mark.parametrize("name", NAMES)
def test_every_reference_points_into_the_same_file(name: str) -> None:
    # One file is all that anyone needs; nothing is fetched.
    schema = json.loads(schemas.generate()[name])

    def references(node: Any) -> list[str]:
        if isinstance(node, dict):
            own = [node["$ref"]] if isinstance(node.get("$ref"), str) else []
            return own + [r for value in node.values() for r in references(value)]
        return [r for value in node for r in references(value)] if isinstance(node, list) else []

    definitions = schema.get("$defs", {})
    used = {reference.removeprefix("#/$defs/") for reference in references(schema)}
    assert used == set(definitions)


# Documents that exist


def _kind(path: Path, document: Any) -> str:
    """Which schema a shipped document falls under, by what it holds."""
    if path.suffix in {".yaml", ".yml"}:
        return "config"
    members = {
        "features": "map_geojson",
        "counts": "confusion_matrix",
        "labels": "label_set",
        "channels": "model_profile",
        "origin_xy_m": "mask",
        "groups": "raster_comparison",
        "comparisons": "run_metrics",
    }
    for member, kind in members.items():
        if member in document:
            return kind
    pytest.fail(f"no schema is known for {path.relative_to(ROOT)}; extend schemas.py and this list")


def _shipped() -> list[Path]:
    patterns = [
        (ROOT / "examples", "**/*.yaml"),
        (ROOT / "examples", "**/*.yml"),
        (ROOT / "examples", "**/*.json"),
        (ROOT / "examples", "**/*.geojson"),
        (PACKAGE, "**/*.json"),
        (PACKAGE, "**/*.yaml"),
    ]
    found = sorted(path for folder, pattern in patterns for path in folder.glob(pattern))
    # How a network was made is a record for people; no program reads it.
    return [path for path in found if not path.name.endswith(".recipe.json")]


@pytest.mark.parametrize("path", _shipped(), ids=lambda p: p.relative_to(ROOT).as_posix())
def test_shipped_document_validates(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    document = yaml.safe_load(text) if path.suffix in {".yaml", ".yml"} else json.loads(text)
    assert problems(_kind(path, document), document) == []


def test_label_sets_and_profiles_are_among_the_shipped_documents() -> None:
    # Guards the test above against a moved folder.
    found = [path.parent.name for path in _shipped()]
    assert found.count("sets") >= 5
    assert found.count("profiles") >= 1


def test_the_default_configuration_validates(tmp_path: Path) -> None:
    text = Config().to_yaml()
    assert problems("config", yaml.safe_load(text)) == []
    (tmp_path / "hdmap.yaml").write_text(text)
    assert load_config(tmp_path / "hdmap.yaml") == Config()


def _comparison() -> RasterComparison:
    window = street_scene()
    road = window.probability("road") > 0.5
    reference = Reference(
        window.grid,
        (ReferenceGroup("road", (MapClass.ROAD,), road),),
        np.ones(window.grid.shape, dtype=bool),
        "truth",
        "drawn",
    )
    return compare_raster(window, reference)


def test_a_raster_comparison_validates() -> None:
    comparison = _comparison()
    document = json.loads(comparison.to_json())
    assert comparison.num_cells > 0
    assert problems("raster_comparison", document) == []
    for member in RasterComparison.model_fields:
        if RasterComparison.model_fields[member].is_required():
            assert problems("raster_comparison", {k: document[k] for k in document if k != member})


def test_run_metrics_validate() -> None:
    metrics = RunMetrics(
        drive="nuscenes:scene-0061",
        model="network",
        association="sparse",
        resolution_m=0.2,
        intensity_threshold=31,
        num_images=6,
        num_images_dropped={"no pose": 1},
        num_observations={"FRONT": 900},
        num_tiles=4,
        num_elements={"lane_mark": 12},
        plugins=[{"name": "lane_mark_skeleton", "version": "0.1.0", "options": {}}],
        failures={},
        comparisons={"sparse": _comparison()},
        seconds={"segmentation": 1.5},
        warnings=("one sweep was truncated",),
        versions=versions(),
    )
    document = json.loads(metrics.to_json())
    assert problems("run_metrics", document) == []
    document["comparisons"]["sparse"]["miou"] = 1.5
    assert problems("run_metrics", document)


# The map as GeoJSON

LINE = LineString([(0, 0, 0), (10, 1, 0.2), (20, 0, 0.1)])
AREA = Polygon(
    [(0, 0, 1), (20, 0, 1), (20, 9, 1), (0, 9, 1)],
    [[(5, 2, 1), (5, 4, 1), (8, 4, 1), (8, 2, 1)]],
)


def _one_of_each() -> tuple[MapElement, ...]:
    extra: dict[type[MapElement], dict[str, Any]] = {
        LaneMark: {"style": MarkStyle.DASHED, "color": MarkColor.WHITE, "width_m": 0.15},
        Lanelet: {"left_id": "a", "right_id": "b", "tags": {"speed_limit": "50"}},
        RoadBoundary: {"is_island": True},
    }
    return tuple(
        t(geometry=LINE if t.geometry_type == "LineString" else AREA, **extra.get(t, {}))
        for t in ELEMENT_TYPES
    )


def _written(elements: tuple[MapElement, ...], folder: Path) -> dict[str, Any]:
    frame = MapFrame.from_origin(49.0, 8.4, 110.0)
    path = folder / "map.geojson"
    provenance = {"plugins": [{"name": "p", "version": "1", "options": {"x": 1.5}}]}
    write_geojson(VectorMap(frame, with_stable_ids(elements), provenance), path, overwrite=True)
    document: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return document


@pytest.fixture
def document(tmp_path: Path) -> dict[str, Any]:
    return _written(_one_of_each(), tmp_path)


def test_a_written_map_of_all_element_types_validates(document: dict[str, Any]) -> None:
    types = {f["properties"]["element_type"] for f in document["features"]}
    assert types == {t.element_type for t in ELEMENT_TYPES}
    assert problems("map_geojson", document) == []


def test_an_empty_written_map_validates(tmp_path: Path) -> None:
    document = _written((), tmp_path)
    assert document["features"] == []
    assert problems("map_geojson", document) == []


@given(
    xs=st.lists(st.integers(-3000, 3000), min_size=2, max_size=6, unique=True),
    ys=st.lists(st.floats(-3000, 3000), min_size=6, max_size=6),
    style=st.sampled_from(list(MarkStyle)),
    width_m=st.none() | st.floats(0.01, 2.0),
    confidence=st.floats(0, 1),
    sigma_m=st.floats(0, 100),
    num_observations=st.integers(0, 2**40),
)
@settings(max_examples=30, deadline=None)
def test_any_written_lane_mark_validates(
    tmp_path_factory: pytest.TempPathFactory, xs: list[int], ys: list[float], **fields: Any
) -> None:
    mark = LaneMark(
        geometry=LineString([(x, y, 0.0) for x, y in zip(xs, ys, strict=False)]), **fields
    )
    document = _written((mark,), tmp_path_factory.mktemp("map"))
    assert problems("map_geojson", document) == []


def _feature(document: dict[str, Any], element_type: type[MapElement]) -> dict[str, Any]:
    return next(
        f
        for f in document["features"]
        if f["properties"]["element_type"] == element_type.element_type
    )


@pytest.mark.parametrize(
    ("where", "value", "complaint"),
    [
        ("type", "Feature", "'FeatureCollection' was expected"),
        ("crs", {"type": "name"}, "False schema does not allow"),
        ("hdmap_tools", {}, "'frame' is a required property"),
        ("feature.type", "feature", "'Feature' was expected"),
        ("feature.id", 7, "7 is not of type 'string'"),
        ("feature.geometry", None, "None is not of type 'object'"),
        ("geometry.type", "Polygon", "'LineString' was expected"),
        ("geometry.coordinates", [[8.4, 49.0, 1.0]], "is too short"),
        ("geometry.coordinates", [[8.4, 49.0], [8.5, 49.0]], "is too short"),
        ("geometry.coordinates", [[8.4, 94.0, 0], [8.5, 49.0, 0]], "greater than the maximum"),
        ("geometry.coordinates", [[8.4, "49", 0], [8.5, 49.0, 0]], "is not of type 'number'"),
        ("properties.element_type", "lane_line", "is not one of"),
        ("properties.element_type", "crosswalk", "were unexpected"),
        ("properties.confidence", 1.5, "greater than the maximum"),
        ("properties.sigma_m", -1, "less than the minimum"),
        ("properties.num_observations", 1.5, "is not of type 'integer'"),
        ("properties.style", "dotted", "is not one of"),
        ("properties.id", "", "non-empty"),
        ("properties.colour", "white", "was unexpected"),
    ],
)
def test_a_wrong_map_is_refused_for_that_reason(
    document: dict[str, Any], where: str, value: Any, complaint: str
) -> None:
    mark = _feature(document, LaneMark)
    targets = {"feature": mark, "geometry": mark["geometry"], "properties": mark["properties"]}
    owner, _, member = where.rpartition(".")
    targets.get(owner, document)[member] = value
    assert any(complaint in p for p in problems("map_geojson", document))


@pytest.mark.parametrize("member", ["type", "features", "feature.properties", "properties.id"])
def test_what_a_map_needs_is_required(document: dict[str, Any], member: str) -> None:
    mark = _feature(document, LaneMark)
    targets = {"feature": mark, "properties": mark["properties"]}
    owner, _, name = member.rpartition(".")
    del targets.get(owner, document)[name]
    assert problems("map_geojson", document)


def test_an_open_triangle_is_no_ring(document: dict[str, Any]) -> None:
    ring = _feature(document, Crosswalk)["geometry"]["coordinates"][0]
    assert len(ring) == 5
    del ring[3:]
    assert any("is too short" in p for p in problems("map_geojson", document))


def test_a_lanelet_without_a_bound_is_refused(document: dict[str, Any]) -> None:
    del _feature(document, Lanelet)["properties"]["left_id"]
    assert any("'left_id' is a required" in p for p in problems("map_geojson", document))


# Schema and model say the same

LABEL = {"id": 0, "name": "road", "color": [1, 2, 3]}


@pytest.mark.parametrize(
    ("name", "model", "document", "is_good"),
    [
        ("config", Config, {}, True),
        ("config", Config, {"schema_version": 2}, False),
        ("config", Config, {"fusion": {"resolution_m": 0.1}}, True),
        ("config", Config, {"fusion": {"resolution_m": 0}}, False),
        ("config", Config, {"fusion": {"resolution": 0.1}}, False),
        ("config", Config, {"fusion": {"intensity_threshold": "auto"}}, True),
        ("config", Config, {"fusion": {"intensity_threshold": "otsu"}}, False),
        ("config", Config, {"fusion": {"intensity_threshold": 256}}, False),
        ("config", Config, {"observation": {"priors": {"road": 0.5}}}, True),
        ("config", Config, {"observation": {"priors": {"grass": 0.5}}}, False),
        ("config", Config, {"observation": {"smoothing": 1}}, False),
        ("config", Config, {"export": {"origin": [49.0, 8.4, 0.0]}}, True),
        ("config", Config, {"export": {"origin": [49.0, 8.4]}}, False),
        ("config", Config, {"export": {"formats": ["shapefile"]}}, False),
        ("config", Config, {"classes": ["road", "lane_mark"]}, True),
        ("config", Config, {"classes": ["car"]}, False),
        ("label_set", LabelSet, {"name": "s", "labels": [LABEL]}, True),
        ("label_set", LabelSet, {"name": "s"}, False),
        ("label_set", LabelSet, {"name": "s", "labels": [LABEL | {"id": 255}]}, False),
        ("label_set", LabelSet, {"name": "s", "labels": [LABEL | {"map_class": "car"}]}, False),
        ("label_set", LabelSet, {"name": "s", "labels": [LABEL | {"color": [1, 2]}]}, False),
        ("model_profile", ModelProfile, {"name": "m", "label_set": "s"}, True),
        ("model_profile", ModelProfile, {"name": "m"}, False),
        ("model_profile", ModelProfile, {"name": "m", "label_set": "s", "sha256": ["F"]}, False),
        ("model_profile", ModelProfile, {"name": "m", "label_set": "s", "scale": 0}, False),
        (
            "model_profile",
            ModelProfile,
            {"name": "m", "label_set": "s", "input_size_px": [896, 0]},
            False,
        ),
    ],
)
def test_schema_and_model_agree(
    name: str, model: type[BaseModel], document: dict[str, Any], is_good: bool
) -> None:
    try:
        model.model_validate(as_json(document))
        accepted = True
    except ValidationError:
        accepted = False
    assert accepted is is_good
    assert (problems(name, as_json(document)) == []) is is_good
