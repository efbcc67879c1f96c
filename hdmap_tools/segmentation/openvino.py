"""OpenVINO IR models (an ``.xml`` and its ``.bin``), run by OpenVINO, an optional extra."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hdmap_tools.errors import ConfigError, MissingExtraError
from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.segmentation.feeding import Feeding, Output
from hdmap_tools.segmentation.model_profile import sha256_of_files
from hdmap_tools.segmentation.network import Handling, Network, NetworkSegmenter
from hdmap_tools.segmentation.onnx import choose_output
from hdmap_tools.segmentation.segmenter import ModelProfile
from hdmap_tools.types import NDArrayAny, NDArrayFloat32


def load_openvino(
    model: Path,
    feeding: ModelProfile | Feeding,
    cameras: Mapping[str, PinholeCamera],
    *,
    threads: int = 0,
    handling: Handling | None = None,
) -> NetworkSegmenter:
    """A segmenter from an OpenVINO IR file.

    The network is run in 32-bit floats. OpenVINO's own choice on recent CPUs is
    bfloat16: twice as fast, but results then depend on the machine, and on
    annotated images it cost 0.7 points of road IoU.

    Args:
        model: The ``.xml`` file, with the ``.bin`` of the same name beside it.
        feeding: How to feed the network and read its answer, or all that is known of it.
        cameras: Cameras by name.
        threads: CPU threads for one image; 0 is one a core.
        handling: How images are brought to it.

    Raises:
        MissingExtraError: If OpenVINO is not installed.
        ConfigError: If a file is missing or no model, or its inputs and outputs
            do not fit the profile.
    """
    try:
        import openvino
    except ImportError as error:
        raise MissingExtraError(
            f"Model {model} is an OpenVINO model, and OpenVINO is not installed "
            f'({error}). Install it with: pip install "hdmap-tools[openvino]"'
        ) from error
    weights = model.with_suffix(".bin")
    for file in (model, weights):
        if not file.is_file():
            raise ConfigError(
                f"There is no model file {file}; an OpenVINO model is an .xml with its .bin beside it."
            )
    settings: dict[str, Any] = {
        "INFERENCE_PRECISION_HINT": "f32",
        "PERFORMANCE_HINT": "LATENCY",
    }
    if threads:
        settings["INFERENCE_NUM_THREADS"] = threads
    try:
        core = openvino.Core()
        graph = core.read_model(str(model), str(weights))
        compiled = core.compile_model(graph, "CPU", settings)
    except Exception as error:  # RuntimeError in the main, but the bindings promise nothing
        raise ConfigError(
            f"{model} with {weights.name} is not a model that OpenVINO {openvino.__version__} "
            f"can load: {_first_words(error)}"
        ) from error
    if len(compiled.inputs) != 1:
        raise ConfigError(f"Model {model} has {len(compiled.inputs)} inputs; expected one.")
    # An output without a name is known by its place.
    names = [
        sorted(port.get_names() or {f"output {index}"})
        for index, port in enumerate(compiled.outputs)
    ]
    known = feeding if isinstance(feeding, Feeding) else Feeding(feeding)
    input_shape = _lengths(compiled.input(0))
    found_outputs = [
        Output(str(aliases[0]), _lengths(port), port.element_type.is_integral())
        for aliases, port in zip(names, compiled.outputs, strict=True)
    ]
    profile = known.settled(model, input_shape, found_outputs)
    wanted = profile.output_name
    shown = [wanted if wanted in aliases else aliases[0] for aliases in names]
    output_index = shown.index(choose_output(model, [str(name) for name in shown], profile))

    requests = threading.local()

    def run(batch: NDArrayFloat32) -> NDArrayAny:
        # A request holds one run's memory, so each thread has its own.
        if not hasattr(requests, "request"):
            requests.request = compiled.create_infer_request()
        try:
            requests.request.infer([batch])
        except Exception as error:  # as above
            raise ConfigError(
                f"Model {model} failed on input {batch.shape} of profile {profile.name!r}: "
                f"{_first_words(error)}"
            ) from error
        answer: NDArrayAny = requests.request.get_output_tensor(output_index).data.copy()
        return answer

    network = Network(
        path=model,
        runtime=f"openvino {openvino.__version__}",
        weights_sha256=sha256_of_files([model, weights]),
        input_shape=input_shape,
        run=run,
        output_shape=found_outputs[output_index].shape,
    )
    return NetworkSegmenter(
        network,
        profile,
        cameras,
        label_set=known.label_set,
        confusion=known.confusion,
        handling=handling,
    )


def _lengths(port: Any) -> tuple[int | None, ...]:
    """The shape of an input or output, None where it is not fixed; empty where nothing is."""
    shape = port.partial_shape
    if shape.rank.is_dynamic:
        return ()
    return tuple(None if n.is_dynamic else n.get_length() for n in shape)


def _first_words(error: Exception) -> str:
    """The error on one line, without the pages of graph that the runtime may append."""
    return " ".join(str(error).split())[:400]
