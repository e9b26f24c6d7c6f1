import numpy as np
import pytest
import torch

from dopepp.core.errors import UserError
from dopepp.models import start
from dopepp.models.checkpoint import Checkpoint
from dopepp.models.network import build_network
from dopepp.models.start import start_from_checkpoint, start_from_parts
from dopepp.models.storage import read_safetensors, write_atomic
from dopepp.parts.part import Mesh, make_part
from tests.models.conftest import assert_weights, weights_of

OUTPUTS = {f"head.{k}_branches.0.1.{t}" for k in ("belief", "field") for t in ("weight", "bias")}
FAST = {"backbone_width": 0.5, "head_width": 0.5}


@pytest.fixture
def write(tmp_path):
    """Write the checkpoint of a network with one tetrahedron per object."""

    def write(spec):
        vertices = np.array([[0.0, 0, 0], [0.1, 0, 0], [0, 0.05, 0], [0, 0, 0.02]])
        mesh = Mesh(vertices, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32))
        parts = [make_part(f"part{number}", mesh) for number in range(spec["num_objects"])]
        network = build_network(spec)
        checkpoint = Checkpoint(spec, network.state_dict(), parts, (64, 64), network.stride, 1.0)
        write_atomic(checkpoint.to_file(), tmp_path / "best.ckpt")
        return network.state_dict(), tmp_path / "best.ckpt"

    return write


@pytest.mark.parametrize("num_objects", [1, 3])
@pytest.mark.parametrize("attention", ["Identity", "SE"])
def test_the_weights_of_random_parts_fill_backbone_and_trunk(make_spec, num_objects, attention):
    spec = make_spec("Pyramid", attention, "SharedTrunk", num_objects=num_objects, **FAST)
    network = build_network(spec)
    before = weights_of(network)
    assert start_from_parts(network)
    weights, _ = read_safetensors(start._FILE)
    for name, value in network.state_dict().items():
        kept = name in OUTPUTS or name.startswith("attention.")
        assert kept == (name not in weights)
        expected = before[name] if kept else weights[name].to(value.dtype)
        assert torch.equal(value, expected), name
        assert torch.isfinite(value.double()).all()


@pytest.mark.parametrize("changed", [{"backbone_width": 1.0}, {"head_width": 0.25}])
def test_a_network_of_another_shape_keeps_its_weights(make_spec, changed):
    network = build_network(make_spec("Pyramid", "Identity", "SharedTrunk", **{**FAST, **changed}))
    before = weights_of(network)
    assert not start_from_parts(network)
    assert_weights(network, before)


def test_a_checkpoint_of_another_architecture_is_refused(small_spec, write):
    _, path = write(small_spec)
    other = {**small_spec, "attention": {"_target_": "dopepp.models.attention.Identity"}}
    with pytest.raises(UserError, match="whose network differs"):
        start_from_checkpoint(build_network(other), path)


@pytest.mark.parametrize(
    ("changed", "kept"),
    [({}, set()), ({"num_objects": 2}, OUTPUTS), ({"activation": "identity"}, OUTPUTS)],
)
def test_a_checkpoint_of_other_objects_or_another_loss_leaves_the_output_layers(
    small_fast_spec, write, changed, kept
):
    weights, path = write({**small_fast_spec, **changed})
    network = build_network(small_fast_spec)
    before = weights_of(network)
    start_from_checkpoint(network, path)
    assert_weights(network, weights | {name: before[name] for name in kept})
