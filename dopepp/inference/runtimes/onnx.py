"""ONNX files, run by onnxruntime on the CPU.

An ONNX file can refer to other files, operators of libraries and nested graphs. ``dopepp export``
writes no such references, and a file with any of them is rejected before ONNX Runtime reads it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from dopepp.core.errors import require
from dopepp.core.pool import num_threads
from dopepp.inference.runtimes import (
    INPUT,
    OUTPUTS,
    Arrays,
    Export,
    ExportedNetwork,
    Pixels,
    check_shapes,
    invalid_export,
    read_bytes,
    unpack,
)
from dopepp.models.checkpoint import KEY, Checkpoint

if TYPE_CHECKING:
    import onnx

_DOMAINS: Final = ("", "ai.onnx")  # namespaces of ONNX's standard operators

_SMALL: Final = 1024
"""Number of elements up to which a constant may be a shape or a factor; weights are larger."""

_ARITHMETIC: Final = {"Add", "Cast", "Div", "Mul", "Shape", "Sub"}
_SHAPE_OPERATORS: Final = _ARITHMETIC | {"Concat", "Gather", "Slice", "Squeeze", "Unsqueeze"}
"""Operators by which exporters compute shapes; their outputs are no larger than their inputs."""

_ERRORS_ONLY: Final = 3


def read_network(path: Path) -> OnnxNetwork:
    """Read an ONNX export of this package. The file is not trusted.

    Raises:
        UserError: The packages onnx and onnxruntime are not installed, or the file is missing,
            truncated, not an export of this package, or rejected by :func:`check_model`.
    """
    for package in ("onnx", "onnxruntime"):
        require(package, str(path), "onnx")
    import onnx

    content = read_bytes(path)
    try:
        model = onnx.load_model_from_string(content)
    except Exception as error:  # protobuf raises several types
        raise invalid_export(path, "not an ONNX model, or truncated") from error
    metadata = {entry.key: entry.value for entry in model.metadata_props}
    checkpoint, export = unpack(metadata.get(KEY), path)
    check_model(model, path, checkpoint.input_size)
    return OnnxNetwork(content, path, checkpoint, export)


class OnnxNetwork(ExportedNetwork):
    """A network that ONNX Runtime executes on the CPU.

    Args:
        content: Bytes of an ONNX file that passed :func:`check_model`.
        path: The file, for error messages.
        checkpoint: The checkpoint from which the file was exported.
        export: Options of the export.

    Raises:
        UserError: ONNX Runtime cannot load the file.
    """

    def __init__(self, content: bytes, path: Path, checkpoint: Checkpoint, export: Export) -> None:
        super().__init__(path, checkpoint, export)
        import onnxruntime

        onnxruntime.disable_telemetry_events()
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = num_threads()
        options.inter_op_num_threads = 1
        # Threads that wait busily for the next image would slow decoding and refinement down.
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        options.log_severity_level = _ERRORS_ONLY
        try:
            self.session = onnxruntime.InferenceSession(
                content, options, providers=["CPUExecutionProvider"]
            )
        except Exception as error:  # the runtime raises several types
            raise invalid_export(path, error) from error

    def run(self, pixels: Pixels) -> Arrays:
        """Return the belief maps and vector fields of images."""
        belief, field = self.session.run(OUTPUTS, {INPUT: pixels})
        return belief, field


def check_model(model: onnx.ModelProto, path: Path, size: tuple[int, int]) -> None:
    """Check that a model is one self-contained graph of ONNX's own operators.

    Args:
        model: Parsed file.
        path: File, for messages.
        size: (width, height) of the input for which tensor sizes are computed.

    Raises:
        UserError: The model has weights in other files, operators of another domain, nested graphs,
            other inputs or outputs, or a tensor that :func:`check_shapes` rejects.
    """
    import onnx

    graph = model.graph
    if model.functions or model.training_info or graph.sparse_initializer:
        problem = "a model with functions, training steps or sparse tensors"
        raise invalid_export(path, problem, "a model of one plain graph")
    for node in graph.node:
        name = f"operator {node.op_type:.60}"
        if node.domain not in _DOMAINS:
            problem = f"operator {node.domain:.60}.{node.op_type:.60}"
            raise invalid_export(path, problem, "operators of ONNX itself")
        kinds = {attribute.type for attribute in node.attribute}
        if kinds & {onnx.AttributeProto.GRAPH, onnx.AttributeProto.GRAPHS}:
            raise invalid_export(path, f"{name} with a nested graph", "a single graph")
    for tensor in _tensors(graph):
        if tensor.data_location == onnx.TensorProto.EXTERNAL or tensor.external_data:
            problem = f"tensor {tensor.name:.60} in another file"
            raise invalid_export(path, problem, "a model with all tensors in one file")
    inputs, outputs = ([value.name for value in ends] for ends in (graph.input, graph.output))
    if inputs != [INPUT] or tuple(outputs) != OUTPUTS:
        problem = f"inputs {inputs!s:.100} and outputs {outputs!s:.100}"
        raise invalid_export(path, problem, f"{INPUT} to {' and '.join(OUTPUTS)}")
    width, height = size
    check_shapes(path, _shapes(model, path, (1, 3, height, width)), width * height)


def _tensors(graph: onnx.GraphProto) -> Iterator[onnx.TensorProto]:
    """Yield every tensor that a graph contains."""
    yield from graph.initializer
    for node in graph.node:
        for attribute in node.attribute:
            yield attribute.t
            yield from attribute.tensors
            yield from (attribute.sparse_tensor.values, attribute.sparse_tensor.indices)


def _shapes(
    model: onnx.ModelProto, path: Path, pixels: tuple[int, ...]
) -> dict[str, list[int] | None]:
    """Infer every tensor's shape, by name, for an input of shape ``pixels``; None if unknown.

    The integers from which operators compute shapes are evaluated as well.
    """
    from onnx import TensorProto, defs, helper, shape_inference

    types: dict[str, Any] = {INPUT: helper.make_tensor_type_proto(TensorProto.UINT8, pixels)}
    values: dict[str, onnx.TensorProto] = {}
    for tensor in model.graph.initializer:
        types[tensor.name] = helper.make_tensor_type_proto(tensor.data_type, tensor.dims)
        if math.prod(tensor.dims) <= _SMALL:
            values[tensor.name] = tensor
    opset = max(entry.version for entry in model.opset_import if entry.domain in _DOMAINS)
    for node in model.graph.node:
        try:
            types |= shape_inference.infer_node_outputs(
                defs.get_schema(node.op_type, opset),
                node,
                {name: types[name] for name in node.input if name},
                {name: values[name] for name in node.input if name in values},
                opset_imports=list(model.opset_import),
                ir_version=model.ir_version,
            )
            values |= _evaluate(node, types, values)
        except Exception as error:  # onnx raises several types for an inconsistent graph
            raise invalid_export(path, f"operator {node.op_type:.60}: {error!r}") from error
    outputs = (name for node in model.graph.node for name in node.output if name)
    return {name: _shape(types[name]) if name in types else None for name in (*types, *outputs)}


def _shape(kind: onnx.TypeProto) -> list[int] | None:
    """Return the shape of a tensor type; None if a side is unknown."""
    tensor = kind.tensor_type
    is_known = tensor.HasField("shape") and all(s.HasField("dim_value") for s in tensor.shape.dim)
    return [side.dim_value for side in tensor.shape.dim] if is_known else None


def _evaluate(
    node: onnx.NodeProto, types: Mapping[str, Any], values: Mapping[str, onnx.TensorProto]
) -> dict[str, onnx.TensorProto]:
    """Return a node's output by name if it computes a shape from known values, else nothing."""
    from onnx import numpy_helper
    from onnx.reference import ReferenceEvaluator

    if node.op_type not in _SHAPE_OPERATORS:
        return {}
    if node.op_type == "Shape" and (shape := _shape(types[node.input[0]])) is not None:
        inputs = {node.input[0]: np.broadcast_to(np.uint8(0), shape)}
    elif node.op_type != "Shape" and all(name in values for name in node.input):
        inputs = {name: numpy_helper.to_array(values[name]) for name in node.input}
    else:
        return {}
    (output,) = ReferenceEvaluator(node).run(None, inputs)
    if output.size > _SMALL:
        return {}
    return {node.output[0]: numpy_helper.from_array(np.asarray(output), node.output[0])}
