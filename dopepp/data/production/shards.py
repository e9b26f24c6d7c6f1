"""Which images belong to a shard, and which of them are still to be made."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from dopepp.data.rendered import MAX_ITEMS
from dopepp.data.writing import Writer
from dopepp.errors import UserError


@dataclass(frozen=True)
class Shard:
    """One of several equal, contiguous parts of a job.

    Attributes:
        number: Which one, from 0.
        total: How many there are.
    """

    number: int = 0
    total: int = 1

    @classmethod
    def parse(cls, text: str) -> Shard:
        """Read ``i/n``, i from 0 to n − 1.

        Raises:
            UserError: It is something else.
        """
        match = re.fullmatch(r"([0-9]{1,9})/([0-9]{1,9})", text)
        if match is None or int(match[1]) >= int(match[2]):
            raise UserError(
                f"shard {text!r}",
                "i/n with 0 <= i < n: 0/2 and 1/2 are the two halves",
                "count the shards from 0",
            )
        return cls(int(match[1]), int(match[2]))

    def span(self, num_items: int) -> range:
        """Return the shard's indices of a job of ``num_items`` images."""
        return range(
            num_items * self.number // self.total, num_items * (self.number + 1) // self.total
        )


@dataclass(frozen=True)
class Chunk:
    """What a shard has to do with a chunk.

    Attributes:
        number: The chunk.
        required: All of the job's images in it, also those of other shards: with these it is
            sealed.
        missing: The shard's images in it that are not there yet.
    """

    number: int
    required: range
    missing: Sequence[int]


def check_count(num_items: int) -> None:
    """Refuse a number of images that no job can have.

    Raises:
        UserError: It is not in 1 … 10⁹.
    """
    if not 1 <= num_items <= MAX_ITEMS:
        raise UserError(f"-n {num_items}", f"1 to {MAX_ITEMS:,} images", "change -n")


def plan(writer: Writer, shard: Shard, num_items: int) -> Iterator[Chunk]:
    """Yield the chunks that a shard touches, in order, also those that are complete."""
    span, size = shard.span(num_items), writer.chunk_size
    if not span:
        return
    for number in range(span[0] // size, span[-1] // size + 1):
        required = range(number * size, min((number + 1) * size, num_items))
        own = range(max(span.start, required.start), min(span.stop, required.stop))
        written = writer.written(number)
        missing = [index for index in own if index not in written] if written else own
        yield Chunk(number, required, missing)
