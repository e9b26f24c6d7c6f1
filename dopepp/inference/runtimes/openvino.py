"""OpenVINO's files, a folder with ``model.xml`` and ``model.bin``, run by OpenVINO on the CPU.

The XML can hold graphs within graphs and operators of libraries, and its constants are places in
the other file; what ours do not have is refused before the runtime sees it.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any, Final

from lxml import etree

from dopepp.core.errors import require
from dopepp.inference.runtimes.runtime import (
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
from dopepp.models.storage import MAX_HEADER_BYTES

NAME: Final = "model.xml"
WEIGHTS: Final = ".bin"

MAX_XML_BYTES: Final = 2 * MAX_HEADER_BYTES  # description and graph
_OWN: Final = re.compile(r"opset\d{1,2}", re.ASCII)  # versions of operators that are OpenVINO's own


def load_openvino(choice: str) -> Any:
    """Import OpenVINO; a :class:`~dopepp.core.errors.UserError` where its extra is missing.

    Its package reports every import to its makers, and NNCF every call, unless the package that
    does so is missing; so it is hidden from them.
    """
    require("openvino", choice, "openvino")
    sys.modules.setdefault("openvino_telemetry", None)  # type: ignore[arg-type]
    import openvino

    return openvino


def read(path: Path) -> OpenVinoNetwork:
    """Read a folder that anybody may have written, or the XML in it.

    A :class:`~dopepp.core.errors.UserError`: a file is missing, damaged or too large, the XML has
    what ours do not have, or a constant is not in the other file.
    """
    file = _find(path) if path.is_dir() else path
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
        raise refused(path, _reason(error)) from error


class OpenVinoNetwork(ExportedNetwork):
    """See :class:`ExportedNetwork`; the model is one that :func:`read` has checked."""

    def __init__(self, model: Any, path: Path, checkpoint: Checkpoint, export: Export) -> None:
        super().__init__(path, checkpoint, export)
        self.request = compiled(model).create_infer_request()

    def run(self, pixels: Pixels) -> Arrays:
        """Return what the graph answers."""
        self.request.infer([pixels])
        belief, field = (self.request.get_output_tensor(number).data.copy() for number in range(2))
        return belief, field


def compiled(model: Any) -> Any:
    """Compile a model for one image after the other, in float32 where it is not quantised.

    OpenVINO would otherwise compute in bfloat16 where the processor can, and keep its threads on
    cores that another program may be using.
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
    """Return the shape of every tensor of a model, None where it is not known."""
    return {
        f"{one.get_friendly_name()}.{number}": None
        if output.get_partial_shape().is_dynamic
        else list(output.get_shape())
        for one in model.get_ops()
        for number, output in enumerate(one.outputs())
    }


def _find(folder: Path) -> Path:
    """Return the only XML of a folder."""
    found = sorted(folder.glob("*.xml"))
    if len(found) != 1:
        allowed = "a folder written by `dopepp export --format openvino`"
        raise refused(folder, f"{len(found)} files *.xml in this folder", allowed)
    return found[0]


def _check_xml(content: bytes, num_weights: int, path: Path) -> str | None:
    """Return the description in an XML, which is one plain graph; else it is a UserError."""
    if b"<!" in content:
        raise refused(path, "an XML with declarations or comments", "layers and edges alone")
    parser = etree.XMLParser(resolve_entities=False, no_network=True, huge_tree=True)
    try:
        root = etree.fromstring(content, parser)
    except etree.XMLSyntaxError as error:
        raise refused(path, f"no XML, or cut short: {error}") from error
    for layer in root.iter("layer"):
        kind, version = layer.get("type", ""), layer.get("version", "")
        if not _OWN.fullmatch(version):
            got = f"operator {version:.60}.{kind:.60}"
            raise refused(path, got, "operators of OpenVINO itself")
        if any(str(child.tag).endswith("body") for child in layer):
            raise refused(path, f"operator {kind:.60} with a graph inside", "one graph")
        data = layer.find("data")
        if kind == "Const" and data is not None:
            ends = [str(data.get(key)) for key in ("offset", "size")]
            inside = all(one.isdecimal() and len(one) < 16 for one in ends)
            if not inside or sum(map(int, ends)) > num_weights:
                got = f"a constant of {ends[1]:.20} bytes at {ends[0]:.20} of {num_weights}"
                raise refused(path, got, "constants within the weights' file")
    entry = root.find(f"rt_info/{KEY}")
    return None if entry is None else entry.get("value")


def _reason(error: Exception) -> str:
    """Return the last line of OpenVINO's message, which says what is wrong."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[-1] if lines else ""
