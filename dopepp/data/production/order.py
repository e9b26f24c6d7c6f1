"""What the command line asks for, checked, and who does it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

from rich.console import Console

from dopepp.data.production.job import Job
from dopepp.data.production.processes import ProcessPool, available_cores, check_workers
from dopepp.data.production.produce import OpenPool, Report, produce
from dopepp.data.production.progress import ProgressDisplay
from dopepp.data.production.shards import Shard
from dopepp.errors import UserError

ENGINES: Final = ("local", "ray")


@dataclass(frozen=True)
class Order:
    """How much of a job is done here, and by whom; it decides none of the bytes.

    Attributes:
        out: The data set's folder.
        num: Images of the whole job.
        shard: ``i/n``.
        workers: Processes; None for one per core.
        engine: One of :data:`ENGINES`.
        ray_address: Of a running Ray cluster.
    """

    out: Path
    num: int | None
    shard: str = "0/1"
    workers: int | None = None
    engine: str = "local"
    ray_address: str | None = None


def carry_out(job: Job, order: Order) -> Report:
    """Render what is missing and show the progress on stderr.

    Raises:
        UserError: The order cannot be carried out.
        StoppedError: The disk is full or a worker died.
    """
    if order.num is None:
        raise UserError("no -n", "the number of images, or --preview", "add -n 1000")
    shard, open_pool = Shard.parse(order.shard), _engine(order)
    with ProgressDisplay(Console(stderr=True)) as progress:
        return produce(job, order.out, order.num, open_pool, shard, progress)


def write_preview(job: Job, out: Path) -> Path:
    """Write a contact sheet of the job's first images.

    Args:
        job: The job.
        out: A PNG file, or the data set's folder: the sheet then lies beside it.

    Returns:
        Where the sheet is.

    Raises:
        UserError: The preset cannot show the part, or the sheet cannot be written.
    """
    # Fonts and drawing take a second to load: only here.
    from dopepp.data.production.preview import preview_sheet
    from dopepp.drawing.png import write_png

    out = out.resolve()
    path = out if out.suffix.lower() == ".png" else out.parent / f"{out.name}.preview.png"
    sheet = preview_sheet(job.factory)
    try:
        write_png(path, sheet)
    except OSError as error:
        raise UserError(
            f"sheet {path}: {error.strerror}", "a folder that can be written", "change --out"
        ) from error
    return path


def _engine(order: Order) -> OpenPool:
    """Return what opens the pool, after checking what can be checked without it."""
    workers = available_cores() if order.workers is None else order.workers
    check_workers(workers)
    if order.engine == "local":
        if order.ray_address is not None:
            raise UserError(
                f"--ray-address {order.ray_address} with --engine local", "it goes with ray",
                "add --engine ray",
            )  # fmt: skip
        return lambda content, num_tasks: ProcessPool(content, min(workers, max(num_tasks, 1)))
    if order.engine == "ray":
        from dopepp.data.production.cluster import ClusterPool

        open_pool = partial(ClusterPool, address=order.ray_address, num_workers=workers)
        return lambda content, _: open_pool(content)
    raise UserError(f"--engine {order.engine}", ", ".join(ENGINES), "choose one of them")
