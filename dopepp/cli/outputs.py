"""Files that ``dopepp predict`` writes: images and videos with drawn poses, JSON and CSV.

To add an output, write a class with the methods of :class:`Output`.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from io import FileIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from dopepp.core.errors import RunError, UserError, system_failure, uninterrupted
from dopepp.core.files import IMAGES, check_target, partial_path

if TYPE_CHECKING:
    from dopepp.data.formats.bop.bop_results import BopResult
    from dopepp.drawing.pictures import VideoFile
    from dopepp.inference.frames import FrameSource
    from dopepp.inference.pose_result import PoseResult
    from dopepp.inference.several_views.views_result import ViewsResult


class Output(Protocol):
    """Writer of pose results to files, source by source."""

    def begin(self, source: FrameSource) -> None:
        """Prepare for the results of the next source, e.g. the frames of a video."""

    def write(self, result: Any, /) -> None:
        """Write the poses in an image (PoseResult or ViewsResult) of the current source."""

    def close(self) -> None:
        """Finish and close the files; also called after an error, with the results so far."""


class Outputs:
    """Group of (path, output) pairs for a ``with`` block; an OSError becomes a RunError.

    An interruption is postponed until all outputs have the result.
    """

    def __init__(self, outputs: Sequence[tuple[Path, Output]]) -> None:
        self._outputs = outputs

    def begin(self, source: FrameSource) -> None:
        """Call :meth:`Output.begin` of each output."""
        self._each(lambda output: output.begin(source))

    def write(self, result: PoseResult | ViewsResult) -> None:
        """Call :meth:`Output.write` of each output."""
        self._each(lambda output: output.write(result))

    def _each(self, action: Callable[[Output], None]) -> None:
        with uninterrupted():
            for path, output in self._outputs:
                with disk_errors(path):
                    action(output)

    def __enter__(self) -> Outputs:
        return self

    def __exit__(self, *_: object) -> None:
        with uninterrupted(), ExitStack() as stack:
            for path, output in self._outputs:
                stack.enter_context(disk_errors(path))
                stack.callback(output.close)


class OverlayFolder:
    """Output of images with drawn poses to a folder; videos and cameras become videos.

    ``stride`` is the number of frames of a video from one result to the next. The files of
    ``sources`` are never overwritten.
    """

    def __init__(self, folder: Path, sources: Sequence[FrameSource], stride: int = 1) -> None:
        check_target(folder / "picture.png")
        self._folder, self._stride = folder, stride
        files = [path for source in sources for path in source.paths]
        self._protected = {path.resolve() for path in files} | set(map(_resolve_folder, files))
        self._names: set[str] = set()
        self._source: FrameSource | None = None
        self._video: VideoFile | None = None

    def begin(self, source: FrameSource) -> None:
        """Close the video of the previous source, if any."""
        self.close()
        self._source = source

    def write(self, result: PoseResult) -> None:
        """Write the image with drawn poses, or append it to the current source's video."""
        assert self._source is not None
        if result.time is None:
            path = Path(result.name)
            suffix = path.suffix if path.suffix.lower() in IMAGES else ".png"
            result.save(self._new_path(path.stem, suffix))
            return
        if self._video is None:
            from dopepp.drawing.pictures import VideoFile

            path = self._new_path(self._source.stem, ".mp4")
            self._video = VideoFile(path, (self._source.rate or 1.0) / self._stride)
        self._video.write(result.plot(), result.time)

    def close(self) -> None:
        """Close the video of the current source, if any."""
        if self._video is not None:
            video, self._video = self._video, None
            video.close()

    def _new_path(self, stem: str, suffix: str) -> Path:
        """Return a path in the folder, numbered if its name was used; reject a source's path."""
        name, number = f"{stem}{suffix}", 1
        while name in self._names:
            number += 1
            name = f"{stem}_{number}{suffix}"
        self._names.add(name)
        path = self._folder / name
        if _resolve_folder(path) in self._protected:
            problem = f"--save {self._folder}, which is the folder of {path}"
            fix = "pass another folder, e.g. --save poses"
            raise UserError(problem, "a folder without the sources", fix)
        return path


class JsonLines:
    """Output of a file with a line of JSON for each image, even without detections."""

    def __init__(self, path: Path) -> None:
        check_target(path)
        self._path, self._partial = path, partial_path(path)
        self._file: FileIO | None = None

    def begin(self, source: FrameSource) -> None:
        """Open a partial file, unless it is open from a previous source."""
        self._file = self._file or self._partial.open("wb", buffering=0)

    def write(self, result: PoseResult | ViewsResult) -> None:
        """Append a line; on a full disk, remove the incomplete line and raise an OSError."""
        assert self._file is not None
        line, end = f"{result.to_json()}\n".encode(), self._file.tell()
        if self._file.write(line) < len(line):
            self._file.truncate(end)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def close(self) -> None:
        """Close the partial file, if any, and rename it to the final path."""
        if self._file is not None:
            self._file.close()
            self._partial.replace(self._path)


class BopCsv:
    """Output of poses to a CSV file in the format of the BOP challenge; each source is a scene.

    Objects are numbered from 1 in the checkpoint's order, or as in their names if all names have
    the form ``obj_000005``.
    """

    def __init__(self, path: Path) -> None:
        check_target(path, (".csv",))
        self._path, self._scene = path, -1
        self._rows: list[BopResult] = []

    def begin(self, source: FrameSource) -> None:
        """Increase the scene number."""
        self._scene += 1

    def write(self, result: PoseResult) -> None:
        """Store the poses in an image; :meth:`close` writes them."""
        from dopepp.data.formats.bop.bop_models import model_numbers
        from dopepp.data.formats.bop.bop_results import BopResult

        numbers = model_numbers(list(result.shapes))
        seconds = sum(result.speed.values()) / 1000
        for pose in result.detections:
            place = self._scene, result.number, numbers[pose.object]
            self._rows.append(BopResult(*place, pose.score, pose.T_cam_obj, seconds))

    def close(self) -> None:
        """Write the file, if :meth:`begin` was called for any source."""
        if self._scene >= 0:
            from dopepp.data.formats.bop.bop_results import write_results

            write_results(self._path, self._rows)


def _resolve_folder(path: Path) -> Path:
    """Return a path without symbolic links in its folder; the file itself may be a link."""
    return path.parent.resolve() / path.name


@contextmanager
def disk_errors(path: Path) -> Iterator[None]:
    """Convert an ``OSError`` in a ``with`` block to a :class:`RunError` that names the path."""
    try:
        yield
    except OSError as error:
        raise RunError(system_failure(error, path)) from error
