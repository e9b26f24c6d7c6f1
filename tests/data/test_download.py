import hashlib
import logging
import socket
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path, PurePosixPath

import numpy as np
import pytest

from dopepp.core.errors import UserError
from dopepp.data import download as downloads
from dopepp.data.download import DownloadSource, download
from tests.data.makers import write_tar


class Handler(BaseHTTPRequestHandler):
    """Serves the file correctly or with the fault that the path names."""

    def do_GET(self) -> None:
        server: Server = self.server
        server.ranges.append(self.headers["Range"])
        kind, content = self.path.strip("/"), server.content
        if kind == "gone":
            self.send_error(404)
            return
        start = int(self.headers["Range"].removeprefix("bytes=").removesuffix("-"))
        if start and kind != "no-range":
            self.send_response(206)
            first = 0 if kind == "wrong-range" else start
            self.send_header("Content-Range", f"bytes {first}-{len(content) - 1}/*")
        else:
            start = 0
            self.send_response(200)
        body = bytes(len(content)) if kind == "other" else content[start:]
        if kind != "endless":
            self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body[: len(body) // 2] if kind == "cut" else body)
        if kind == "endless":
            for _ in range(8):
                self.wfile.write(content)


class Server(ThreadingHTTPServer):
    content: bytes
    ranges: list[str | None]

    def handle_error(self, *args: object) -> None:
        """Ignore clients that close the connection, as in some tests."""


@pytest.fixture
def server(monkeypatch, tmp_path_factory):
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    photo = np.random.default_rng(0).bytes(3_000_000)
    members = [("set/photos/a.jpg", photo), ("set/photos/b.jpg", b"1"), ("set/labels/a", b"2")]
    with Server(("127.0.0.1", 0), Handler) as server:
        server.ranges = []
        server.content = write_tar(tmp_path_factory.mktemp("x") / "a.tar", members).read_bytes()
        threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
        yield server
        server.shutdown()


@pytest.fixture
def get(server, tmp_path, monkeypatch):
    """Download the data set, which the server serves with a fault."""

    def get(kind="good", address=None, folder=tmp_path, **options):
        digest = hashlib.sha256(server.content).hexdigest()
        facts = len(server.content), digest, PurePosixPath("set/photos"), "free for tests"
        address = address or f"http://127.0.0.1:{server.server_port}"
        monkeypatch.setitem(downloads.SOURCES, "tiny", DownloadSource(f"{address}/{kind}", *facts))
        return download("tiny", folder, **options)

    return get


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_a_data_set_is_unpacked_once(server, get, tmp_path, caplog):
    seen = []
    with caplog.at_level(logging.INFO):
        photos = get(folder=tmp_path / "new", progress=lambda *at: seen.append(at))
    assert "free for tests" in caplog.text
    assert photos == tmp_path / "new" / "tiny" / "set" / "photos"
    assert (names(photos), names(tmp_path / "new")) == (["a.jpg", "b.jpg"], ["tiny"])
    assert seen[-1] == (len(server.content), len(server.content))
    assert get(folder=tmp_path / "new") == photos
    assert len(server.ranges) == 1


def test_a_broken_connection_is_resumed(server, get, tmp_path):
    half = len(server.content) // 2
    with pytest.raises(UserError, match=rf"broke after {half} of \d+ bytes; .*resumes"):
        get("cut")
    assert names(tmp_path) == ["tiny.tar.partial"]
    get()
    assert server.ranges == ["bytes=0-", f"bytes={half}-"]
    assert names(tmp_path) == ["tiny"]


@pytest.mark.parametrize("kind", ["good", "no-range"])
@pytest.mark.parametrize("missing", [0, 1000])
def test_any_partial_file_is_completed(server, get, tmp_path, kind, missing):
    content = server.content
    (tmp_path / "tiny.tar.partial").write_bytes(content[: len(content) - missing])
    assert names(get(kind)) == ["a.jpg", "b.jpg"]


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("other", r"a file with SHA-256 [0-9a-f]{64}; allowed: [0-9a-f]{64}; fix: run the command"),
        ("endless", "a file with SHA-256"),
        ("gone", "404: Not Found"),
    ],
)
def test_a_wrong_file_is_rejected_and_deleted(get, tmp_path, kind, message):
    with pytest.raises(UserError, match=message) as caught:
        get(kind)
    assert "\n" not in str(caught.value)
    assert names(tmp_path) == []


def test_failures_give_one_line(get, tmp_path):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with pytest.raises(UserError, match=r"/good: no connection: .*check the network"):
        get(address=f"http://127.0.0.1:{port}")
    (tmp_path / "tiny.tar.partial").write_bytes(b"1000")
    with pytest.raises(UserError, match=r"continues at 'bytes 0-.* instead of byte 4"):
        get("wrong-range")
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(UserError, match=r"file, which cannot be written"):
        get(folder=tmp_path / "file")
    (tmp_path / "tiny").mkdir()
    with pytest.raises(UserError, match="holds other files"):
        get()
