"""ONNX files, run by onnxruntime on the CPU.

An ONNX file can name further files, operators of libraries, and graphs within graphs; ours have
none of these, so a file with one is refused, before the runtime sees it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from dopepp.core.errors import require
from dopepp.inference.runtimes.runtime import (
    INPUT,
    OUTPUTS,
    Arrays,
    Export,
    ExportedNetwork,
    Pixels,
    check_shapes,
    num_threads,
    read_bytes,
    refused,
    unpack,
)
from dopepp.models.checkpoint import KEY, Checkpoint

if TYPE_CHECKING:
    import onnx

_DOMAINS: Final = ("", "ai.onnx")  # of operators that are ONNX's own

_SMALL: Final = 1024
"""Numbers of a constant that may be a shape or a factor; larger ones are weights."""

_OF_SHAPES: Final = (
    "Add", "Cast", "Concat", "Div", "Gather", "Mul", "Shape", "Slice", "Squeeze", "Sub",
    "Unsqueeze",
)  # fmt: skip
"""Operators by which an exporter computes a shape; none answers more than it is given."""

_ERRORS_ONLY: Final = 3


def read(path: Path) -> OnnxNetwork:
    """Read a file that anybody may have written; see :func:`check_model` for what is refused."""
    for package in ("onnx", "onnxruntime"):
        require(package, str(path), "onnx")
    import onnx

    content = read_bytes(path)
    try:
        model = onnx.load_model_from_string(content)
    except Exception as error:  # protobuf's own
        raise refused(path, "no ONNX model, or cut short") from error
    entries = {one.key: one.value for one in model.metadata_props}
    checkpoint, export = unpack(entries.get(KEY), path)
    check_model(model, path, checkpoint.input_size)
    return OnnxNetwork(content, path, checkpoint, export)


class OnnxNetwork(ExportedNetwork):
    """See :class:`ExportedNetwork`; ``content`` is the file's, checked by :func:`check_model`."""

    def __init__(self, content: bytes, path: Path, checkpoint: Checkpoint, export: Export) -> None:
        super().__init__(path, checkpoint, export)
        import onnxruntime

        onnxruntime.disable_telemetry_events()
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = num_threads()
        options.inter_op_num_threads = 1
        # Threads that wait busily for the next picture take the cores from decoding and refining.
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        options.log_severity_level = _ERRORS_ONLY
        try:
            self.session = onnxruntime.InferenceSession(
                content, options, providers=["CPUExecutionProvider"]
            )
        except Exception as error:  # the runtime's own, whatever the file leads to
            raise refused(path, error) from error

    def run(self, pixels: Pixels) -> Arrays:
        """Return what the graph answers."""
        belief, field = self.session.run(OUTPUTS, {INPUT: pixels})
        return belief, field


def check_model(model: onnx.ModelProto, path: Path, size: tuple[int, int]) -> None:
    """Check that a model is one graph of ONNX's own operators, with all it needs inside.

    ``size`` is the (width, height) for which its tensors' sizes are counted. A
    :class:`~dopepp.core.errors.UserError`: weights in other files, operators of another domain,
    graphs within graphs, other inputs or outputs, or a tensor out of proportion.
    """
    import onnx

    graph = model.graph
    if model.functions or model.training_info or graph.sparse_initializer:
        raise refused(path, "functions, training steps or sparse tensors", "one plain graph")
    for node in graph.node:
        if node.domain not in _DOMAINS:
            got = f"operator {node.domain:.60}.{node.op_type:.60}"
            raise refused(path, got, "operators of ONNX itself")
        kinds = {attribute.type for attribute in node.attribute}
        if kinds & {onnx.AttributeProto.GRAPH, onnx.AttributeProto.GRAPHS}:
            raise refused(path, f"operator {node.op_type:.60} with a graph inside", "one graph")
    for tensor in _tensors(graph):
        if tensor.data_location == onnx.TensorProto.EXTERNAL or tensor.external_data:
            raise refused(path, f"tensor {tensor.name:.60} in another file", "all in one file")
    inputs, outputs = ([one.name for one in ends] for ends in (graph.input, graph.output))
    if inputs != [INPUT] or tuple(outputs) != OUTPUTS:
        got = f"inputs {inputs!s:.100} and outputs {outputs!s:.100}"
        raise refused(path, got, f"{INPUT} to {' and '.join(OUTPUTS)}")
    width, height = size
    check_shapes(path, _shapes(model, path, (1, 3, height, width)), width * height)


def _tensors(graph: onnx.GraphProto) -> Iterator[onnx.TensorProto]:
    """Yield every tensor that a graph holds."""
    yield from graph.initializer
    for node in graph.node:
        for attribute in node.attribute:
            yield attribute.t
            yield from attribute.tensors
            yield from (attribute.sparse_tensor.values, attribute.sparse_tensor.indices)


def _shapes(
    model: onnx.ModelProto, path: Path, pixels: tuple[int, ...]
) -> dict[str, list[int] | None]:
    """Return the shape of every tensor for an input of a shape, None where it is not known.

    Operators are followed one by one; of the few whole numbers that shapes are made of, their
    values as well.
    """
    from onnx import TensorProto, defs, helper, shape_inference

    types: dict[str, Any] = {INPUT: helper.make_tensor_type_proto(TensorProto.UINT8, pixels)}
    values: dict[str, onnx.TensorProto] = {}
    for one in model.graph.initializer:
        types[one.name] = helper.make_tensor_type_proto(one.data_type, one.dims)
        if math.prod(one.dims) <= _SMALL:
            values[one.name] = one
    opset = max(one.version for one in model.opset_import if one.domain in _DOMAINS)
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
            values |= _computed(node, types, values)
        except Exception as error:  # onnx's own, of a graph that does not fit together
            raise refused(path, f"operator {node.op_type:.60}: {error!r}") from error
    answers = (name for node in model.graph.node for name in node.output if name)
    return {one: _shape(types[one]) if one in types else None for one in (*types, *answers)}


def _shape(kind: onnx.TypeProto) -> list[int] | None:
    tensor = kind.tensor_type
    known = tensor.HasField("shape") and all(one.HasField("dim_value") for one in tensor.shape.dim)
    return [one.dim_value for one in tensor.shape.dim] if known else None


def _computed(
    node: onnx.NodeProto, types: Mapping[str, Any], values: Mapping[str, onnx.TensorProto]
) -> dict[str, onnx.TensorProto]:
    """Return the values that a node answers, where it computes a shape of what is known."""
    from onnx import numpy_helper
    from onnx.reference import ReferenceEvaluator

    if node.op_type not in _OF_SHAPES:
        return {}
    if node.op_type == "Shape":
        shape = _shape(types[node.input[0]])
        if shape is None:
            return {}
        inputs = {node.input[0]: np.broadcast_to(np.uint8(0), shape)}
    elif all(name in values for name in node.input):
        inputs = {name: numpy_helper.to_array(values[name]) for name in node.input}
    else:
        return {}
    (answer,) = ReferenceEvaluator(node).run(None, inputs)
    if answer.size > _SMALL:
        return {}
    return {node.output[0]: numpy_helper.from_array(np.asarray(answer), node.output[0])}
