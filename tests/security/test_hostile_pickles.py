"""Checkpoints whose pickle runs code, or allocates more than the file contains."""

import builtins
import importlib
import operator
import os
import pickle
import struct
import subprocess
import zipfile
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch.utils import collect_env

from dopepp.models.backbones import VGG19
from tests.security.conftest import Call, refused, rejected

pytestmark = pytest.mark.timeout(60)

SIZE = 10**9
"""Bytes that a bomb allocates: enough to be detected, and little enough for the machine."""


def first_weight(content: dict[str, Any]) -> str:
    return next(name for name in content["state_dict"] if name.endswith("weight"))


PLACES = {
    "state_dict itself": lambda c, bad: c.update(state_dict=bad),
    "a weight": lambda c, bad: c["state_dict"].update({first_weight(c): bad}),
    "another weight": lambda c, bad: c["state_dict"].update({"loss.weight": bad}),
    "payload": lambda c, bad: c.update(dopepp=bad),
    "spec": lambda c, bad: c["dopepp"]["spec"]["backbone"].update(width=bad),
    "objects table": lambda c, bad: c["dopepp"]["parts"][0].update(name=bad),
    "ADD points": lambda c, bad: c["dopepp"]["parts"][0].update(points=bad),
    "data": lambda c, bad: c["dopepp"]["data"].update(root=bad),
    "recovery": lambda c, bad: c["dopepp"]["recovery"].update(sigma=bad),
    "optimizer state": lambda c, bad: c.update(optimizer_states=[{"state": {0: bad}}]),
    "callback state": lambda c, bad: c.update(callbacks={"ModelCheckpoint": bad}),
    "a key": lambda c, bad: c.update({"x": {"y": [bad]}}),
}


@pytest.fixture
def write(saved):
    """Write a checkpoint with a hostile object at a position."""
    return lambda place, bad: saved(lambda content: PLACES[place](content, bad))


@pytest.mark.parametrize("place", PLACES)
def test_os_system_anywhere(place, write, canary):
    path = write(place, Call(os.system, canary))
    rejected(path, r"bad\.ckpt, which torch cannot load .*the name 'posix\.system'")


CALLS = {
    "exec": (builtins.exec, "import os; os.system({command!r})"),
    "eval": (builtins.eval, "__import__('os').system({command!r})"),
    "Popen": (subprocess.Popen, "{command}"),
    "collect_env, which got through Hydra's gate": (collect_env.run, "{command}"),
    "import_module": (importlib.import_module, "antigravity"),
    "an attribute by its name": (operator.attrgetter, "system"),
    "setting the environment": (os.putenv, "DOPEPP_CANARY", "1"),
}


@pytest.mark.parametrize("name", CALLS)
def test_other_ways_to_run_code(name, write, canary):
    function, *arguments = CALLS[name]
    call = Call(function, *(text.format(command=canary) for text in arguments))
    rejected(write("data", call), "which torch cannot load .*the name '")


def test_torch_load_inside_of_a_checkpoint(write, canary, tmp_path):
    (tmp_path / "second.pkl").write_bytes(pickle.dumps(Call(os.system, canary)))
    path = write("data", Call(torch.load, str(tmp_path / "second.pkl")))
    rejected(path, r"the name 'torch\.serialization\.load'")


class Subclass(torch.Tensor):
    """A tensor of an unknown class."""


def test_a_tensor_of_another_class(write):
    tensor = torch.ones(3).as_subclass(Subclass)
    rejected(write("another weight", tensor), "which torch cannot load")


def test_methods_set_on_a_tensor(write, content):
    """``_rebuild_from_type_v2`` sets any attribute, also an attribute that a check reads."""
    weight = content["state_dict"][first_weight(content)]
    make, arguments, *_ = weight.__reduce_ex__(2)
    rebuild = torch._tensor._rebuild_from_type_v2
    path = write("a weight", Call(rebuild, make, torch.Tensor, arguments, {"layout": 0}))
    rejected(path, "_rebuild_from_type_v2")


BOMBS = {
    "bytearray": (bytearray, SIZE),
    "bytes": (bytes, SIZE),
    "storage": (torch.UntypedStorage, SIZE),
    "old tensor": (torch.FloatTensor, SIZE // 4),
    "tensor larger than its storage": (
        torch._utils._rebuild_tensor_v2, torch.zeros(1).untyped_storage(), 0, (SIZE // 4,), (1,),
        False, OrderedDict(),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", BOMBS)
@pytest.mark.parametrize("place", ["data", "optimizer state"])
def test_a_call_that_creates_a_huge_object(name, place, write):
    """torch's list of safe calls includes calls that allocate any given size."""
    try:
        path = write(place, Call(*BOMBS[name]))
    except NotImplementedError:  # torch cannot write a bare storage
        pytest.skip("cannot be written")
    assert path.stat().st_size < 1_000_000
    rejected(path, "which torch cannot load")


def repacked(source: Path, target: Path, edit: Callable[[bytes], bytes]) -> Path:
    """Copy a torch file with a changed pickle."""
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w") as new:
        for name in old.namelist():
            content = old.read(name)
            new.writestr(name, edit(content) if name.endswith(".pkl") else content)
    return target


def test_a_storage_that_reaches_beyond_its_bytes(tmp_path):
    """Some versions of torch would read beyond the storage."""
    torch.save({"dopepp": torch.arange(200.0)}, tmp_path / "good.ckpt")
    good, bad = tmp_path / "good.ckpt", tmp_path / "bad.ckpt"
    # BININT1 200 becomes BININT2 65535, in the storage and in the tensor.
    path = repacked(good, bad, lambda content: content.replace(b"K\xc8", b"M\xff\xff"))
    rejected(path, "a storage of 262140 bytes, but 800 bytes in the file")


def pickled(body: bytes) -> bytes:
    """Make a pickle of protocol 2 from its operations."""
    return b"\x80\x02" + body + b"."


OPERATIONS = {
    "a memo index of gigabytes": b"Nr\xff\xff\xff\x7f",
    "text that claims gigabytes": b"X\xff\xff\xff\xff",
    "a number that claims gigabytes": b"\x8b\xff\xff\xff\x7f",
    "bytes that claim terabytes": b"\x8e\xff\xff\xff\xff\xff\xff\x00\x00",
    "a name from the stack": b"X\x02\x00\x00\x00osX\x06\x00\x00\x00system\x93",
    "an instance by its class": b"(ios\nsystem\n",
    "an object by its class": b"(cos\nsystem\no",
    "an extension": b"\x82\x01",
    "a million sets": b"\x8f" * 1_000_000,
    "a memo that was never made": b"h\x07",
    "nothing on the stack": b"R",
    "no end": b"}" + b"(" * 100_000,
    "a persistent name": b"Pos.system\n",
    "an object that is not a storage": b"X\x06\x00\x00\x00moduleX\x01\x00\x00\x00a\x86Q",
    "another protocol": b"\x80\x05}",
    "a key of tuples in tuples": b"})" + b"\x85" * 3_000_000 + b"Ns",
}


@pytest.mark.parametrize("name", OPERATIONS)
def test_operations_that_no_checkpoint_needs(name, good, tmp_path):
    path = repacked(good, tmp_path / "bad.ckpt", lambda old: pickled(OPERATIONS[name]))
    rejected(path, r"bad\.ckpt(, which torch cannot load|, which contains a NoneType)")


def storage_reference(count: int) -> bytes:
    """Return the operations that refer to a storage of this many float32 numbers."""
    number = b"\x8a\x08" + struct.pack("<q", count)
    storage = b"X\x07\x00\x00\x00storagectorch\nFloatStorage\nX\x01\x00\x00\x000"
    return b"(" + storage + b"X\x03\x00\x00\x00cpu" + number + b"NtQ"


def legacy(content: bytes) -> bytes:
    """Make a file of torch before 1.6: five pickles, followed by the numbers."""
    magic = pickle.dumps(0x1950A86A20F9469CFC6C, 2)
    machine = pickle.dumps({"protocol_version": 1001, "little_endian": True, "type_sizes": {}}, 2)
    return magic + pickle.dumps(1001, 2) + machine + content + pickle.dumps(["0"], 2) + bytes(8)


def test_a_legacy_file_is_no_checkpoint(tmp_path, canary):
    path = tmp_path / "old.ckpt"
    torch.save({"dopepp": {}}, path, _use_new_zipfile_serialization=False)
    rejected(path, "not a torch file")
    path.write_bytes(pickle.dumps(Call(os.system, canary), 2))
    rejected(path, "not a torch file")


LEGACY = {
    "code in its content": lambda call, command: legacy(pickle.dumps(call(os.system, command), 2)),
    "code as its magic number": lambda call, command: pickle.dumps(call(os.system, command), 2),
    "a storage of terabytes": lambda *_: legacy(pickled(storage_reference(10**12))),
    "a storage of a negative size": lambda *_: legacy(pickled(storage_reference(-1))),
    "a call that fills the memory": lambda call, _: legacy(pickle.dumps(call(bytearray, SIZE), 2)),
}


@pytest.mark.parametrize("name", LEGACY)
def test_hostile_pretrained_weights(name, tmp_path, canary):
    """Pretrained weights are untrusted, and torchvision's file has the old format."""
    path = tmp_path / "vgg19.pth"
    path.write_bytes(LEGACY[name](Call, canary))
    with refused(r"vgg19\.pth, which torch cannot load"):
        VGG19(weights_path=str(path))
