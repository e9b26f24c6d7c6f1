"""Data sets from the network, by an explicit command only.

To add a data set, add a :class:`Source` to :data:`SOURCES`, with a checksum from a second place
than the file's own server.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Final
from urllib.parse import urlsplit

from dopepp.data.archive import safe_extract
from dopepp.data.fetch import Progress, fetch
from dopepp.errors import UserError

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Source:
    """An archive on the network.

    Attributes:
        url: Its address; http and https only.
        num_bytes: Its exact size.
        sha256: Its checksum, hex.
        photos: The folder in it that serves as ``virtual.backgrounds``.
        licence: What its user must know before using it.
    """

    url: str
    num_bytes: int
    sha256: str
    photos: PurePosixPath
    licence: str

    @property
    def filename(self) -> str:
        """The last part of the address."""
        return PurePosixPath(urlsplit(self.url).path).name


SOURCES: Final = {
    "voc2007": Source(
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
    """Download and unpack a data set into ``folder/NAME``; one that is there is left as it is.

    Args:
        name: Key of :data:`SOURCES`.
        folder: Where to.
        progress: Told after every piece.

    Returns:
        The folder of its photos.

    Raises:
        UserError: The name is unknown, the network or the disk fails, or the file is not the one
            that is meant. What was received before a failure stays, and the next call goes on.
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
    archive = Path(folder) / source.filename
    fetch(source.url, archive, source.num_bytes, source.sha256, progress)
    safe_extract(archive, target)
    archive.unlink()
    return photos
