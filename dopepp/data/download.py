"""Download data sets on an explicit command.

A data set is a tar file of known size and checksum. An interrupted download resumes, and the file
is unpacked completely or not at all.

To add a data set, add a :class:`DownloadSource` to :data:`SOURCES`, with a checksum from another
server than the file.
"""

from __future__ import annotations

import hashlib
import http.client
import logging
import tarfile
import urllib.error
import urllib.request
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Final

from dopepp.core.errors import UserError
from dopepp.core.files import draft

logger = logging.getLogger(__name__)

_TIMEOUT_S: Final = 30.0  # without a byte, after which a connection counts as broken
_CHUNK_BYTES: Final = 1 << 20

Progress = Callable[[int, int], None]
"""Receives the number of downloaded bytes and the size of the file."""


@dataclass(frozen=True)
class DownloadSource:
    """A tar file on the network.

    Attributes:
        num_bytes: Exact size, which limits the download.
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
        UserError: The name is unknown, ``folder/NAME`` holds other files, the network or the disk
            fails, or the file differs from the expected file. The next call resumes a download.
    """
    source = SOURCES.get(name)
    if source is None:
        raise UserError(f"unknown data set {name!r}", ", ".join(SOURCES), "pass one of these names")
    target = Path(folder) / name
    photos = target / source.photos
    if photos.is_dir():
        logger.info("%s exists already", photos)
        return photos
    if target.exists():
        raise UserError(f"{target}, which holds other files", "a new folder", "pass another --out")
    logger.info("%s: %.0f MB from %s; %s", name, source.num_bytes / 1e6, source.url, source.licence)
    archive = Path(folder) / f"{name}.tar.partial"
    try:
        _receive(source, archive, progress)
        _verify(source, archive)
        # The checksum is right, so the members are known and harmless.
        with draft(target) as unpacked, tarfile.open(archive) as tar:
            tar.extractall(unpacked, filter="data")
        archive.unlink()
    except (urllib.error.URLError, http.client.HTTPException, TimeoutError, ConnectionError) as e:
        reason = e if isinstance(e, urllib.error.HTTPError) else getattr(e, "reason", e)
        raise _failed(source, f"no connection: {reason or type(e).__name__}") from e
    except OSError as error:
        allowed = f"a writable folder with {2 * source.num_bytes} bytes of free space"
        fix = "pass another folder, or free space; the next call resumes the download"
        raise UserError(f"{folder}, which cannot be written: {error}", allowed, fix) from error
    return photos


def _receive(source: DownloadSource, path: Path, progress: Progress | None) -> None:
    """Download the bytes that the file at ``path`` lacks."""
    size = path.stat().st_size if path.exists() else 0
    if size >= source.num_bytes:
        return
    headers = {"User-Agent": "dopepp", "Range": f"bytes={size}-"}
    request = urllib.request.Request(source.url, headers=headers)
    with urllib.request.urlopen(request, timeout=_TIMEOUT_S) as response:
        resumed = response.status == http.client.PARTIAL_CONTENT
        start = response.headers.get("Content-Range", "")
        if resumed and not start.startswith(f"bytes {size}-"):
            raise _failed(source, f"the server continues at {start!r} instead of byte {size}")
        path.parent.mkdir(parents=True, exist_ok=True)
        size = size if resumed else 0
        with path.open("ab" if resumed else "wb") as file:
            while size <= source.num_bytes and (chunk := response.read(_CHUNK_BYTES)):
                size += file.write(chunk)
                if progress is not None:
                    progress(size, source.num_bytes)
    if size < source.num_bytes:
        raise _failed(source, f"the connection broke after {size} of {source.num_bytes} bytes")


def _verify(source: DownloadSource, path: Path) -> None:
    """Compare a file's checksum, and delete a wrong file so that no download resumes it."""
    with path.open("rb") as file:
        actual = hashlib.file_digest(file, "sha256").hexdigest()
    if actual != source.sha256:
        path.unlink()
        fix = "run the command again; if this error remains, the file on the server has changed"
        problem = f"{source.url}: a file with SHA-256 {actual}"
        raise UserError(problem, source.sha256, fix)


def _failed(source: DownloadSource, reason: str) -> UserError:
    fix = "check the network and run the command again, which resumes the download"
    return UserError(f"{source.url}: {reason}", "a reachable server with the file", fix)
