"""One small typed model a step; `hdmap.yaml` holds them, and each run dumps the ones it used."""

from __future__ import annotations

import itertools
import json
import re
import reprlib
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import yaml
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    field_validator,
    model_validator,
)

from hdmap_tools.errors import ConfigError
from hdmap_tools.labels.label_set import MAP_CLASSES, MapClass

SCHEMA_VERSION: Final = 1
"""Version of hdmap.yaml; raised when a field changes its meaning."""

_NUMBERS: Final = {
    "tag:yaml.org,2002:int": re.compile(
        r"[-+]?(?:0b[01_]+|0[0-7_]+|0|[1-9][0-9_]*|0x[0-9a-fA-F_]+)$"
    ),
    "tag:yaml.org,2002:float": re.compile(
        r"[-+]?(?:[0-9][0-9_]*\.[0-9_]*(?:[eE][-+][0-9]+)?|\.[0-9][0-9_]*(?:[eE][-+][0-9]+)?"
        r"|\.(?:inf|Inf|INF))$|\.(?:nan|NaN|NAN)$"
    ),
}
"""How plain numbers look in hdmap.yaml."""


class _Step(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class DriveConfig(_Step):
    """Which part of the drive is used.

    Attributes:
        layout: Reader to use; ``auto`` guesses from the folder.
        scene: Which drive of a data root that holds several.
        cameras: Camera names; empty means all calibrated ones.
        max_pose_gap_s: Frames in a longer gap between poses are dropped and counted.
        max_sweep_gap_s: Largest time between an image and the sweep used with it.
    """

    layout: str = "auto"
    scene: str | None = None
    cameras: tuple[str, ...] = ()
    max_pose_gap_s: Annotated[float, Field(gt=0)] = 0.5
    max_sweep_gap_s: Annotated[float, Field(gt=0)] = 0.1


_SidePx = Annotated[int, Field(ge=1, le=16384)]
SizePx = tuple[_SidePx, _SidePx]
"""(width, height)."""


class SegmentationConfig(_Step):
    """Where labels come from.

    Attributes:
        model: Path of an ONNX or OpenVINO model, or the name of one that ships
            (``street-small``); None looks in `models/` in and beside the drive, and takes
            the shipped one where none lies there.
            ``simulated`` puts errors on the true labels of a drive made by `hdmap simulate`.
        profile: Name or path of a model profile; None takes it from the model's own metadata,
            or finds it by the model's hash.
        labels: Folder of label PNGs ``<camera>/<timestamp_ns>.png``, instead of a model.
        label_set: Label set of those PNGs, or of a model of which nothing is known.
        threads: CPU threads of the network; 0 is its own choice.
        input_size_px: (width, height) to feed such a model; None is what it takes.
        batch: Images or tiles given to the network at once, where it takes several.
        tile_px: (width, height) of tiles that large images are cut into; None feeds them whole.
        tile_overlap_px: By how much tiles overlap.
        undistort: Show the network the rectified image of a camera with distortion; its
            labels are brought back to the recorded one.
        confusion: Confusion matrix that ``simulated`` errs by; None is one assumed.
        seed: Of the errors of ``simulated``.
    """

    model: Path | None = None
    profile: str | None = None
    labels: Path | None = None
    label_set: str | None = None
    threads: Annotated[int, Field(ge=0)] = 0
    input_size_px: SizePx | None = None
    batch: Annotated[int, Field(ge=1, le=256)] = 1
    tile_px: SizePx | None = None
    tile_overlap_px: Annotated[int, Field(ge=0)] = 128
    undistort: bool = True
    confusion: Path | None = None
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0


class PointsConfig(_Step):
    """How the dense point map is made.

    Attributes:
        voxel_mm: Returns are thinned to one point a voxel of this edge.
        cell_mm: Cells that have a ground height; a whole number of voxels, and 25.6 m
            are a whole number of cells.
        min_range_m: Returns nearer to the ego origin (in x-y) are not used: the vehicle itself.
        max_range_m: Nor are those further away, which a small error of the pose moves.
        ground_tolerance_m: How far above or below the estimated ground a return still
            is ground.
        remove_moving: Leave out what later or earlier sweeps saw through.
        normalize_intensity: Undo how intensity depends on ring and range.
        refine_poses: Register the sweeps to the map first, and put them at those poses.
    """

    voxel_mm: Annotated[int, Field(ge=20, le=1000)] = 50
    cell_mm: Annotated[int, Field(ge=100, le=1000)] = 200
    min_range_m: Annotated[float, Field(ge=0)] = 2.5
    max_range_m: Annotated[float, Field(gt=0, le=200)] = 40.0
    ground_tolerance_m: Annotated[float, Field(gt=0)] = 0.1
    remove_moving: bool = True
    normalize_intensity: bool = True
    refine_poses: bool = True

    @model_validator(mode="after")
    def _cells_fit(self) -> PointsConfig:
        if 25_600 % self.cell_mm or self.cell_mm % self.voxel_mm:
            raise ValueError(
                f"cell_mm {self.cell_mm} must divide 25600, and voxel_mm {self.voxel_mm} must divide it"
            )
        return self


AssociationMethod = Literal["dense", "surface", "sparse", "planar"]


class AssociationConfig(_Step):
    """How labels reach the ground.

    Attributes:
        method: ``dense`` labels the points of a point map around the vehicle (the
            paper's), ``surface`` looks each cell up at the height of the ground that the
            sweep found (dense from one frame), ``sparse`` labels the sweep's own
            points, ``planar`` looks each cell up on a plane (no lidar needed). Where
            it is not said: ``dense`` with `points`, ``surface`` without.
        points: The point map (`hdmap points`), or a point cloud, for ``dense``; its
            poses of the drive are then used by every method. None: ``dense`` makes one first.
        clip_ahead_m: ``dense``: points up to so far ahead of the ego origin are labelled,
        clip_across_m: and up to so far to either side.
        also: Methods that `hdmap run` builds in memory beside it, to compare with;
            those that need lidar are left out where there is none.
        min_range_m: Ground nearer to the camera (in x-y) is not used: there the image
            shows bonnet or boot, and what is labelled on them is not ground.
        max_range_m: ``sparse``: points further from the ego origin (in x-y) are not used.
        ground_tolerance_m: How far above or below the estimated ground a point still is
            ground. At 0.2 m the feet of barriers and the fronts of kerbs come in, which
            cost 1.6 points of IoU on a recorded keyframe.
        occlusion_test: Leave out ground that nearer things hide from the camera
            (``planar`` cannot: it knows of no things).
        lookup_range_m: Reach of ``surface`` and ``planar`` from the camera; a pixel
            covers more and more ground beyond it.
    """

    method: AssociationMethod = "surface"
    points: Path | None = None
    clip_ahead_m: Annotated[float, Field(gt=0, le=200)] = 15.0
    clip_across_m: Annotated[float, Field(gt=0, le=200)] = 10.0
    also: tuple[AssociationMethod, ...] = ("sparse", "planar")
    min_range_m: Annotated[float, Field(ge=0)] = 4.0
    max_range_m: Annotated[float, Field(gt=0)] = 40.0
    ground_tolerance_m: Annotated[float, Field(gt=0)] = 0.1
    occlusion_test: bool = True
    lookup_range_m: Annotated[float, Field(gt=0)] = 25.0

    @model_validator(mode="before")
    @classmethod
    def _dense_with_points(cls, values: Any) -> Any:
        if isinstance(values, dict) and values.get("points") is not None:
            return {"method": "dense", **values}
        return values

    @property
    def needs_points(self) -> bool:
        """Whether a method asked for needs a point map."""
        return "dense" in (self.method, *self.also)


def _is_whole_millimetres(value: float) -> float:
    # Otherwise changing the reference height of a merged map would not be exact.
    if abs(value * 1000 - round(value * 1000)) > 1e-6:
        raise ValueError("must be a whole number of millimetres")
    return value


WholeMillimetres = Annotated[float, AfterValidator(_is_whole_millimetres)]
"""Metres that are a whole number of millimetres."""


def _rises(edges: tuple[float, ...]) -> tuple[float, ...]:
    if any(b <= a for a, b in itertools.pairwise((0.0, *edges))):
        raise ValueError("must be above 0 and rise")
    return edges


RangeEdges = Annotated[
    tuple[Annotated[float, Field(gt=0, le=1000)], ...], Field(max_length=8), AfterValidator(_rises)
]
"""Distances in metres at which bands of range begin, beyond the first that begins at 0."""


class FusionConfig(_Step):
    """How frames become counts.

    Attributes:
        resolution_m: Cell size. Paint is 0.10 to 0.15 m wide; the paper used 0.2 m.
        count_mode: How a frame votes in a cell: ``majority`` (one vote for the
            most frequent label), ``share`` (16 quanta shared among the labels
            seen), ``frame`` (one vote for each label seen), ``point`` (one vote
            a point).
        intensity_threshold: k, the intensity 0..255 from which on a return looks
            like paint; ``auto`` estimates it by Otsu's method on road points.
        range_edges_m: Distances from the camera at which a new band begins, whose votes
            are counted apart, so that a confusion matrix measured by range can be used (`hdmap
            confusion --range-bands`). Each band takes as much memory as all do without.
        reference_height_m: City height that stored heights count from, in whole millimetres.
        images_per_segment: Images fused between two commits: what a killed build loses at
            most, and what bounds its memory.
    """

    resolution_m: Annotated[float, Field(ge=0.01, le=10)] = 0.1
    count_mode: Literal["majority", "share", "frame", "point"] = "share"
    intensity_threshold: Annotated[int, Field(ge=1, le=255)] | Literal["auto"] = "auto"
    range_edges_m: RangeEdges = ()
    reference_height_m: WholeMillimetres = 0.0
    images_per_segment: Annotated[int, Field(ge=1)] = 240


def _intensity_term(value: Any) -> Any:
    # Earlier files say true or false; and YAML 1.1 reads a bare `off` as false.
    if isinstance(value, bool):
        return "gamma" if value else "off"
    return value


IntensityTerm = Annotated[
    Literal["off", "gamma", "learned"],
    BeforeValidator(
        _intensity_term, json_schema_input_type=bool | Literal["off", "gamma", "learned"]
    ),
]
"""How lidar intensity weighs in; true and false are read as ``gamma`` and ``off``."""


class ObservationConfig(_Step):
    """How counts are read as probabilities.

    Attributes:
        model: ``vanilla`` believes each label alike; ``confusion`` uses the
            network's confusion matrix; ``auto`` does where one is known.
        confusion: Path of a confusion matrix, or None for the one known for the model.
        other: Let cells also be none of the map's classes (buildings, vehicles). The
            paper does without; then such cells go to the class least unlikely.
        other_prior: Prior probability of that. A network that has one label for all
            that is not road cannot tell a lawn from a building; without evidence
            between them, "none of these" is what is claimed.
        intensity: ``off``; ``gamma`` is the paper's: votes with an intensity at or above
            k speak for lane mark; ``learned`` holds the mean intensity of each cell
            against what each class looks like.
        gamma: Weight of an intensity at or above k, as evidence for lane mark (log-likelihood).
        intensity_likelihood: ``learned``: file with what each class looks like; None
            learns it from the map itself.
        intensity_weight: ``learned``: weight of that one observation a cell.
        vanilla_lambda: λ in M = μ(I + λ1).
        smoothing: Laplace smoothing: added to each entry of the confusion matrix, as a
            share of its row.
        temperature: Divides the evidence of the votes; above 1 is more careful. Frames
            that see one place err alike, which counting them hides.
        priors: Prior probability by class; missing ones share what is left.
        fill_radius_cells: Radius of hole filling; 0 turns it off.
    """

    model: Literal["auto", "vanilla", "confusion"] = "auto"
    confusion: Path | None = None
    other: bool = True
    other_prior: Annotated[float, Field(ge=0, lt=1)] = 0.5
    intensity: IntensityTerm = "off"
    gamma: Annotated[float, Field(ge=0)] = 2.0
    intensity_likelihood: Path | None = None
    intensity_weight: Annotated[float, Field(ge=0)] = 1.0
    vanilla_lambda: Annotated[float, Field(gt=0)] = 0.1
    smoothing: Annotated[float, Field(gt=0, lt=1)] = 0.01
    temperature: Annotated[float, Field(gt=0)] = 1.0
    priors: dict[MapClass, Annotated[float, Field(ge=0, le=1)]] = Field(default_factory=dict)
    fill_radius_cells: Annotated[int, Field(ge=0, le=20)] = 1


class VectorizeConfig(_Step):
    """Which plugins run.

    Attributes:
        vectorizers: Names; empty means all installed ones.
        options: Options by plugin name.
        seed: Seed of the generator each plugin is handed.
        window_m: A map that has more cells than two windows of this side, with what plugins
            must see around them, is vectorized in such windows, and their elements are put
            together again. Made a whole number of tiles.
    """

    vectorizers: tuple[str, ...] = ()
    options: dict[str, dict[str, Any]] = Field(default_factory=dict)
    seed: int = 0
    window_m: Annotated[float, Field(gt=0, le=10_000)] = 100.0


class ExportConfig(_Step):
    """What is written beside the working file.

    Attributes:
        formats: Export formats.
        origin: Latitude, longitude and height of the city origin, where the
            drive does not know it.
    """

    formats: tuple[Literal["lanelet2", "geojson"], ...] = ("lanelet2",)
    origin: tuple[float, float, float] | None = None


class CompareConfig(_Step):
    """What the result is held against.

    Attributes:
        reference: Mask picture with its JSON, or a vector map; None takes what
            lies with the drive.
        max_range_m: Only cells this near to the driven path are compared; None is no limit.
        count_filled: Also compare cells that hole filling took from their neighbours.
    """

    reference: Path | None = None
    max_range_m: Annotated[float, Field(gt=0)] | None = 40.0
    count_filled: bool = False


class Config(_Step):
    """The whole of hdmap.yaml."""

    schema_version: Literal[1] = 1
    classes: Annotated[tuple[MapClass, ...], Field(min_length=1)] = MAP_CLASSES
    drive: DriveConfig = DriveConfig()
    segmentation: SegmentationConfig = SegmentationConfig()
    points: PointsConfig = PointsConfig()
    association: AssociationConfig = AssociationConfig()
    fusion: FusionConfig = FusionConfig()
    observation: ObservationConfig = ObservationConfig()
    vectorize: VectorizeConfig = VectorizeConfig()
    export: ExportConfig = ExportConfig()
    compare: CompareConfig = CompareConfig()

    @field_validator("classes")
    @classmethod
    def _classes_differ(cls, classes: tuple[MapClass, ...]) -> tuple[MapClass, ...]:
        if len(set(classes)) != len(classes):
            raise ValueError("a class is named twice")
        return classes

    def without_comparison(self) -> Config:
        """The same with the configured method of association alone."""
        alone = self.association.model_copy(update={"also": ()})
        return self.model_copy(update={"association": alone})

    def to_yaml(self) -> str:
        """The document that `load_config` reads back."""
        document = self.model_dump(mode="json")
        # PyYAML writes U+0085 bare and reads it back as a line break.
        has_break = "\x85" in json.dumps(document, ensure_ascii=False)
        return yaml.safe_dump(document, sort_keys=False, allow_unicode=not has_break)


def load_config(path: Path | None, overrides: dict[str, Any] | None = None) -> Config:
    """Read hdmap.yaml and put options over it.

    Args:
        path: The file, or None for the defaults.
        overrides: Values by dotted name, for example ``{"fusion.resolution_m": 0.1}``;
            those that are None are left out.

    Raises:
        ConfigError: If the file is not YAML, or a field is unknown or wrong; the
            message names each of them.
    """
    document: Any = {}
    if path is not None:
        try:
            document = yaml.load(path.read_text(encoding="utf-8"), Loader=_Loader)
        except FileNotFoundError as error:
            raise ConfigError(f"No configuration file {path}.") from error
        except RecursionError as error:
            raise ConfigError(
                f"{path} is nested too deeply; expected a mapping of steps with their fields."
            ) from error
        except (yaml.YAMLError, ValueError, OSError) as error:  # a number of 5000 digits, too
            raise ConfigError(
                f"{path} is not readable YAML: {' '.join(str(error).split())}"
            ) from error
        document = {} if document is None else document
        if not isinstance(document, dict):
            raise ConfigError(
                f"{path} must hold a mapping of steps, found {type(document).__name__}."
            )
        found = document.get("schema_version", SCHEMA_VERSION)
        if found != SCHEMA_VERSION:
            raise ConfigError(
                f"{path} has schema_version {_short(found)}; this version reads {SCHEMA_VERSION}. "
                "Install the matching release, or write the file anew with `hdmap info --default-config`."
            )
    for dotted, value in (overrides or {}).items():
        if value is None:
            continue
        *sections, field = dotted.split(".")
        target = document
        for section in sections:
            target = target.setdefault(section, {})
            if not isinstance(target, dict):
                raise ConfigError(f"{path}: {section!r} must be a mapping, found {_short(target)}.")
        target[field] = value
    try:
        return Config.model_validate(document)
    except ValidationError as error:
        lines = [
            f"{'.'.join(str(part) for part in problem['loc'])}: {problem['msg']} (found {_short(problem['input'])})"
            for problem in error.errors()
        ]
        raise ConfigError(f"{path or 'configuration'}: " + "; ".join(lines)) from error


class _Loader(yaml.SafeLoader):
    """YAML without repeated keys, of which PyYAML would silently keep the last.

    Numbers are those of YAML 1.1 without base 60, in which ``1:30`` would be 90.
    """

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen = set()
        for key_node, _ in node.value:
            # `<<` may stand twice and is resolved by the base class.
            if isinstance(key_node, yaml.ScalarNode) and key_node.value != "<<":
                if key_node.value in seen:
                    raise yaml.constructor.ConstructorError(
                        problem=f"{key_node.value!r} stands twice", problem_mark=key_node.start_mark
                    )
                seen.add(key_node.value)
        return super().construct_mapping(node, deep)


_Loader.yaml_implicit_resolvers = {
    first: [(tag, _NUMBERS.get(tag, pattern)) for tag, pattern in resolvers]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}


def _short(value: Any) -> str:
    # A few lines of YAML aliases can stand for gigabytes of text.
    try:
        text = reprlib.repr(value)
    except ValueError:  # a hexadecimal number that Python does not write in decimal
        return "a number of thousands of digits"
    return text if len(text) <= 120 else text[:117] + "..."
