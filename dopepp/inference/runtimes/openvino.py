"""OpenVINO files, a folder with ``model.xml`` and ``model.bin``, run by OpenVINO on the CPU.

The XML can contain nested graphs and operators of libraries, and its constants are offsets into the
weights file. Content that ``dopepp export`` does not write is rejected before OpenVINO reads it.
"""

from __future__ import annotations

import re
import sys
import threading
from pathlib import Path
from typing import Any, Final

from lxml import etree

from dopepp.core.errors import require
from dopepp.core.pool import num_threads
from dopepp.inference.runtimes import (
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
from dopepp.models.storage import MAX_HEADER_BYTES

NAME: Final = "model.xml"
WEIGHTS: Final = ".bin"

MAX_XML_BYTES: Final = 2 * MAX_HEADER_BYTES  # description and graph
_OPSET: Final = re.compile(r"opset\d{1,2}", re.ASCII)  # versions of OpenVINO's own operators


def load_openvino(choice: str) -> Any:
    """Import OpenVINO without its telemetry.

    If the telemetry package is installed, OpenVINO reports every import to its developers, and NNCF
    reports every call. This function therefore hides the package from OpenVINO and NNCF.

    Args:
        choice: The user's choice that requires OpenVINO, for messages.

    Raises:
        UserError: The extra ``openvino`` is not installed.
    """
    require("openvino", choice, "openvino")
    sys.modules.setdefault("openvino_telemetry", None)  # type: ignore[arg-type]
    import openvino

    return openvino


def read_network(path: Path) -> OpenVinoNetwork:
    """Read an OpenVINO export, given as a folder or as its XML file. The files are not trusted.

    Raises:
        UserError: A file is missing, damaged or too large, the XML has content that ``dopepp
            export`` does not write, or a constant exceeds the weights file.
    """
    file = path
    if path.is_dir():
        candidates = sorted(path.glob("*.xml"))
        if len(candidates) != 1:
            allowed = "a folder written by `dopepp export --format openvino`"
            raise invalid_export(path, f"{len(candidates)} files *.xml in this folder", allowed)
        file = candidates[0]
    openvino = load_openvino(str(path))
    xml = read_bytes(file, MAX_XML_BYTES)
    weights = read_bytes(file.with_suffix(WEIGHTS))
    checkpoint, export = unpack(_check_xml(xml, len(weights), path), path)
    width, height = checkpoint.input_size
    try:
        model = openvino.Core().read_model(xml, weights)
        sized = model.clone()
        sized.reshape({sized.inputs[0]: [1, 3, height, width]})
        check_shapes(path, _shapes(sized), width * height)
        return OpenVinoNetwork(model, path, checkpoint, export)
    except RuntimeError as error:
        # The last line of OpenVINO's message is the cause.
        lines = [line.strip() for line in str(error).splitlines() if line.strip()]
        raise invalid_export(path, lines[-1] if lines else "") from error


class OpenVinoNetwork(ExportedNetwork):
    """An OpenVINO model that :func:`read_network` has checked."""

    def __init__(self, model: Any, path: Path, checkpoint: Checkpoint, export: Export) -> None:
        super().__init__(path, checkpoint, export)
        self.request = compile_model(model).create_infer_request()
        self._is_idle = threading.Lock()  # a request serves one thread at a time

    def run(self, pixels: Pixels) -> Arrays:
        """Return the belief maps and vector fields of images."""
        with self._is_idle:
            self.request.infer([pixels])
            tensors = [self.request.get_output_tensor(number) for number in range(2)]
            belief, field = (tensor.data.copy() for tensor in tensors)
        return belief, field


def compile_model(model: Any) -> Any:
    """Compile a model for single images, in float32 unless it is quantised.

    By default, OpenVINO computes in bfloat16 on some processors, and pins its threads to cores that
    another program may be using.
    """
    options = {
        "ENABLE_CPU_PINNING": False,
        "INFERENCE_NUM_THREADS": num_threads(),
        "INFERENCE_PRECISION_HINT": "f32",
        "NUM_STREAMS": 1,
        "PERFORMANCE_HINT": "LATENCY",
    }
    return load_openvino("an exported network").Core().compile_model(model, "CPU", options)


def _shapes(model: Any) -> dict[str, list[int] | None]:
    """Return the shape of every tensor of a model, by name; None if unknown."""
    return {
        f"{node.get_friendly_name()}.{number}": None
        if output.get_partial_shape().is_dynamic
        else list(output.get_shape())
        for node in model.get_ops()
        for number, output in enumerate(node.outputs())
    }


def _check_xml(content: bytes, num_weights: int, path: Path) -> str | None:
    """Reject nested graphs and constants outside the weights file; return the XML's metadata."""
    if b"<!" in content:
        problem = "an XML file with declarations or comments"
        raise invalid_export(path, problem, "an XML file of layers and edges only")
    parser = etree.XMLParser(resolve_entities=False, no_network=True, huge_tree=True)
    try:
        root = etree.fromstring(content, parser)
    except etree.XMLSyntaxError as error:
        raise invalid_export(path, f"not an XML file, or truncated: {error}") from error
    for layer in root.iter("layer"):
        kind, version = layer.get("type", ""), layer.get("version", "")
        if not _OPSET.fullmatch(version):
            problem = f"operator {version:.60}.{kind:.60}"
            raise invalid_export(path, problem, "operators of OpenVINO itself")
        if any(str(child.tag).endswith("body") for child in layer):
            problem = f"operator {kind:.60} with a nested graph"
            raise invalid_export(path, problem, "a single graph")
        data = layer.find("data")
        if kind == "Const" and data is not None:
            span = [str(data.get(key)) for key in ("offset", "size")]
            are_numbers = all(text.isdecimal() and len(text) < 16 for text in span)
            if not are_numbers or sum(map(int, span)) > num_weights:
                problem = f"a constant of {span[1]:.20} bytes at offset {span[0]:.20}"
                allowed = f"constants within the {num_weights} bytes of the weights' file"
                raise invalid_export(path, problem, allowed)
    entry = root.find(f"rt_info/{KEY}")
    return None if entry is None else entry.get("value")
