import gzip
import json
import tarfile
import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis.extra import numpy as hnp

from dopepp.core.errors import UserError
from dopepp.data.formats.bop.bop_models import bop_parts
from dopepp.data.formats.images import decode_runs, encode_runs
from dopepp.data.formats.problems import STRICT, Node
from dopepp.data.formats.webdataset import index_shard, members
from dopepp.data.formats.webdataset.webdataset_reader import WebdatasetReader
from dopepp.data.formats.webdataset.webdataset_writer import WebdatasetWriter
from tests.data.makers import block, contents, write_set, write_tar

K = [100.0, 0.0, 31.5, 0.0, 101.0, 23.5, 0.0, 0.0, 1.0]


@pytest.fixture
def written(parts, samples, tmp_path):
    """Write four images in two shards."""
    return write_set(WebdatasetWriter, tmp_path / "rendered", parts, samples, 998)


def test_keys_shares_and_identity(written):
    source = WebdatasetReader(written, bop_parts(written), "train_pbr")
    keys = [source.sample(index).key for index in range(4)]
    assert keys == ["000000_000998", "000000_000999", "000001_000000", "000001_000001"]
    (info,) = source.describe()
    assert info.identity["visible_fractions"] == "gt_info.json"
    parts = bop_parts(written, ["pivconnector"])
    last = WebdatasetReader(written, parts, "train_pbr", part_of=(0.75, 1), read_depth=False)
    sample = last.sample(0)
    assert (len(last), sample.key, sample.depth) == (1, keys[3], None)
    assert {instance.label for instance in sample.instances} <= {"pivconnector"}


def test_the_library_and_tarfile_read_the_shards(written, samples):
    import webdataset

    url = str(written / "train_pbr" / "shard-{000000..000001}.tar")
    stream = list(webdataset.WebDataset(url, shardshuffle=False))
    assert [item["__key__"][-6:] for item in stream] == ["000998", "000999", "000000", "000001"]
    for item, sample in zip(stream, samples, strict=True):
        image = cv2.imdecode(np.frombuffer(item["rgb.png"], np.uint8), cv2.IMREAD_COLOR)
        np.testing.assert_array_equal(image[..., ::-1], sample.image)
        truths = json.loads(item["gt.json"])
        assert [t["obj_id"] for t in truths] == [
            1 + (instance.label == "pivconnector") for instance in sample.instances
        ]
        masks = json.loads(item["mask_visib.json"])
        assert masks["0"]["size"] == [120, 160]
        assert sum(masks["0"]["counts"][1::2]) == np.sum(sample.instances[0].mask)
        assert set(masks) == set(json.loads(item["mask.json"]))
    table = json.loads((written / "train_pbr" / "key_to_shard.json").read_text())
    assert table == {item["__key__"]: int(item["__url__"][-10:-4]) for item in stream}
    path = written / "train_pbr" / "shard-000001.tar"
    with tarfile.open(path) as archive:
        for info, member in zip(archive.getmembers(), members(path), strict=True):
            assert info.name == f"{member.key}.{member.extension}"
            assert (info.offset_data, info.size) == (member.offset, member.size)
            assert (info.mtime, info.uid, info.uname) == (0, 0, "dopepp")


@given(hnp.arrays(bool, hnp.array_shapes(min_dims=2, max_dims=2, max_side=9)))
def test_runs_round_trip(mask):
    record = encode_runs(mask)
    assert sum(record["counts"]) == mask.size
    np.testing.assert_array_equal(decode_runs(record, mask.shape, Node(STRICT, "x")), mask)


def test_runs_go_down_the_columns_and_begin_with_zeros():
    mask = np.array([[1, 0, 0], [1, 1, 0]], bool)
    assert encode_runs(mask) == {"counts": [0, 2, 1, 1, 2], "size": [2, 3]}
    assert decode_runs({"counts": [6], "size": [2, 3]}, (2, 3), Node(STRICT, "x")).sum() == 0


@pytest.mark.parametrize(
    ("record", "message"),
    [
        (
            {"counts": [6], "size": [3, 2]},
            r"x: size \[3, 2\]; allowed: runs of the image's size \[2, 3\]",
        ),
        ({"counts": [5], "size": [2, 3]}, r"counts \[5\]"),
        ({"counts": [-1, 7], "size": [2, 3]}, "counts"),
        ({"counts": "abc", "size": [2, 3]}, "counts 'abc'"),
        (None, "missing"),
    ],
)
def test_damaged_runs(record, message):
    with pytest.raises(UserError, match=message):
        decode_runs(record, (2, 3), Node(STRICT, "x"))


def image_files(key: str, **changes: object) -> list[tuple[str, bytes]]:
    image = cv2.imencode(".jpg", np.full((48, 64, 3), 90, np.uint8))[1].tobytes()
    truth = {"cam_R_m2c": np.eye(3).ravel().tolist(), "cam_t_m2c": [5, -10, 250], "obj_id": 2}
    values: dict[str, object] = {
        "camera.json": {"cam_K": K, "depth_scale": 1.0},
        "gt.json": [truth | {"obj_id": 7}, truth, truth | {"cam_t_m2c": [0, 0, -1]}],
        "gt_info.json": [{"visib_fract": 0.5}] * 3,
    }
    values |= {name.replace("_json", ".json"): value for name, value in changes.items()}
    texts = [(f"{key}.{n}", json.dumps(v).encode()) for n, v in values.items() if v is not None]
    return [*texts, (f"{key}.rgb.jpg", image)]


def test_reads_a_shard_of_another_writer(tmp_path):
    folder = tarfile.TarInfo("some")
    folder.type = tarfile.DIRTYPE
    files = [
        (folder, b""),
        *(("./" + name, data) for name, data in image_files("000001_000005")),
        *image_files("000000_000007", gt_json=None, gt_info_json=None),
        ("__meta__", b"x"),
        *image_files("some/" + "x" * 150),
    ]
    for kind in (tarfile.PAX_FORMAT, tarfile.GNU_FORMAT):
        write_tar(tmp_path / "shard-000000.tar", files, format=kind)
        source = WebdatasetReader(tmp_path, [block(2)])
        samples = [source.sample(index) for index in range(len(source))]
        assert [(sample.key[:20], len(sample.instances)) for sample in samples] == [
            ("000001_000005", 1), ("000000_000007", 0), ("some/" + "x" * 15, 1),
        ]  # fmt: skip
        (instance,) = samples[0].instances
        np.testing.assert_allclose(instance.T_cam_obj[:3, 3], [0.005, -0.01, 0.25])
        np.testing.assert_allclose(instance.keypoints[8], [33.5, 19.46])
        assert (instance.visible_fraction, instance.mask, samples[0].depth) == (0.5, None, None)


def link(kind: bytes) -> tarfile.TarInfo:
    info = tarfile.TarInfo("000000_000001.rgb.png")
    info.type, info.linkname = kind, "/etc/passwd"
    return info


COMPLETE = image_files("000000_000000")


OUTSIDE = ("../000000_000001.rgb.png", "/etc/x.rgb.png", "a/../../b.rgb.png", "a\\b.rgb.png")


KINDS = (tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.FIFOTYPE, tarfile.CHRTYPE)


@pytest.mark.parametrize(
    ("files", "message"),
    [
        *(([*COMPLETE, (name, b"x")], "leads out of the archive") for name in OUTSIDE),
        *(([*COMPLETE, (link(kind), b"")], "a link, a device") for kind in KINDS),
        ([*COMPLETE, COMPLETE[-1]], "'000000_000000.rgb.jpg' twice"),
        ([*COMPLETE, ("000000_000000.rgb.png", b"x")], "two members for its image"),
        (COMPLETE[:-1], "000000_000000 without rgb"),
        (COMPLETE[1:], "000000_000000 without camera"),
        ([*COMPLETE, ("README", b"x")], "which is not KEY.EXTENSION"),
    ],
)
def test_hostile_members_are_rejected(files, message, tmp_path):
    with pytest.raises(UserError, match=message) as caught:
        index_shard(write_tar(tmp_path / "shard-000000.tar", files))
    assert "shard-000000.tar" in str(caught.value)


def test_truncated_damaged_and_oversized_archives_are_rejected(tmp_path):
    files = image_files("000000_000000") + image_files("000000_000001")
    path = write_tar(tmp_path / "shard-000000.tar", files)
    whole = path.read_bytes()
    with tarfile.open(path) as archive:
        infos = archive.getmembers()

    def refused(content, message):
        path.write_bytes(content)
        with pytest.raises(UserError, match=message):
            index_shard(path)

    ends = [info.offset for info in infos[1:]] + [infos[-1].offset_data + infos[-1].size]
    for length in (0, 100, 512, *ends, infos[3].offset_data + 5, infos[-1].offset_data + 200):
        refused(whole[:length], r"shard-000000\.tar")
    for start in (infos[0].offset, infos[3].offset, infos[-1].offset):
        damaged = bytearray(whole)
        damaged[start + 150] ^= 0x55  # within the header's checksum
        refused(damaged, "damaged")
    bomb, long_name = tarfile.TarInfo("000000_000002.rgb.png"), tarfile.TarInfo("././@LongLink")
    bomb.size = 1 << 40
    long_name.type, long_name.size = tarfile.GNUTYPE_LONGNAME, 1 << 32
    end = whole[: ends[-1] + -ends[-1] % 512]
    refused(end + bomb.tobuf() + bytes(10_240), r"2\.rgb\.png' of 1,099,512 MB")
    refused(long_name.tobuf() + bytes(10_240), r"a header of \d+ bytes")
    refused(gzip.compress(whole) + bytes(10_240), "a compressed archive")
    path.write_bytes(whole)
    index = index_shard(path)
    path.write_bytes(whole[:3000])
    with pytest.raises(UserError, match="cut short within the member at byte"):
        index.read(1, "image")


@pytest.fixture
def two_shards(tmp_path):
    for name in ("shard-000000.tar", "shard-000001.tar"):
        write_tar(tmp_path / "a" / name, COMPLETE)
    (tmp_path / "empty").mkdir()
    return tmp_path


@pytest.mark.parametrize(("shards", "message"), [
    ("a", r"shard-000001\.tar, which repeats 1 keys of .*-000000\.tar"),
    ("a/shard-00000{0,0}.tar", r"shard-000000\.tar twice"),
    ("empty", r"a folder without \*\.tar"),
    ("b", "no such file or folder"),
    ("a/shard-{000001..000002}.tar", r"shard-000002\.tar, no such file"),
    ("a/{1..999999999}.tar", "at most 100,000 shards"),
    ("a/" + "{a,b}" * 40, "at most 100,000 shards"),
    ("a/" + "x" * 5000, "at most 100,000 shards"),
    ("a/{000000", "Unbalanced braces"),
    ("https://host/shard-000000.tar", "which are not on this machine.*download_dir"),
], ids=lambda text: text[:40])  # fmt: skip
def test_repeated_keys_and_wrong_paths_are_rejected(shards, message, two_shards):
    with pytest.raises(UserError, match=message):
        WebdatasetReader(two_shards, [block(2)], shards)


@pytest.fixture
def address(tmp_path):
    handler = partial(SimpleHTTPRequestHandler, directory=str(tmp_path / "served"))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


def test_shards_are_downloaded_once_within_bounds(address, tmp_path, monkeypatch):
    def download(url=address + "/shard-{000000..000001}.tar", folder=tmp_path / "downloads"):
        return WebdatasetReader(tmp_path, [block(2)], url, download_dir=folder)

    for n in (0, 1):
        write_tar(tmp_path / "served" / f"shard-{n:06d}.tar", image_files(f"00000{n}_000000"))
    source = download()
    assert [source.sample(i).key for i in (0, 1)] == ["000000_000000", "000001_000000"]
    served = contents(tmp_path / "served")
    assert sorted(contents(tmp_path / "downloads").values()) == sorted(served.values())
    monkeypatch.setattr("dopepp.data.formats.webdataset.webdataset_reader.MAX_SHARD_BYTES", 1000)
    assert download().describe() == [source.describe()[0]]
    for arguments, message in (
        ({"folder": tmp_path / "small"}, "of over 0 GB"),
        ({"url": address + "/shard-000009.tar"}, "which cannot be downloaded"),
        *(({"url": f"{kind}:x/y.tar"}, "URLs of .*https") for kind in ("nope", "pipe", "PIPE")),
    ):
        with pytest.raises(UserError, match=message):
            download(**arguments)
    assert list((tmp_path / "small").iterdir()) == []


def test_shards_of_one_name_from_two_addresses_are_two_files(address, tmp_path):
    keys = []
    for number, folder in enumerate(("first", "second")):
        path = tmp_path / "served" / folder / "shard-000000.tar"
        write_tar(path, image_files(f"00000{number}_000000"))
        url = f"{address}/{folder}/shard-000000.tar"
        source = WebdatasetReader(tmp_path, [block(2)], url, download_dir=tmp_path / "downloads")
        keys.append(source.sample(0).key)
    assert keys == ["000000_000000", "000001_000000"]
