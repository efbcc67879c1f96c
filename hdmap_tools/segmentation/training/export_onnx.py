"""A trained run as one ONNX file that says how to feed it, what it means and where it errs."""

from __future__ import annotations

import io
import logging
import warnings
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from torch import nn

from hdmap_tools.errors import CheckpointError
from hdmap_tools.formats.atomic import atomic_output
from hdmap_tools.segmentation.confusion import ConfusionMatrix
from hdmap_tools.segmentation.embedded import EmbeddedModel, write_embedded
from hdmap_tools.segmentation.segmenter import ModelProfile
from hdmap_tools.segmentation.training.checkpoint import BEST, read_state
from hdmap_tools.segmentation.training.models import build_model
from hdmap_tools.segmentation.training.run_settings import RunSettings, read_settings
from hdmap_tools.types import NDArrayFloat32

_log = logging.getLogger(__name__)

_OPSET: Final = 17
_MAX_DIFFERENCE: Final = 1e-4
_TRACED_SIZE_PX: Final = (96, 128)
"""(height, width) that the network is traced with; it takes any other."""
_TRIED_SIZES_PX: Final = ((96, 128), (75, 109))


def export_run(run: Path, out: Path, *, name: str | None = None, overwrite: bool = False) -> float:
    """Write the best weights of a run as ONNX, held against torch before it takes its name.

    Args:
        run: Folder of the run.
        out: The ``.onnx`` file.
        name: Names the model; None: as the file is named.
        overwrite: Whether an older file may be replaced.

    Returns:
        The largest difference of a score between ONNX Runtime and torch.

    Raises:
        CheckpointError: If the run has no weights, they are damaged or of another
            network, or the exported network does not give torch's scores.
        OutputExistsError: If the file exists and may not be replaced.
        FormatError: If it cannot be written.
    """
    settings = read_settings(run)
    state = read_state(run / BEST)
    model = build_model(settings.preset, len(settings.label_set), pretrained=False)
    try:
        model.load_state_dict(state["model"])
    except (KeyError, RuntimeError) as error:
        raise CheckpointError(
            f"The weights of run {run} are of another network: {error}"
        ) from error
    confusion = state.get("confusion")
    matrix = None if confusion is None else ConfusionMatrix.from_json(confusion, f"Run {run}")
    if matrix is None:
        _log.warning(
            "Run %s was never validated: %s gets no confusion matrix, and a map that is made with it "
            "is read with an assumed one.",
            run,
            out,
        )
    embedded = _embedded(settings, matrix, int(state["step"]), name or out.stem)
    content = onnx_bytes(model)
    difference = _largest_difference(model, content)
    if not difference <= _MAX_DIFFERENCE:
        raise CheckpointError(
            f"The exported network differs from the trained one by {difference:.2g} in a score, more "
            f"than {_MAX_DIFFERENCE:g}; are the weights of run {run} finite?"
        )
    with atomic_output(out, overwrite) as temporary:
        temporary.write_bytes(content)
        write_embedded(temporary, embedded)
    return difference


def onnx_bytes(model: nn.Module) -> bytes:
    """A network as ONNX, for any number of images of any size; the same model gives the same bytes.

    Args:
        model: From images (N, 3, H, W) to scores (N, labels, H, W).
    """
    model = model.eval().cpu().to(memory_format=torch.contiguous_format)
    height, width = _TRACED_SIZE_PX
    buffer = io.BytesIO()
    with warnings.catch_warnings(), torch.inference_mode():
        # The exporter by tracing is called old, but needs no further package; and sizes that
        # become constants, which the tracer warns of, would show in `_largest_difference`.
        warnings.simplefilter("ignore")
        torch.onnx.export(
            model,
            (torch.zeros(2, 3, height, width),),
            buffer,
            dynamo=False,
            opset_version=_OPSET,
            input_names=["image"],
            output_names=["scores"],
            dynamic_axes={
                "image": {0: "n", 2: "height", 3: "width"},
                "scores": {0: "n", 2: "height", 3: "width"},
            },
        )
    return buffer.getvalue()


def _largest_difference(model: nn.Module, content: bytes) -> float:
    """Between torch and ONNX Runtime, on noise of several sizes; of any score."""
    import onnxruntime

    session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
    rng = np.random.default_rng(0)
    differences = []
    for height, width in _TRIED_SIZES_PX:
        images: NDArrayFloat32 = rng.normal(size=(1, 3, height, width)).astype(np.float32)
        with torch.inference_mode():
            expected: Any = model(torch.from_numpy(images)).numpy()
        found = session.run(["scores"], {"image": images})[0]
        if found.shape != expected.shape:
            raise CheckpointError(
                f"The exported network gives {found.shape} for an image of {height}x{width}, torch "
                f"{expected.shape}."
            )
        differences.append(float(np.abs(found - expected).max()))
    return float(np.max(differences))  # NaN stays NaN


def _embedded(
    settings: RunSettings, confusion: ConfusionMatrix | None, step: int, name: str
) -> EmbeddedModel:
    preset, labels = settings.preset, settings.label_set
    profile = ModelProfile(
        name=name,
        label_set=labels.name,
        mean=preset.augmentation.mean,
        std=preset.augmentation.std,
        output_name="scores",
        source=f"hdmap train, preset {preset.name}, seed {settings.seed}, weights of step {step}",
    )
    said = settings.model_dump(mode="json", exclude={"label_set", "schema_version"})
    return EmbeddedModel(
        profile=profile,
        label_set=labels,
        confusion=confusion,
        training=said | {"step": step, "torch": torch.__version__},
    )
