"""What every source of pictures hands out, and what it tells of itself."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

from dopepp.drawing.pictures import Picture
from dopepp.geometry.camera_file import Camera


@dataclass(frozen=True, eq=False)
class Frame:
    """One picture of a source.

    Attributes:
        image: RGB, as the camera took it.
        name: The picture's file, or the source where that has many.
        number: Its place in the source, counted from 0; where all pictures' files are named by
            numbers alone, as BOP's are, that number.
        time: Seconds: of a video since its start, of a camera or a bag since 1970; None of a
            picture.
    """

    image: Picture
    name: str
    number: int
    time: float | None = None


class Source(Protocol):
    """Where pictures come from.

    Attributes:
        name: For messages, and for what is written about it; without passwords.
        stem: What a file about it is called, without suffix.
        count: How many frames it has; None where nobody knows.
        rate: Frames a second, of a sequence in time; None of single pictures.
    """

    @property
    def name(self) -> str: ...  # noqa: D102

    @property
    def stem(self) -> str: ...  # noqa: D102

    @property
    def count(self) -> int | None: ...  # noqa: D102

    @property
    def rate(self) -> float | None: ...  # noqa: D102

    @property
    def camera(self) -> Camera | None:
        """The camera that the source itself knows."""

    def frames(self, stride: int = 1) -> Iterator[Frame]:
        """Yield every so manieth frame, in order."""
