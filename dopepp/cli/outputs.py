"""What ``dopepp predict`` writes: pictures and videos with poses on them, JSON and CSV.

To add an output, write a class with what :class:`Output` has.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from io import FileIO
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Final, Protocol

from dopepp.core.errors import NO_SPACE, RunError, UserError
from dopepp.core.files import PICTURES, check_target, partial_path

if TYPE_CHECKING:
    from dopepp.data.formats.bop.bop_results import BopResult
    from dopepp.drawing.pictures import VideoFile
    from dopepp.inference.frames import FrameSource
    from dopepp.inference.pose_result import PoseResult

VIDEO: Final = ".mp4"


class Output(Protocol):
    """Takes results one by one, of one source after the other."""

    def begin(self, source: FrameSource) -> None:
        """Expect the results of a source."""

    def take(self, result: PoseResult) -> None:
        """Write a result."""

    def close(self) -> None:
        """Complete what was written, however the command ends."""


class Outputs:
    """Several outputs as one; what the disk refuses is a :class:`RunError`."""

    def __init__(self, outputs: Sequence[tuple[Path, Output]]) -> None:
        self._outputs = outputs

    def begin(self, source: FrameSource) -> None:
        """Expect the results of a source."""
        self._each(lambda one: one.begin(source))

    def take(self, result: PoseResult) -> None:
        """Write a result."""
        self._each(lambda one: one.take(result))

    def _each(self, action: Callable[[Output], None]) -> None:
        for path, one in self._outputs:
            with _told(path):
                action(one)

    def __enter__(self) -> Outputs:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        with ExitStack() as stack:
            for path, one in self._outputs:
                stack.enter_context(_told(path))
                stack.callback(one.close)


class Overlays:
    """A folder with a picture for each picture, and a video for each video or camera."""

    def __init__(self, folder: Path, stride: int = 1) -> None:
        check_target(folder / "picture.png")
        self._folder, self._stride = folder, stride
        self._taken: set[str] = set()
        self._source: FrameSource | None = None
        self._video: VideoFile | None = None

    def begin(self, source: FrameSource) -> None:
        """Complete the last source's video."""
        self.close()
        self._source = source

    def take(self, result: PoseResult) -> None:
        """Write the picture, or add it to the source's video."""
        assert self._source is not None
        if result.time is None:
            path = Path(result.name)
            suffix = path.suffix if path.suffix.lower() in PICTURES else ".png"
            result.save(self._free(path.stem, suffix, path))
            return
        if self._video is None:
            from dopepp.drawing.pictures import VideoFile

            own = Path(self._source.name)
            rate = (self._source.rate or 1.0) / self._stride
            self._video = VideoFile(self._free(self._source.stem, VIDEO, own), rate)
        self._video.write(result.plot(), result.time)

    def close(self) -> None:
        """Complete the video."""
        if self._video is not None:
            video, self._video = self._video, None
            video.close()

    def _free(self, stem: str, suffix: str, source: Path) -> Path:
        """Return a name that nothing of this command has, and that is not the source itself."""
        name, number = f"{stem}{suffix}", 1
        while name in self._taken:
            number += 1
            name = f"{stem}_{number}{suffix}"
        self._taken.add(name)
        path = self._folder / name
        if path.exists() and source.exists() and path.samefile(source):
            got = f"--save {self._folder}, the folder of {source} itself"
            raise UserError(got, "a folder of its own", "choose another one")
        return path


class JsonLines:
    """A file with a line of JSON for each picture, found or not."""

    def __init__(self, path: Path) -> None:
        check_target(path)
        self._path, self._partial = path, partial_path(path)
        self._file: FileIO | None = None

    def begin(self, source: FrameSource) -> None:
        """Open the file with the first source."""
        self._file = self._file or self._partial.open("wb", buffering=0)

    def take(self, result: PoseResult) -> None:
        """Add a line, or on a full disk none."""
        assert self._file is not None
        line, end = f"{result.to_json()}\n".encode(), self._file.tell()
        if self._file.write(line) < len(line):
            self._file.truncate(end)  # no half of a line
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def close(self) -> None:
        """Put the file in its place."""
        if self._file is None:
            return
        self._file.close()
        self._partial.replace(self._path)


class BopCsv:
    """A BOP challenge file: a scene for each source, an image for each picture.

    Objects are counted from 1 in the checkpoint's order, or have the numbers in their names where
    all are called as BOP's files are, ``obj_000005``.
    """

    def __init__(self, path: Path) -> None:
        check_target(path, (".csv",))
        self._path = path
        self._rows: list[BopResult] = []
        self._scene = -1

    def begin(self, source: FrameSource) -> None:
        """Count the next scene."""
        self._scene += 1

    def take(self, result: PoseResult) -> None:
        """Keep the poses until all are known."""
        from dopepp.data.formats.bop.bop_models import model_numbers
        from dopepp.data.formats.bop.bop_results import BopResult

        numbers = model_numbers(list(result.shapes))
        seconds = sum(result.speed.values()) / 1000
        self._rows += [
            BopResult(self._scene, result.number, numbers[one.object], one.score, one.T_cam_obj,
                seconds)
            for one in result.detections
        ]  # fmt: skip

    def close(self) -> None:
        """Write the file, where anything was looked at."""
        if self._scene < 0:
            return
        from dopepp.data.formats.bop.bop_results import write_results

        write_results(self._path, self._rows)


@contextmanager
def _told(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        if error.errno in NO_SPACE:
            raise RunError(f"no space left for {path}: free some") from error
        raise RunError(f"{error.filename or path}: {error.strerror or error}") from error
