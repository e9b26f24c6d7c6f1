import hashlib
import io
import logging
import socket
import threading
import urllib.request
from http.client import HTTPMessage
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path, PurePosixPath

import numpy as np
import pytest

from dopepp.core.errors import UserError
from dopepp.data import download as downloads
from dopepp.data.download import DownloadSource, _Redirects, download, fetch
from tests.data.makers import write_tar

CONTENT = np.random.default_rng(0).bytes(3_000_000)
SHA256 = hashlib.sha256(CONTENT).hexdigest()


class Handler(BaseHTTPRequestHandler):
    """Serves the file correctly or with the fault that the path names."""

    def do_GET(self) -> None:
        server: Server = self.server
        server.ranges.append(self.headers.get("Range"))
        kind, content = self.path.strip("/"), server.content
        if kind == "gone":
            self.send_error(404)
        elif kind.startswith("redirect:"):
            self.send_response(302)
            self.send_header("Location", kind.removeprefix("redirect:"))
            self.end_headers()
        elif kind == "endless":
            self.send_response(200)
            self.end_headers()
            for _ in range(8):
                self.wfile.write(content)
        else:
            start = 0
            if self.headers.get("Range") and kind != "no-range":
                start = int(self.headers["Range"].removeprefix("bytes=").removesuffix("-"))
                self.send_response(206)
                place = 0 if kind == "wrong-range" else start
                self.send_header("Content-Range", f"bytes {place}-{len(content) - 1}/*")
            else:
                self.send_response(200)
            body = content[start:]
            body = bytes(len(body)) if kind == "other" else body
            body = body + b"x" if kind == "longer" else body
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body[: len(body) // 2] if kind == "cut" else body)


class Server(ThreadingHTTPServer):
    content = CONTENT
    ranges: list[str | None]

    def handle_error(self, *args: object) -> None:
        """Ignore clients that close the connection, as in some tests."""


@pytest.fixture
def server(monkeypatch):
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    with Server(("127.0.0.1", 0), Handler) as server:
        server.ranges = []
        threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
        yield server
        server.shutdown()


def url(server: Server, kind: str) -> str:
    return f"http://127.0.0.1:{server.server_port}/{kind}"


@pytest.fixture
def get(server, tmp_path):
    """Download the file, which the server serves with a fault; return its path."""

    def get(kind, path=tmp_path / "f", **options):
        fetch(url(server, kind), path, len(CONTENT), SHA256, **options)
        return path

    return get


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_a_file_is_downloaded_completely(server, get, tmp_path):
    seen, path = [], tmp_path / "new" / "file.bin"
    get("good", path, progress=lambda *at: seen.append(at))
    assert path.read_bytes() == CONTENT
    assert names(path.parent) == ["file.bin"]
    assert seen[-1] == (len(CONTENT), len(CONTENT))
    get("good", path)
    assert len(server.ranges) == 1  # a whole file is not fetched again


def test_redirections_within_http_are_followed(server, get):
    assert get(f"redirect:{url(server, 'good')}").read_bytes() == CONTENT


def test_a_broken_connection_is_resumed(server, get, tmp_path):
    half = len(CONTENT) // 2
    message = rf"broke after {half} of 3000000 bytes; .*resumes the download"
    with pytest.raises(UserError, match=message):
        get("cut")
    assert names(tmp_path) == ["f.partial"]
    assert get("good").read_bytes() == CONTENT
    assert server.ranges == [None, f"bytes={half}-"]
    assert names(tmp_path) == ["f"]


@pytest.mark.parametrize("there", [1000, len(CONTENT), len(CONTENT) + 5])
def test_any_partial_file_is_completed(get, tmp_path, there):
    (tmp_path / "f.partial").write_bytes((CONTENT + bytes(5))[:there])
    assert get("no-range").read_bytes() == CONTENT


def test_a_server_that_resumes_at_another_byte_is_rejected(get, tmp_path):
    (tmp_path / "f.partial").write_bytes(CONTENT[:1000])
    with pytest.raises(UserError, match=r"continues at 'bytes 0-.* instead of byte 1000"):
        get("wrong-range")


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        (
            "other",
            f"a file with SHA-256 [0-9a-f]{{64}}; allowed: {SHA256}; fix: run the command again",
        ),
        ("longer", "3000001 bytes; allowed: 3000000 bytes"),
        ("endless", "more than 3000000 bytes; allowed: 3000000 bytes"),
        ("gone", "the server answers 404 Not Found"),
        ("redirect:file:///etc/passwd", "302 .*file:///etc/passwd"),
        ("redirect:ftp://127.0.0.1/x", "unknown url type: ftp"),
    ],
)
def test_a_wrong_file_is_rejected_and_deleted(get, tmp_path, kind, message):
    with pytest.raises(UserError, match=message) as caught:
        get(kind)
    assert "\n" not in str(caught.value)
    assert names(tmp_path) == []


@pytest.mark.parametrize("target", ["http://127.0.0.1/x", "HTTP://127.0.0.1/x", "ftp://a/x"])
def test_redirections_from_https_to_other_schemes_are_rejected(target):
    request = urllib.request.Request("https://host/file.tar")
    with pytest.raises(UserError, match=r"file\.tar: redirected to .*, which is not https"):
        _Redirects().redirect_request(request, io.BytesIO(), 302, "", HTTPMessage(), target)
    safe = "https://mirror/x"
    followed = _Redirects().redirect_request(request, io.BytesIO(), 302, "", HTTPMessage(), safe)
    assert followed.full_url == safe


def test_no_network_gives_one_line(tmp_path):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    for address in (f"http://127.0.0.1:{port}/x", "http://name.invalid/x"):
        with pytest.raises(UserError, match=r"/x: no connection: .*check the network"):
            fetch(address, tmp_path / "f", 1, SHA256)
    with pytest.raises(UserError, match="unknown url type"):
        fetch("file:///etc/passwd", tmp_path / "f", 1, SHA256)


def test_a_folder_that_cannot_be_written_gives_one_line(get, tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(UserError, match=r"file/f, which cannot be written"):
        get("good", tmp_path / "file" / "f")


def test_a_data_set_is_unpacked_once(server, tmp_path, monkeypatch, caplog):
    members = ("set/photos/a.jpg", "set/photos/b.jpg", "set/labels/a.xml")
    archive = write_tar(tmp_path / "tiny.tar", [(name, bytes(100)) for name in members])
    server.content, data = archive.read_bytes(), tmp_path / "data"
    digest = hashlib.sha256(server.content).hexdigest()
    facts = (len(server.content), digest, PurePosixPath("set/photos"), "free for tests")
    source = DownloadSource(url(server, "tiny.tar"), *facts)
    monkeypatch.setitem(downloads.SOURCES, "tiny", source)
    with caplog.at_level(logging.INFO):
        folder = download("tiny", data)
    assert "free for tests" in caplog.text
    assert folder == data / "tiny" / "set" / "photos"
    assert (names(folder), names(data)) == (["a.jpg", "b.jpg"], ["tiny"])
    assert download("tiny", data) == folder
    assert len(server.ranges) == 1
