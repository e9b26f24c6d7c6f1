"""Export of a network: normalisation, network and activation as one graph in a file.

The graph computes belief maps and vector fields from pixels (batch, 3, height, width), uint8 RGB.
Batch, height and width are free; height and width must be multiples of the network's size multiple.
To add a format, write an :data:`Exporter` and a line in :data:`EXPORTERS`.
"""

from __future__ import annotations

import errno
import logging
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from torch import Tensor, nn
from torch.export import Dim, ExportedProgram

from dopepp.core.errors import UserError, require
from dopepp.core.files import write_file
from dopepp.inference.runtimes import INPUT, OUTPUTS, Export, Pixels, describe_export, pack
from dopepp.inference.runtimes.openvino import NAME, load_openvino
from dopepp.models.checkpoint import KEY, SUFFIX, Checkpoint, write_content
from dopepp.models.network import PoseNetwork

PRECISIONS: Final = ("fp32", "fp16", "int8")

Save = Callable[[Path, Checkpoint, Export], None]
"""Writes a graph with its description to a new file or folder."""

Exporter = Callable[[PoseNetwork, str, Sequence[Pixels]], Save]
"""Function that converts a network to a graph of a precision; int8 is calibrated on the images.

Raises:
    UserError: The format or precision does not support the network. (:func:`check_possible` has
        already detected missing packages.)
"""

_PACKAGES: Final = {
    "onnx": ("onnx", "onnxscript", "onnxruntime"),
    "openvino": ("openvino",),
    "safetensors": (),
}

_CHATTY: Final = ("torch.onnx", "onnxscript", "onnx_ir")
"""Loggers that report every step of a conversion."""

_SMALL: Final = 1024
"""Number of elements up to which a constant stays in full precision; shapes have fewer elements."""

_FLOAT16_MAX: Final = 65504.0


class _Maps(nn.Module):
    """The exported part of a network: from pixels to maps in float32."""

    def __init__(self, network: PoseNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """Return the belief maps and vector fields of uint8 RGB images."""
        belief, field = self.network.maps(pixels)
        return belief.float(), field.float()


def check_possible(layout: str, precision: str) -> None:
    """Check that a format (``layout``) supports a precision and the required extras are installed.

    Raises:
        UserError: The format does not support the precision, or a required extra is not installed.
    """
    if layout == "safetensors" and precision == "int8":
        allowed, fix = "fp32 or fp16", "choose --format onnx or openvino for int8"
        raise UserError("--format safetensors --precision int8", allowed, fix)
    for package in _PACKAGES[layout]:
        require(package, f"--format {layout}", layout)
    for package in ("openvino", "nncf") if precision == "int8" else ():
        require(package, "--precision int8", "openvino")


def to_onnx(network: PoseNetwork, precision: str, images: Sequence[Pixels]) -> Save:
    """Convert a network to an ONNX model; see :data:`Exporter`."""
    program = _trace(network)
    with _conversion(network, "ONNX"):
        names: dict[str, Any] = {"input_names": [INPUT], "output_names": list(OUTPUTS)}
        exported: Any = torch.onnx.export(
            program, **names, dynamo=True, external_data=False, verbose=False
        )
        model = exported.model_proto
    _strip(model.graph)
    if precision == "fp16":
        _halve(model.graph)
    if precision == "int8":
        batches = [{INPUT: image} for image in images]
        model = _quantise(model, batches, _last_convolutions(model.graph))

    def save(path: Path, checkpoint: Checkpoint, export: Export) -> None:
        del model.metadata_props[:]
        model.metadata_props.add(key=KEY, value=pack(checkpoint, export))
        write_file(path, model.SerializeToString())

    return save


def to_openvino(network: PoseNetwork, precision: str, images: Sequence[Pixels]) -> Save:
    """Convert a network to an OpenVINO model; see :data:`Exporter`."""
    openvino = load_openvino("--format openvino")
    program = _trace(network)
    with _conversion(network, "OpenVINO"):
        model = openvino.convert_model(program)
    model.reshape({model.inputs[0]: [-1, 3, -1, -1]})
    model.inputs[0].set_names({INPUT})
    for output, name in zip(model.outputs, OUTPUTS, strict=True):
        output.set_names({name})
    if precision == "int8":
        model = _quantise(model, list(images), _last_openvino_convolutions(model))

    def save(folder: Path, checkpoint: Checkpoint, export: Export) -> None:
        model.set_rt_info(pack(checkpoint, export), [KEY])
        folder.mkdir(exist_ok=True)
        try:
            openvino.save_model(model, folder / NAME, compress_to_fp16=precision == "fp16")
        except RuntimeError as error:  # OpenVINO does not state the operating system's reason
            raise OSError(errno.EIO, "OpenVINO cannot write; is the disk full?") from error

    return save


def to_safetensors(network: PoseNetwork, precision: str, images: Sequence[Pixels]) -> Save:
    """Keep a network's weights, in full or half precision, for PyTorch; see :data:`Exporter`."""
    weights = network.state_dict()

    def save(path: Path, checkpoint: Checkpoint, export: Export) -> None:
        whole = Checkpoint(**{**vars(checkpoint), "state_dict": weights})
        write_content(describe_export(whole, export), path, half=precision == "fp16")

    return save


EXPORTERS: Final[dict[str, tuple[Exporter, str]]] = {
    "onnx": (to_onnx, ".onnx"),
    "openvino": (to_openvino, "_openvino"),
    "safetensors": (to_safetensors, SUFFIX),
}
"""Exporter of each format, and suffix of its file or folder."""


def _trace(network: PoseNetwork) -> ExportedProgram:
    """Trace a network by ``torch.export`` for any batch size, height and width."""
    multiple = network.size_multiple
    example = torch.zeros(2, 3, 3 * multiple, 4 * multiple, dtype=torch.uint8)
    free = {0: Dim("batch"), 2: multiple * Dim("rows"), 3: multiple * Dim("columns")}
    maps = _Maps(network.cpu()).eval()
    with _conversion(network, "torch.export"):
        return torch.export.export(maps, (example,), dynamic_shapes=(free,))


@contextmanager
def _conversion(network: PoseNetwork, language: str) -> Iterator[None]:
    """Suppress a conversion's logs and warnings, and raise its failures as UserError."""
    levels = {logger: logger.level for logger in map(logging.getLogger, _CHATTY)}
    for logger in levels:
        logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except UserError:
        raise
    except Exception as error:  # the libraries raise several types
        lines = [line.strip() for line in str(error).splitlines() if line.strip()]
        parts = ", ".join(type(child).__name__ for child in network.children())
        raise UserError(
            f"a network of {parts}, which {language} cannot express "
            f"({lines[0] if lines else type(error).__name__:.300})",
            f"operators that {language} supports, for images of any size",
            "use another operator in your module, or pass --format safetensors",
        ) from error
    finally:
        for logger, level in levels.items():
            logger.setLevel(level)


def _strip(graph: Any) -> None:
    """Remove references to source code from an ONNX graph, and name the free dimensions."""
    for item in (*graph.node, *graph.input, *graph.output, *graph.value_info, *graph.initializer):
        del item.metadata_props[:]
        item.doc_string = ""
    del graph.value_info[:]
    names = ("batch", None, "height", "width"), *2 * (("batch", None, "rows", "columns"),)
    for value, sides in zip((*graph.input, *graph.output), names, strict=True):
        for side, name in zip(value.type.tensor_type.shape.dim, sides, strict=True):
            if name is not None:
                side.dim_param = name


def _halve(graph: Any) -> None:
    """Store an ONNX graph's weights in half precision, with a cast that runtimes evaluate once."""
    from onnx import TensorProto, helper, numpy_helper

    conversions = []
    for tensor in graph.initializer:
        values = numpy_helper.to_array(tensor)
        if values.dtype != np.float32 or values.size <= _SMALL:
            continue
        if not np.abs(values).max() <= _FLOAT16_MAX:
            allowed = f"weights of at most {_FLOAT16_MAX:g}"
            problem = f"--precision fp16 with larger weights in {tensor.name}"
            raise UserError(problem, allowed, "pass --precision fp32")
        name, half = tensor.name, f"{tensor.name}.half"
        tensor.CopyFrom(numpy_helper.from_array(values.astype(np.float16), half))
        conversions.append(helper.make_node("Cast", [half], [name], name, to=TensorProto.FLOAT))
    nodes = [*conversions, *graph.node]
    del graph.node[:]
    graph.node.extend(nodes)


def _last_convolutions(graph: Any) -> list[str]:
    """Return the names of the convolutions that compute an ONNX graph's maps."""
    producers = {name: node for node in graph.node for name in node.output}
    ends = []
    for output in graph.output:
        node = producers.get(output.name)
        while node is not None and node.op_type != "Conv":
            node = next((producers[name] for name in node.input if name in producers), None)
        ends += [] if node is None else [node.name]
    return ends


def _last_openvino_convolutions(model: Any) -> list[str]:
    """Return the names of the convolutions that compute an OpenVINO graph's maps."""
    ends = []
    for output in model.outputs:
        node = output.get_node()
        while node is not None and node.get_type_name() != "Convolution":
            inputs = (value.get_node() for value in node.input_values())
            node = next((n for n in inputs if n.get_type_name() != "Constant"), None)
        ends += [] if node is None else [node.get_friendly_name()]
    return ends


def _quantise(model: Any, images: Sequence[Any], ends: Sequence[str]) -> Any:
    """Return a graph, calibrated on images, that computes in 8 bits except in the nodes ``ends``.

    Weights use 7 bits: without VNNI, sums of two 8-bit products overflow.
    """
    load_openvino("--precision int8")
    logging.getLogger("nncf").setLevel(logging.ERROR)
    with redirect_stdout(StringIO()), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import nncf
        from nncf.quantization.advanced_parameters import (
            AdvancedQuantizationParameters,
            OverflowFix,
        )

        return nncf.quantize(
            model,
            nncf.Dataset(images),
            preset=nncf.QuantizationPreset.MIXED,
            subset_size=len(images),
            ignored_scope=nncf.IgnoredScope(names=list(ends)),
            advanced_parameters=AdvancedQuantizationParameters(overflow_fix=OverflowFix.ENABLE),
        )
