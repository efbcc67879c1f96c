"""ONNX models, run by ONNX Runtime."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from hdmap_tools.errors import ConfigError
from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.segmentation.feeding import Feeding, Output
from hdmap_tools.segmentation.model_profile import sha256_of_files
from hdmap_tools.segmentation.network import Handling, Network, NetworkSegmenter
from hdmap_tools.segmentation.segmenter import ModelProfile
from hdmap_tools.types import NDArrayAny, NDArrayFloat32


def load_onnx(
    model: Path,
    feeding: ModelProfile | Feeding,
    cameras: Mapping[str, PinholeCamera],
    *,
    threads: int = 0,
    handling: Handling | None = None,
) -> NetworkSegmenter:
    """A segmenter from an ONNX file.

    Args:
        model: The ``.onnx`` file; weights kept outside it lie in files beside it.
        feeding: How to feed the network and read its answer, or all that is known of it.
        cameras: Cameras by name.
        threads: CPU threads for one image; 0 is one a core.
        handling: How images are brought to it.

    Raises:
        ConfigError: If the file is missing or no model, or its inputs and
            outputs do not fit the profile.
    """
    import onnxruntime

    if not model.is_file():
        raise ConfigError(f"There is no model file {model}.")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    # Errors come back as exceptions; the runtime's own log would repeat them on stderr.
    options.log_severity_level = 4
    try:
        session = onnxruntime.InferenceSession(
            str(model), options, providers=["CPUExecutionProvider"]
        )
    except Exception as error:  # the runtime's error classes have no common, public base
        raise ConfigError(
            f"{model} is not a model that ONNX Runtime {onnxruntime.__version__} can load: {error}"
        ) from error
    inputs, outputs = session.get_inputs(), session.get_outputs()
    if len(inputs) != 1 or inputs[0].type != "tensor(float)":
        found = ", ".join(f"{i.name} {i.type}" for i in inputs)
        raise ConfigError(f"Model {model} has inputs {found}; expected one of tensor(float).")
    known = feeding if isinstance(feeding, Feeding) else Feeding(feeding)
    input_shape = _lengths(inputs[0].shape)
    found_outputs = [Output(o.name, _lengths(o.shape), "int" in o.type) for o in outputs]
    profile = known.settled(model, input_shape, found_outputs)
    output_name = choose_output(model, [o.name for o in outputs], profile)

    def run(batch: NDArrayFloat32) -> NDArrayAny:
        try:
            answer: NDArrayAny = session.run([output_name], {inputs[0].name: batch})[0]
        except Exception as error:  # as above
            raise ConfigError(
                f"Model {model} failed on input {batch.shape} of profile {profile.name!r}: {error}"
            ) from error
        return answer

    network = Network(
        path=model,
        runtime=f"onnxruntime {onnxruntime.__version__}",
        weights_sha256=sha256_of_files(_with_external_weights(model)),
        input_shape=input_shape,
        run=run,
        output_shape=next(o.shape for o in found_outputs if o.name == output_name),
    )
    return NetworkSegmenter(
        network,
        profile,
        cameras,
        label_set=known.label_set,
        confusion=known.confusion,
        handling=handling,
    )


def choose_output(model: Path, names: list[str], profile: ModelProfile) -> str:
    """The output that the profile names, or the only one.

    Raises:
        ConfigError: If there are several and none is named, or not the one named.
    """
    listed = ", ".join(repr(name) for name in names)
    if profile.output_name is not None:
        if profile.output_name not in names:
            raise ConfigError(
                f"Model {model} has no output {profile.output_name!r} as profile {profile.name!r} "
                f"says; it has {listed}."
            )
        return profile.output_name
    if len(names) != 1:
        raise ConfigError(
            f"Model {model} has the outputs {listed}; say in profile {profile.name!r} which one "
            "holds the labels, as output_name."
        )
    return names[0]


def _lengths(shape: Sequence[int | str | None]) -> tuple[int | None, ...]:
    """A shape with None for what has a name or no length."""
    return tuple(n if isinstance(n, int) and n > 0 else None for n in shape)


def _with_external_weights(model: Path) -> list[Path]:
    """The model and the files beside it that begin with its name, as ``model.onnx.data`` does."""
    return sorted(p for p in model.parent.iterdir() if p.name.startswith(model.name))
