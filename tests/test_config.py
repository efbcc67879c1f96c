"""hdmap.yaml: what is wrong is refused by name, what is right comes back as it was."""

from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import example, given
from hypothesis import strategies as st
from pydantic import BaseModel

from hdmap_tools.config import (
    SCHEMA_VERSION,
    AssociationConfig,
    Config,
    ExportConfig,
    FusionConfig,
    ObservationConfig,
    SegmentationConfig,
    VectorizeConfig,
    load_config,
)
from hdmap_tools.errors import ConfigError
from hdmap_tools.labels.label_set import MAP_CLASSES, MapClass


def written(tmp_path: Path, content: str | dict[str, Any]) -> Path:
    path = tmp_path / "hdmap.yaml"
    path.write_text(content if isinstance(content, str) else yaml.safe_dump(content))
    return path


def test_nothing_given_is_the_defaults(tmp_path: Path) -> None:
    assert load_config(None) == Config()
    assert load_config(written(tmp_path, "")) == Config()
    assert load_config(written(tmp_path, "# only a comment\n")) == Config()


def test_what_is_given_is_used(tmp_path: Path) -> None:
    path = written(tmp_path, "fusion:\n  resolution_m: 0.1\n  intensity_threshold: 33\n")
    config = load_config(path)
    assert config.fusion.resolution_m == 0.1
    assert config.fusion.intensity_threshold == 33
    assert config.association == Config().association


@pytest.mark.parametrize(
    ("document", "field"),
    [
        ({"fussion": {}}, "fussion"),
        ({"fusion": {"resolution": 0.1}}, "fusion.resolution"),
        ({"fusion": {"resolution_m": "fine"}}, "fusion.resolution_m"),
        ({"fusion": {"resolution_m": 0}}, "fusion.resolution_m"),
        ({"fusion": {"resolution_m": -0.2}}, "fusion.resolution_m"),
        ({"fusion": {"resolution_m": float("nan")}}, "fusion.resolution_m"),
        ({"fusion": {"resolution_m": float("inf")}}, "fusion.resolution_m"),
        ({"fusion": {"reference_height_m": float("nan")}}, "fusion.reference_height_m"),
        ({"fusion": {"count_mode": "votes"}}, "fusion.count_mode"),
        ({"fusion": {"intensity_threshold": 256}}, "fusion.intensity_threshold"),
        ({"fusion": [1, 2]}, "fusion"),
        ({"fusion": None}, "fusion"),
        ({"drive": {"cameras": "CAM_FRONT"}}, "drive.cameras"),
        ({"drive": {"max_pose_gap_s": 0}}, "drive.max_pose_gap_s"),
        ({"association": {"method": "dence"}}, "association.method"),
        ({"association": {"occlusion_test": "perhaps"}}, "association.occlusion_test"),
        ({"observation": {"priors": {"kerb": 0.1}}}, "observation.priors.kerb"),
        ({"observation": {"priors": {"road": -0.1}}}, "observation.priors.road"),
        ({"observation": {"fill_radius_cells": 21}}, "observation.fill_radius_cells"),
        ({"vectorize": {"options": {"lane_mark_skeleton": 3}}}, "vectorize.options"),
        ({"export": {"formats": ["shapefile"]}}, "export.formats.0"),
        ({"export": {"origin": [49.0, 8.4]}}, "export.origin"),
        ({"classes": ["road", "kerb"]}, "classes.1"),
        ({"classes": []}, "classes"),
        ({"classes": ["road", "road"]}, "classes: .*twice"),
        ({1: 2}, "1"),
    ],
)
def test_a_wrong_field_is_refused_by_name(document, field: str, tmp_path: Path) -> None:
    path = written(tmp_path, document)
    with pytest.raises(ConfigError, match=rf"hdmap\.yaml: .*{field}") as caught:
        load_config(path)
    assert "found" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_all_wrong_fields_are_named_at_once(tmp_path: Path) -> None:
    path = written(tmp_path, {"fusion": {"resolution_m": -1}, "drive": {"camera": ["a"]}})
    with pytest.raises(ConfigError) as caught:
        load_config(path)
    assert "fusion.resolution_m" in str(caught.value)
    assert "drive.camera" in str(caught.value)


@pytest.mark.parametrize("version", [0, SCHEMA_VERSION + 1, "1", None, [1]])
def test_another_schema_version_is_refused(version, tmp_path: Path) -> None:
    path = written(tmp_path, {"schema_version": version, "unknown_then": 1})
    with pytest.raises(ConfigError, match=rf"schema_version .*this version reads {SCHEMA_VERSION}"):
        load_config(path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("fusion: [unclosed", "not readable YAML"),
        ("- a\n- b\n", "mapping of steps, found list"),
        ("just words", "mapping of steps, found str"),
        ("a: !!python/object/apply:os.system ['true']", "not readable YAML"),
        ("fusion: {resolution_m: 0.1}\nfusion: {resolution_m: 0.5}\n", "fusion.*twice"),
        ("fusion:\n  resolution_m: 0.1\n  resolution_m: 0.5\n", "resolution_m.*twice"),
        ("? [a, b]\n: 1\n", "not readable YAML"),
    ],
)
def test_what_is_no_such_yaml_is_refused(content: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=message):
        load_config(written(tmp_path, content))


def test_unreadable_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"No configuration file .*absent\.yaml"):
        load_config(tmp_path / "absent.yaml")
    with pytest.raises(ConfigError, match="not readable"):
        load_config(tmp_path)
    binary = tmp_path / "binary.yaml"
    binary.write_bytes(b"\xff\xfe\x00\x01")
    with pytest.raises(ConfigError, match="not readable"):
        load_config(binary)


def test_aliases_that_multiply_do_not_fill_the_message(tmp_path: Path) -> None:
    """Forty lines that stand for 2**40 entries."""
    lines = ["a0: &a0 [x, x]"] + [f"a{k}: &a{k} [*a{k - 1}, *a{k - 1}]" for k in range(1, 40)]
    with pytest.raises(ConfigError, match="a39") as caught:
        load_config(written(tmp_path, "\n".join(lines)))
    assert len(str(caught.value)) < 20_000


def test_overrides_win_and_none_leaves_alone(tmp_path: Path) -> None:
    path = written(tmp_path, {"fusion": {"resolution_m": 0.1, "count_mode": "point"}})
    overrides = {
        "fusion.resolution_m": 0.5,
        "fusion.count_mode": None,
        "vectorize.options.a.b": 3,
        "export.origin": (49.0, 8.4, 0.0),
    }
    config = load_config(path, overrides)
    assert config.fusion == FusionConfig(resolution_m=0.5, count_mode="point")
    assert config.vectorize.options == {"a": {"b": 3}}
    assert config.export.origin == (49.0, 8.4, 0.0)
    assert load_config(None, {"fusion.resolution_m": None}) == Config()


def test_a_wrong_override_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"configuration: fusion\.resolution_m.*found -1"):
        load_config(None, {"fusion.resolution_m": -1})
    with pytest.raises(ConfigError, match="'fusion' must be a mapping, found 3"):
        load_config(written(tmp_path, {"fusion": 3}), {"fusion.resolution_m": 0.1})


configs = st.builds(
    Config,
    classes=st.permutations(MAP_CLASSES).map(tuple),
    segmentation=st.builds(
        SegmentationConfig,
        model=st.none() | st.just(Path("models/net.onnx")),
        profile=st.none() | st.text(max_size=10),
    ),
    association=st.builds(
        AssociationConfig,
        method=st.sampled_from(["sparse", "planar"]),
        max_range_m=st.floats(1e-3, 1e3),
        occlusion_test=st.booleans(),
    ),
    fusion=st.builds(
        FusionConfig,
        resolution_m=st.floats(0.01, 10.0),
        count_mode=st.sampled_from(["majority", "share", "frame", "point"]),
        intensity_threshold=st.integers(1, 255) | st.just("auto"),
        # Whole millimetres only.
        reference_height_m=st.integers(-(10**7), 10**7).map(lambda mm: mm / 1000),
    ),
    observation=st.builds(
        ObservationConfig,
        priors=st.dictionaries(st.sampled_from(MapClass), st.floats(0.0, 1.0)),
        gamma=st.floats(0.0, 1e3),
    ),
    vectorize=st.builds(
        VectorizeConfig,
        vectorizers=st.lists(st.text(max_size=8), max_size=3).map(tuple),
        options=st.dictionaries(
            st.text(max_size=5), st.dictionaries(st.text(max_size=5), st.integers() | st.text())
        ),
        seed=st.integers(),
    ),
    export=st.builds(
        ExportConfig,
        origin=st.none() | st.tuples(*[st.floats(-80.0, 80.0)] * 3),
        formats=st.just(("geojson", "lanelet2")),
    ),
)


@given(configs)
@example(Config(segmentation=SegmentationConfig(profile="a\x85b", model=Path("Straße.onnx"))))
def test_a_dumped_configuration_loads_as_itself(tmp_path_factory, config: Config) -> None:
    path = tmp_path_factory.getbasetemp() / "round_trip.yaml"
    path.write_text(config.to_yaml(), encoding="utf-8")
    loaded = load_config(path)
    assert loaded == config
    assert loaded.to_yaml() == config.to_yaml()


def steps(model: type[BaseModel]) -> list[type[BaseModel]]:
    return [
        f.annotation
        for f in model.model_fields.values()
        if isinstance(f.annotation, type) and issubclass(f.annotation, BaseModel)
    ]


def test_every_field_of_every_step_is_explained() -> None:
    assert len(steps(Config)) == len(Config.model_fields) - 2
    for step in steps(Config):
        for field in step.model_fields:
            assert f"{field}:" in step.__doc__, f"{step.__name__}.{field} is not in the docstring"


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("a: " + "[" * 5000, "nested too deeply"),
        ("fusion: {reference_height_m: " + "9" * 5000 + "}", "digits"),
        ("vectorize: {seed: 0x" + "f" * 5000 + ", seat: 0x" + "f" * 5000 + "}", "digits"),
        ("export: {origin: 2024-99-99}", "month"),
        ("fusion: {resolution_m: 1:30}", "fusion.resolution_m"),
        ("fusion: {reference_height_m: 1:30.5}", "fusion.reference_height_m"),
    ],
)
def test_yaml_that_is_hostile_or_means_something_else(
    tmp_path: Path, content: str, says: str
) -> None:
    with pytest.raises(ConfigError, match=says) as error:
        load_config(written(tmp_path, content))
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 600


def test_numbers_are_read_as_ever(tmp_path: Path) -> None:
    text = "{a: 12, b: -1_000, c: 0x1F, d: 0, e: 1.5e+3, f: .5, g: -.inf, h: 017, i: 0b11, j: 1:30}"
    options = load_config(written(tmp_path, f"vectorize: {{options: {{p: {text}}}}}"))
    expected = yaml.safe_load(text) | {"j": "1:30"}
    assert options.vectorize.options["p"] == expected


@pytest.mark.parametrize(
    ("written_as", "means"),
    [("true", "gamma"), ("false", "off"), ("off", "off"), ("on", "gamma"), ("learned", "learned")],
)
def test_the_intensity_term_of_older_files_is_read(tmp_path, written_as, means):
    path = written(tmp_path, f"observation:\n  intensity: {written_as}\n")
    config = load_config(path)
    assert config.observation.intensity == means
    again = written(tmp_path, config.to_yaml())
    assert load_config(again) == config


def test_an_unknown_intensity_term_is_refused(tmp_path):
    with pytest.raises(ConfigError, match=r"observation\.intensity.*learned"):
        load_config(written(tmp_path, "observation:\n  intensity: sometimes\n"))
