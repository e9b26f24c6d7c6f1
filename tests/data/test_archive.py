import gzip
import os
import tarfile
from pathlib import Path
from typing import Any

import pytest

from dopepp.core.errors import UserError
from dopepp.data.archive import safe_extract
from tests.data.makers import contents, write_tar

GOOD = [("set/a.txt", b"hello" * 1000), ("set/deep/b.bin", bytes(range(256))), ("c", b"")]


def unpack(folder: Path, content: bytes | list[Any]) -> Path:
    """Unpack an archive, which consists of bytes or of members."""
    archive = folder / "archive"
    write_tar(archive, content) if isinstance(content, list) else archive.write_bytes(content)
    return safe_extract(archive, folder / "out")


def assert_rejected(folder: Path, content: bytes | list[Any], message: str) -> None:
    """Check for an error of one line, and that no unpacked file remains."""
    with pytest.raises(UserError, match=message) as caught:
        unpack(folder, content)
    assert "\n" not in str(caught.value)
    assert [path.name for path in folder.iterdir()] == ["archive"]


def test_a_tar_file_is_unpacked_completely(tmp_path):
    files = contents(unpack(tmp_path, GOOD))
    assert files == dict(GOOD) | {"set": b"", "set/deep": b""}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["archive", "out"]


def test_folders_may_be_repeated_and_permissions_are_ignored(tmp_path):
    again, script = tarfile.TarInfo("set"), tarfile.TarInfo("run")
    again.type, script.mode, script.uid = tarfile.DIRTYPE, 0o6777, 0
    folder = unpack(tmp_path, [("./set/a", b"1"), (again, b""), (again, b""), (script, b"#!")])
    assert (folder / "set" / "a").read_bytes() == b"1"
    assert (folder / "run").stat().st_mode & 0o6111 == 0


def test_an_empty_folder_is_used_and_a_filled_folder_rejected(tmp_path):
    (tmp_path / "out").mkdir()
    unpack(tmp_path, GOOD)
    with pytest.raises(UserError, match=r"out, which is not empty or not a folder; allowed: a new"):
        unpack(tmp_path, GOOD)
    assert (tmp_path / "out" / "set" / "a.txt").exists()


@pytest.mark.parametrize(
    "name", ["../x", "set/../../x", "/etc/x", "set\\..\\x", "C:x", "a\nb", "x" * 300, "d/" * 900]
)
def test_a_path_out_of_the_folder_is_rejected(tmp_path, name):
    folder = tmp_path / "inner"
    folder.mkdir()
    message = "leads out of the folder|a name that some systems cannot write"
    assert_rejected(folder, [("good", b"1"), (name, b"2")], message)
    assert [path.name for path in tmp_path.iterdir()] == ["inner"]


def test_the_number_of_members_is_limited(tmp_path, monkeypatch):
    members = [(f"file{number}", bytes(10)) for number in range(10)]
    monkeypatch.setattr("dopepp.data.archive.MAX_MEMBERS", 9)
    assert_rejected(tmp_path, members, "more than 9 members")
    monkeypatch.setattr("dopepp.data.archive.MAX_MEMBERS", 10)
    assert unpack(tmp_path, members).is_dir()


def test_damaged_and_missing_archives_are_rejected(tmp_path):
    members = [("a", os.urandom(5000)), ("b", os.urandom(5000))]
    content = write_tar(tmp_path / "archive", members).read_bytes()
    junk, compressed = b"junk" * 500, gzip.compress(content)
    for damaged in (content[:0], content[:300], content[:7000], junk, compressed):
        assert_rejected(tmp_path, damaged, "damaged")
    for archive in (tmp_path, tmp_path / "gone.tar"):
        with pytest.raises(UserError, match="no such file"):
            safe_extract(archive, tmp_path / "out")


def test_an_interrupt_leaves_nothing(tmp_path, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("dopepp.data.archive._unpack", interrupted)
    with pytest.raises(KeyboardInterrupt):
        unpack(tmp_path, GOOD)
    assert [path.name for path in tmp_path.iterdir()] == ["archive"]
