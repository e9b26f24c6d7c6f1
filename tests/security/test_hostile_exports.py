"""Exported files with a hostile graph, constants or description."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from dopepp.geometry.camera import camera_matrix
from dopepp.inference.estimator import PoseEstimator
from dopepp.models.checkpoint import parse_description
from dopepp.models.storage import MAX_HEADER_BYTES
from tests.security.conftest import refused, rejected

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")
from onnx import TensorProto, helper, numpy_helper  # noqa: E402

pytestmark = pytest.mark.timeout(60)

FLOAT = TensorProto.FLOAT
SECTION = {"format": "onnx", "precision": "fp32", "size_multiple": 8, "parameters": 1, "gmacs": 0.1}


@pytest.fixture(scope="module")
def payload(content):
    return content["dopepp"] | {"export": SECTION}


@pytest.fixture(scope="module")
def model(payload):
    """The smallest graph that returns maps: the mean of 8×8 pixels, and two 1×1 layers."""
    rng = np.random.default_rng(0)
    weights = {
        f"{name}_weight": rng.normal(size=(channels, 3, 1, 1)).astype(np.float32)
        for name, channels in (("belief", 9), ("field", 16))
    }
    nodes = [
        helper.make_node("Cast", ["pixels"], ["floats"], to=FLOAT),
        helper.make_node("AveragePool", ["floats"], ["cells"], kernel_shape=[8, 8], strides=[8, 8]),
        helper.make_node("Conv", ["cells", "belief_weight"], ["belief"]),
        helper.make_node("Conv", ["cells", "field_weight"], ["field"]),
    ]
    graph = helper.make_graph(
        nodes,
        "maps",
        [helper.make_tensor_value_info("pixels", TensorProto.UINT8, ["n", 3, "h", "w"])],
        [helper.make_tensor_value_info(first, FLOAT, ["n", k, "r", "c"]) for first, k in
         (("belief", 9), ("field", 16))],
        [numpy_helper.from_array(value, name) for name, value in weights.items()],
    )  # fmt: skip
    made = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=10)
    made.metadata_props.add(key="dopepp", value=json.dumps(payload))
    return made


@pytest.fixture
def spoilt(model, tmp_path):
    """Write the model after a function has changed it."""

    def write(edit=lambda made: None) -> Path:
        made = onnx.ModelProto()
        made.CopyFrom(model)
        edit(made)
        path = tmp_path / "a.onnx"
        path.write_bytes(made.SerializeToString())
        return path

    return write


def graph_edit(function):
    return lambda made: function(made.graph)


def external(graph):
    tensor = graph.initializer[0]
    tensor.ClearField("raw_data")
    tensor.data_location = TensorProto.EXTERNAL
    for key, value in (("location", "../../../../etc/passwd"), ("offset", "0"), ("length", "108")):
        tensor.external_data.add(key=key, value=value)


def external_constant(graph):
    node = helper.make_node("Constant", [], ["constant"], value=numpy_helper.from_array(np.ones(2)))
    external_tensor = node.attribute[0].t
    external_tensor.external_data.add(key="location", value="/etc/passwd")
    graph.node.append(node)


def behind(graph, *nodes):
    """Put nodes in front of the pooling; the last node returns ``floats``."""
    graph.node[0].output[0] = "before"
    for number, node in enumerate(nodes, 1):
        graph.node.insert(number, node)


def node(kind, inputs, output="floats", **options):
    return helper.make_node(kind, inputs, [output], **options)


def with_constant(graph, name, values):
    graph.initializer.append(numpy_helper.from_array(np.asarray(values), name))


def enlarged(graph):
    with_constant(graph, "scales", np.array([1, 1, 1e5, 1e5], np.float32))
    behind(graph, node("Resize", ["before", "", "scales"]))


def expanded(graph):
    with_constant(graph, "shape", np.array([10**6, 3, 64, 64], np.int64))
    behind(graph, node("Expand", ["before", "shape"]))


def filled(graph):
    with_constant(graph, "shape", np.array([2**40], np.int64))
    graph.node.append(node("ConstantOfShape", ["shape"], "huge"))


def by_value(graph):
    """A size that depends on the pixels."""
    graph.node.append(node("NonZero", ["pixels"], "anywhere"))


def sparse(graph):
    values = numpy_helper.from_array(np.ones(1, np.float32), "sparse")
    places = numpy_helper.from_array(np.zeros(1, np.int64), "places")
    graph.sparse_initializer.append(helper.make_sparse_tensor(values, places, [2**40]))


def branching(graph):
    body = helper.make_graph([], "body", [], [helper.make_tensor_value_info("x", FLOAT, None)])
    graph.node.append(helper.make_node("If", ["c"], ["d"], then_branch=body, else_branch=body))


def huge_weights(graph):
    graph.initializer[0].dims[:] = [2**20, 2**20, 2**10, 1]


GRAPHS = {
    "weights in another file": (graph_edit(external), "belief_weight in another file"),
    "a constant in another file": (graph_edit(external_constant), "in another file"),
    "an operator of a library": (
        graph_edit(lambda graph: behind(graph, node("PyOp", ["before"], domain="ai.onnx.contrib"))),
        r"operator ai\.onnx\.contrib\.PyOp",
    ),
    "an operator that there is not": (
        graph_edit(lambda graph: behind(graph, node("Launch", ["before"]))), "Launch",
    ),
    "a function": (
        lambda made: made.functions.append(helper.make_function(
            "mine", "f", [], [], [], [helper.make_opsetid("", 20)])), "functions",
    ),
    "a branch": (graph_edit(branching), "operator If with a nested graph"),
    "sparse weights": (graph_edit(sparse), "sparse tensors"),
    "an enlargement": (graph_edit(enlarged), "tensor floats of .* numbers"),
    "an expansion": (graph_edit(expanded), "tensor floats of .* numbers"),
    "a constant of terabytes": (graph_edit(filled), "tensor huge of 1099511627776 numbers"),
    "a size by value": (graph_edit(by_value), "tensor anywhere of unknown size"),
    "weights of a lied size": (graph_edit(huge_weights), r"a\.onnx: "),
    "another input": (
        graph_edit(lambda graph: graph.input.append(
            helper.make_tensor_value_info("more", FLOAT, [1]))), "inputs .*more",
    ),
    "a missing output": (graph_edit(lambda graph: graph.output.pop()), "outputs .'belief'."),
    "an edge to nowhere": (graph_edit(lambda graph: graph.node[1].input.__setitem__(0, "nowhere")),
                           r"a\.onnx: "),
}  # fmt: skip


@pytest.mark.parametrize("name", GRAPHS)
def test_a_graph_with_other_operations_than_an_export(name, spoilt):
    edit, message = GRAPHS[name]
    rejected(spoilt(edit), message)


def test_the_unchanged_file_loads_with_its_own_shape_only(spoilt):
    estimator = PoseEstimator.load(spoilt())
    belief, field = estimator.network.maps(torch.zeros(2, 3, 64, 40, dtype=torch.uint8))
    assert (belief.shape, field.shape) == ((2, 9, 8, 5), (2, 16, 8, 5))

    def widened(made):
        made.graph.initializer[0].CopyFrom(
            numpy_helper.from_array(np.ones((18, 3, 1, 1), np.float32), "belief_weight")
        )

    other = PoseEstimator.load(spoilt(widened))
    with refused(r"maps of shape \(1, 18, 8, 8\)"):
        other.predict(np.zeros((64, 64, 3), np.uint8), camera_matrix(64, 64, 31.5, 31.5))


ATTACK = {"_target_": "os.system", "command": "touch canary"}
DESCRIPTIONS = {
    "none": (None, "no description"),
    "cut": ('{"spec": {"backbone": {"_target_"', "line 1, column"),
    "a list": ("[1]", "a description of type list"),
    "too long": (" " * (MAX_HEADER_BYTES + 1), "a description of 16000001"),
    "a call": ({"spec": {"backbone": ATTACK}}, "backbone _target_ 'os.system'"),
    "a call by its name": ({"spec": {"head": "os.system"}}, "head _target_ 'os.system'"),
    "a spec of another kind": ({"spec": {}}, "a model spec with"),
    "no parts": ({"parts": []}, "0 parts"),
    "a newer version": ({"format_version": 99}, "format_version 99"),
    "a stride of none": ({"stride": 0}, "stride=0"),
    "an input of gigapixels": ({"input_size": [2**20, 2**20]}, "input_size"),
    "a multiple of gigapixels": ({"export": {"size_multiple": 2**30}}, "1073741824"),
    "a multiple of nothing": ({"export": {"size_multiple": 7}}, "size_multiple 7"),
    "a rate of text": ({"export": {"add_01d": {"int8": "1"}}}, "int8='1'"),
    "another field": ({"export": {"code": "import os"}}, r"export\.code"),
    "no section": ({"export": None}, "export=None"),
}


"""Texts, or changes of the payload; a mapping that is not empty is merged into the old one."""


@pytest.mark.parametrize("name", DESCRIPTIONS)
def test_a_wrong_description(name, payload, spoilt):
    text, message = DESCRIPTIONS[name]
    if isinstance(text, dict):
        is_merged = {key: isinstance(new, dict) and new != {} for key, new in text.items()}
        merged = {key: payload[key] | new if is_merged[key] else new for key, new in text.items()}
        text = json.dumps(payload | merged)

    def edit(made):
        del made.metadata_props[:]
        if text is not None:
            made.metadata_props.add(key="dopepp", value=text)

    rejected(spoilt(edit), message)


def replaced(pattern: str, by: str):
    return lambda xml: re.sub(pattern, by, xml)


ENTITIES = '<!DOCTYPE net [<!ENTITY a "aaaaaaaaaa">]>'


STRIDE = "&quot;stride&quot;: "


def test_other_files_than_onnx(spoilt, good, tmp_path):
    whole = spoilt().read_bytes()
    path = tmp_path / "b.onnx"
    for content in (b"", whole[:-700], whole[:40], good.read_bytes(), b"\xff" * 1000, b"[]"):
        path.write_bytes(content)
        rejected(path, r"b\.onnx: (not an ONNX model|no description)")
    with path.open("wb") as file:
        file.truncate(2**40)
    rejected(path, "more than 1073.74 MB")
    rejected(tmp_path / "c.onnx", r"c\.onnx: no such file")


def test_a_description_builds_nothing(payload, canary):
    """Parsing imports no target; only :func:`build_network` does, after checking the target."""
    described = parse_description(payload | {"data": {"masking": ATTACK | {"command": canary}}})
    assert described.state_dict == {}


@pytest.fixture(scope="module")
def translated(model, tmp_path_factory):
    """The same model, written by OpenVINO."""
    pytest.importorskip("openvino")
    from dopepp.inference.runtimes.openvino import load_openvino

    openvino, path = load_openvino("test"), tmp_path_factory.mktemp("openvino")
    onnx.save(model, path / "a.onnx")
    translated = openvino.convert_model(path / "a.onnx")
    translated.set_rt_info(model.metadata_props[0].value, ["dopepp"])
    openvino.save_model(translated, path / "a" / "model.xml", compress_to_fp16=False)
    return path / "a"


@pytest.fixture
def folder(translated, tmp_path):
    return shutil.copytree(translated, tmp_path / "a")


XMLS = {
    "cut": (lambda xml: xml[:3000], "not an XML file, or truncated"),
    "nothing": (lambda xml: "", "not an XML file, or truncated"),
    "entities": (lambda xml: ENTITIES + xml, "declarations or comments"),
    "an operator of a library": (
        lambda xml: xml.replace('version="opset1"', 'version="extension"', 1),
        r"operator extension\.",
    ),
    "a graph inside": (lambda xml: xml.replace("<output>", "<body/><output>", 1), "nested graph"),
    "a constant beyond": (replaced(r'offset="\d+"', 'offset="99999999"'), "of 9999|offset 9999"),
    "a negative constant": (replaced(r'offset="\d+"', 'offset="-8"'), "offset -8"),
    "a constant of terabytes": (replaced('shape="9, ?3,', 'shape="1099511627776, 3,'), "a: "),
    "an unknown operator": (replaced('"Convolution"', '"Launch"'), "Launch"),
    "no description": (replaced(r"<dopepp [^>]*>", ""), "no description"),
    "a cut text": (replaced(r'(<dopepp value=".{200})[^>]*>', r'\1"/>'), "line 1, column"),
    "a call": (replaced(r"dopepp\.models\.backbones\.DSC", "os.system"), "os.system"),
    "a longer stride": (replaced(f"{STRIDE}8", f"{STRIDE}0"), "stride=0"),
}


@pytest.mark.parametrize("name", XMLS)
def test_an_openvino_file_with_other_operations_than_an_export(name, folder):
    edit, message = XMLS[name]
    path = folder / "model.xml"
    xml = path.read_text()
    assert edit(xml) != xml
    path.write_text(edit(xml))
    rejected(folder, message)


def test_an_incomplete_openvino_folder(folder, tmp_path):
    moved = tmp_path / "moved"
    shutil.copytree(folder, moved)
    assert PoseEstimator.load(moved).parts[0].name == "bracket"
    weights = moved / "model.bin"
    weights.write_bytes(weights.read_bytes()[:-40])
    rejected(moved, "a constant of")
    weights.unlink()
    rejected(moved, "no such file")
    (moved / "model.xml").rename(moved / "other.txt")
    rejected(moved, r"0 files \*\.xml in this folder")
