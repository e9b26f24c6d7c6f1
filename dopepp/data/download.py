"""Download data sets on an explicit command.

A data set is an archive of known size and checksum. An interrupted download resumes, and an archive
is unpacked completely or not at all.

To add a data set, add a :class:`DownloadSource` to :data:`SOURCES`, with a checksum from another
server than the file.
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
"""A connection is broken after this many seconds without a byte."""

_CHUNK_BYTES: Final = 1 << 20

Progress = Callable[[int, int], None]
"""Receives the number of downloaded bytes and the size of the file."""


@dataclass(frozen=True)
class DownloadSource:
    """An archive on the network.

    Attributes:
        num_bytes: Exact size of the archive.
        photos: Folder in the archive with photos for ``virtual.backgrounds``.
        licence: Terms of use, logged before the download.
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
        # From TensorFlow Datasets and torchvision's data set prototypes.
        sha256="7d8cd951101b0957ddfd7a530bdc8a94f06121cfc1e511bb5937e973020c7508",
        photos=PurePosixPath("VOCdevkit/VOC2007/JPEGImages"),
        licence="photos from Flickr: use them within Flickr's terms of use and their authors' "
        "licences (http://host.robots.ox.ac.uk/pascal/VOC/voc2007/)",
    )
}
"""Available data sets by name."""


def download(name: str, folder: Path | str, progress: Progress | None = None) -> Path:
    """Download and unpack a data set into ``folder/NAME`` unless present; return its photo folder.

    Raises:
        UserError: The name is unknown, the network or the disk fails, or the file differs from the
            expected file. The next call resumes a failed download.
    """
    source = SOURCES.get(name)
    if source is None:
        fix = "pass one of these names"
        raise UserError(f"unknown data set {name!r}", ", ".join(SOURCES), fix)
    target = Path(folder) / name
    photos = target / source.photos
    if photos.is_dir():
        logger.info("%s exists already", photos)
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
    """Download a file; an unfinished download stays as ``NAME.partial`` in its folder.

    Args:
        url: An http or https address; redirections to other schemes or from https to http fail.
        path: Path of the file; an existing file is only checked.
        num_bytes: Exact size of the file, which limits the download.
        sha256: Checksum in hex.
        progress: See :data:`Progress`; called after each received piece.

    Raises:
        UserError: The network or the disk fails, or size or checksum differ.
    """
    partial = path.with_name(f"{path.name}.partial")
    try:
        if not path.exists():
            _receive(url, partial, num_bytes, progress)
            _verify(partial, url, sha256)
            partial.replace(path)
        elif path.stat().st_size != num_bytes:
            problem = f"{path} of {path.stat().st_size} bytes"
            raise UserError(problem, f"{num_bytes} bytes", "delete this file and download it again")
        else:
            _verify(path, url, sha256)
    except urllib.error.HTTPError as error:
        raise _failed(url, f"the server answers {error.code} {error.reason}") from error
    except urllib.error.URLError as error:
        raise _failed(url, f"no connection: {error.reason}") from error
    except (http.client.HTTPException, TimeoutError, ConnectionError) as error:
        raise _failed(url, f"the connection broke: {error or type(error).__name__}") from error
    except OSError as error:
        allowed = f"a writable folder with {num_bytes} bytes of free space"
        fix = "pass another folder, or free space; the next call resumes the download"
        raise UserError(f"{path}, which cannot be written: {error}", allowed, fix) from error


def _receive(url: str, partial: Path, num_bytes: int, progress: Progress | None) -> None:
    """Download the missing bytes of ``num_bytes``, and append them to a partial file."""
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
            raise _failed(url, f"the server continues at {start!r} instead of byte {size}")
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
    """Handler of redirections: to http and https only, and never from https to http."""

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
    """Compare a file's checksum, and delete a wrong file so that no download resumes it."""
    with path.open("rb") as file:
        actual = hashlib.file_digest(file, "sha256").hexdigest()
    if actual != sha256:
        path.unlink()
        raise _other_file(url, f"a file with SHA-256 {actual}", sha256)


def _failed(url: str, reason: str) -> UserError:
    fix = "check the network and run the command again, which resumes the download"
    return UserError(f"{url}: {reason}", "a reachable server with the file", fix)


def _other_file(url: str, problem: str, expected: str) -> UserError:
    """Return the error for a downloaded file that differs from the expected file."""
    fix = "run the command again; if this error remains, the file on the server has changed"
    return UserError(f"{url}: {problem}", expected, fix)
