"""Data sets from the network, by an explicit command only.

Each is one archive of a known size and checksum, whose download goes on where it was cut off, and
which is there whole or not at all.

To add a data set, add a :class:`DownloadSource` to :data:`SOURCES`, its checksum from a second
place than the file's own server.
"""

from __future__ import annotations

import hashlib
import http.client
import logging
import urllib.error
import urllib.request
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, Final
from urllib.parse import urlsplit

from dopepp.core.errors import UserError
from dopepp.data.archive import safe_extract

logger = logging.getLogger(__name__)

TIMEOUT_S: Final = 30.0
"""Seconds without a byte after which a connection counts as broken."""

_CHUNK_BYTES: Final = 1 << 20

Progress = Callable[[int, int], None]
"""Receives the number of bytes so far, and of the whole file."""


@dataclass(frozen=True)
class DownloadSource:
    """An archive on the network.

    Attributes:
        photos: The folder in it that serves as ``virtual.backgrounds``.
        licence: What its user must know before using it.
    """

    url: str
    num_bytes: int
    sha256: str
    photos: PurePosixPath
    licence: str


SOURCES: Final = {
    "voc2007": DownloadSource(
        url="http://host.robots.ox.ac.uk/pascal/VOC/voc2007/VOCtrainval_06-Nov-2007.tar",
        num_bytes=460_032_000,
        # As TensorFlow Datasets and torchvision's data set prototypes give it.
        sha256="7d8cd951101b0957ddfd7a530bdc8a94f06121cfc1e511bb5937e973020c7508",
        photos=PurePosixPath("VOCdevkit/VOC2007/JPEGImages"),
        licence="photos from Flickr: use them within Flickr's terms of use and their authors' "
        "licences (http://host.robots.ox.ac.uk/pascal/VOC/voc2007/)",
    )
}
"""What can be downloaded, by name."""


def download(name: str, folder: Path | str, progress: Progress | None = None) -> Path:
    """Download and unpack a data set into ``folder/NAME``, unless present; return its photos.

    Raises:
        UserError: The name is unknown, the network or the disk fails, or the file is another one
            than expected. What was received before a failure stays, and the next call continues.
    """
    source = SOURCES.get(name)
    if source is None:
        raise UserError(f"unknown data set {name!r}", ", ".join(SOURCES), "choose from this list")
    target = Path(folder) / name
    photos = target / source.photos
    if photos.is_dir():
        logger.info("%s is there already", photos)
        return photos
    logger.info("%s: %.0f MB from %s; %s", name, source.num_bytes / 1e6, source.url, source.licence)
    archive = Path(folder) / PurePosixPath(urlsplit(source.url).path).name
    fetch(source.url, archive, source.num_bytes, source.sha256, progress)
    safe_extract(archive, target)
    archive.unlink()
    return photos


def fetch(
    url: str, path: Path, num_bytes: int, sha256: str, progress: Progress | None = None
) -> None:
    """Download one file; an unfinished one stays beside its place as ``NAME.partial``.

    Args:
        url: An http or https address; redirections to others are refused, and from https to http.
        path: Target; a complete file there is kept.
        num_bytes: The file's exact size; not a byte more is received.
        sha256: Its checksum, hex.
        progress: Called after every piece.
    """
    partial = path.with_name(f"{path.name}.partial")
    try:
        if not path.exists():
            _receive(url, partial, num_bytes, progress)
            _verify(partial, url, sha256)
            partial.replace(path)
        elif path.stat().st_size != num_bytes:
            problem = f"{path} of {path.stat().st_size} bytes"
            raise UserError(problem, f"{num_bytes} bytes", "delete it")
        else:
            _verify(path, url, sha256)
    except urllib.error.HTTPError as error:
        raise _failed(url, f"the server answers {error.code} {error.reason}") from error
    except urllib.error.URLError as error:
        raise _failed(url, f"no connection: {error.reason}") from error
    except (http.client.HTTPException, TimeoutError, ConnectionError) as error:
        raise _failed(url, f"the connection broke: {error or type(error).__name__}") from error
    except OSError as error:
        raise UserError(
            f"{path}, which cannot be written: {error}",
            f"a folder to write to with {num_bytes} bytes of room",
            "choose another folder, or make room; what was received stays",
        ) from error


def _receive(url: str, partial: Path, num_bytes: int, progress: Progress | None) -> None:
    """Append the missing bytes to a partial file."""
    size = partial.stat().st_size if partial.exists() else 0
    if size > num_bytes:
        partial.unlink()
        size = 0
    if size == num_bytes:
        return
    if urlsplit(url).scheme not in ("http", "https"):
        raise _failed(url, f"unknown url type: {urlsplit(url).scheme}")
    request = urllib.request.Request(url, headers={"User-Agent": "dopepp"})
    if size:
        request.add_header("Range", f"bytes={size}-")
    opener = urllib.request.build_opener(_Redirects)  # takes proxies from the environment
    with opener.open(request, timeout=TIMEOUT_S) as response:
        resumed = response.status == http.client.PARTIAL_CONTENT
        start = response.headers.get("Content-Range", "")
        if resumed and not start.startswith(f"bytes {size}-"):
            raise _failed(url, f"the server goes on at {start!r} instead of byte {size}")
        size = size if resumed else 0
        # The length is None where the server does not state it.
        if response.length is not None and size + response.length != num_bytes:
            raise _other_file(url, f"{size + response.length} bytes", f"{num_bytes} bytes")
        partial.parent.mkdir(parents=True, exist_ok=True)
        with partial.open("ab" if resumed else "wb") as file:
            while chunk := response.read(_CHUNK_BYTES):
                size += len(chunk)
                if size > num_bytes:
                    break
                file.write(chunk)
                if progress is not None:
                    progress(size, num_bytes)
    if size > num_bytes:
        partial.unlink()
        raise _other_file(url, f"more than {num_bytes} bytes", f"{num_bytes} bytes")
    if size < num_bytes:
        raise _failed(url, f"the connection broke after {size} of {num_bytes} bytes")


class _Redirects(urllib.request.HTTPRedirectHandler):
    """Follow redirections to the web only, and from https to nothing that others can change."""

    def redirect_request(
        self, req: urllib.request.Request, fp: Any, code: int, msg: str, headers: Any, newurl: str
    ) -> urllib.request.Request | None:
        scheme = urlsplit(newurl).scheme.lower()
        if req.type == "https" and scheme != "https":
            raise _failed(req.full_url, f"redirected to {newurl}, which is not https")
        if scheme not in ("http", "https"):
            raise _failed(req.full_url, f"redirected to {newurl}, an unknown url type: {scheme}")
        return super().redirect_request(req, fp, code, msg, headers, newurl)


def _verify(path: Path, url: str, sha256: str) -> None:
    """Compare a file's checksum; delete another file, so that it is neither resumed nor kept."""
    with path.open("rb") as file:
        actual = hashlib.file_digest(file, "sha256").hexdigest()
    if actual != sha256:
        path.unlink()
        raise _other_file(url, f"a file with SHA-256 {actual}", sha256)


def _failed(url: str, reason: str) -> UserError:
    return UserError(
        f"{url}: {reason}",
        "a server that can be reached and has the file",
        "check the network and run the same command again: it goes on where it stopped",
    )


def _other_file(url: str, problem: str, expected: str) -> UserError:
    fix = "try again; if it stays so, the file on the server has changed"
    return UserError(f"{url}: {problem}", expected, fix)
