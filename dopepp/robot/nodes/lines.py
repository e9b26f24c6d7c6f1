"""Poses as lines of JSON, for arms without ROS: on stdout, or a datagram each over UDP."""

from __future__ import annotations

import logging
import socket
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext

from dopepp.core.errors import RunError, UserError
from dopepp.geometry.camera_file import Camera
from dopepp.inference.frames import FrameSource
from dopepp.robot.nodes.worker import Worker

MAX_DATAGRAM = 65_507  # bytes that UDP over IPv4 carries

logger = logging.getLogger(__name__)


def say_lines(
    worker: Worker, sources: Iterable[tuple[FrameSource, Camera]], address: str | None = None
) -> None:
    """Say the poses on every picture of some sources, a line a picture, found or not.

    A line is what ``dopepp predict --json`` writes. Without an ``address`` (``host:port``) they go
    to stdout.

    Raises:
        UserError: The address is none, or a source cannot be read.
        RunError: A camera stopped delivering, or nobody reads stdout any more.
    """
    with nullcontext(_print) if address is None else _datagrams(address) as send:
        for source, camera in sources:
            for frame in source.frames():
                send(worker.result(frame, camera).to_json())


@contextmanager
def _datagrams(address: str) -> Iterator[Callable[[str], None]]:
    target, left_out = parse_address(address), 0
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:

        def send(line: str) -> None:
            nonlocal left_out
            content = f"{line}\n".encode()
            if len(content) > MAX_DATAGRAM:
                left_out += 1
                if left_out == 1:
                    logger.warning(
                        "a line of %d bytes does not fit into a datagram (%d) and is left out: "
                        "raise --conf, or read --json", len(content), MAX_DATAGRAM,
                    )  # fmt: skip
                return
            try:
                sender.sendto(content, target)
            except OSError as error:
                raise RunError(f"--udp {address}: {error.strerror or error}") from error

        yield send


def _print(line: str) -> None:
    try:
        sys.stdout.write(f"{line}\n")
        sys.stdout.flush()  # whoever reads must not wait for a buffer to fill
    except BrokenPipeError as error:
        raise RunError("nobody reads the lines any more") from error


def parse_address(text: str) -> tuple[str, int]:
    """Return host and port of ``host:port``; a :class:`UserError` where it is none."""
    host, _, port = text.rpartition(":")
    try:
        number = int(port)
        found = socket.getaddrinfo(host, number, socket.AF_INET, socket.SOCK_DGRAM)
        if not host or not 0 < number < 65_536:
            raise ValueError(text)
    except (ValueError, OverflowError, OSError) as error:
        allowed = "HOST:PORT, as 192.168.0.7:5005"
        raise UserError(f"--udp {text:.100}", allowed, "name who listens") from error
    name, at = found[0][4][:2]
    return str(name), int(at)
