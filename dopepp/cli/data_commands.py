"""Data set commands: ``dopepp render``, ``check``, ``download`` and ``symmetries``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Argument, Option
from typer.core import TyperCommand

from dopepp.cli import options
from dopepp.core.errors import interruptible


class RenderCommand(TyperCommand):
    """The ``render`` command: its help lists the presets; ``--negatives`` takes a single part."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Reject further names after ``--negatives PART``, which would become targets."""
        if args and not args[0].startswith("-"):  # the targets come first
            for option, value, word in zip(args, args[1:], args[2:], strict=False):
                if option == "--negatives" and not word.startswith("-"):
                    ctx.fail(
                        f"got {word} after --negatives {value}; allowed: one part after each "
                        f"--negatives; fix: write --negatives {value} --negatives {word}"
                    )
        return super().parse_args(ctx, args)

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Write the help with the presets' names, which are imported for the help only."""
        from dopepp.virtual.presets import PRESETS

        (preset,) = (parameter for parameter in self.params if parameter.name == "preset")
        preset.help = f"Scene preset ({', '.join(PRESETS)}), or a YAML file."  # type: ignore[attr-defined]
        super().format_help(ctx, formatter)


def render(
    parts: Annotated[list[str], Argument(help="Mesh files, built-in parts, or NAME=FILE.")],
    out: Annotated[Path, Option(help="Folder of the data set.")],
    num: Annotated[int | None, Option("-n", help="Number of images.")] = None,
    unit: options.Unit = None,
    layout: Annotated[str, Option("--format", help="bop, ndds or webdataset.")] = "bop",
    preset: Annotated[str, Option(help="Scene preset, or a YAML file.")] = "paper",
    size: Annotated[
        str | None,
        Option(
            help="Image size in pixels, WIDTHxHEIGHT (default: the preset's). The field of view "
            "along the shorter side stays the same."
        ),
    ] = None,
    camera: Annotated[str | None, Option(help="Camera file of the simulated camera.")] = None,
    working_distance: Annotated[
        str | None, Option(help="With --camera: NEAREST,FARTHEST part in metres.")
    ] = None,
    views: Annotated[
        int, Option(help="Cameras of each scene, which is a folder with their poses (bop only).")
    ] = 1,
    workers: Annotated[int | None, Option(help="Processes (default: all cores).")] = None,
    seed: Annotated[int, Option(help="Random seed.")] = 0,
    preview: Annotated[bool, Option("--preview", help="Only write OUT.preview.png.")] = False,
    shard: Annotated[str, Option(help="i/n: only shard i of n, from 0.")] = "0/1",
    engine: Annotated[str, Option(help="local or ray.")] = "local",
    ray_address: Annotated[str | None, Option(help="Ray cluster (default: a new cluster).")] = None,
    renderer: Annotated[str, Option(help="raster or photoreal.")] = "raster",
    backgrounds: Annotated[str, Option(help="procedural, skimage or a folder.")] = "procedural",
    changes: Annotated[
        list[str] | None,
        Option("--set", help="Change a field of the preset: lighting.num_lights=[1,3]"),
    ] = None,
    negatives: Annotated[list[str] | None, Option(help="Unlabelled other parts.")] = None,
) -> None:
    """Render labelled images of parts.

    Run the same command again to continue after an interruption. Exit codes: 0 done; 1 stopped
    (disk full, a worker process died); 2 wrong input; 130 or 143 interrupted.
    """
    with interruptible():
        from dopepp.data.render_job import make_job
        from dopepp.data.render_run import run

        job = make_job(
            parts,
            unit=unit,
            preset=preset,
            changes=changes or (),
            size=size,
            seed=seed,
            backgrounds=backgrounds,
            negatives=negatives or (),
            renderer=renderer,
            layout=layout,
            camera=camera,
            working_distance=options.distance_range(working_distance),
            views=views,
        )
        if preview:
            from dopepp.data.render_preview import write_preview  # imports fonts, which is slow

            typer.echo(write_preview(job, out))
        else:
            typer.echo(run(job, out, num, shard, workers, engine, ray_address))


def check(
    folder: Annotated[Path, Argument(help="BOP, BOP-WebDataset, NDDS/FAT or YCB-Video.")],
    most: Annotated[int, Option(min=0, help="Maximum number of listed defects.")] = 10_000,
) -> None:
    """Check a data set and list every defect with its file and field, one per line.

    Exit codes: 0 no defects; 1 defects; 2 no data set at this path.
    """
    from dopepp.data.check import check_dataset

    report = check_dataset(folder)
    typer.echo("\n".join(report.lines(most)))
    if not report.ok:
        raise typer.Exit(1)


def download(
    name: Annotated[str, Argument(help="voc2007: photos for --backgrounds, 460 MB.")],
    out: Annotated[Path, Option(help="Target folder.")] = Path("data"),
) -> None:
    """Download a public data set, verify its checksum, and print the folder of its photos."""
    from rich.console import Console
    from rich.progress import DownloadColumn, Progress, TimeRemainingColumn, TransferSpeedColumn

    from dopepp.data.download import download as fetch_and_unpack

    columns = (DownloadColumn(), TransferSpeedColumn(), TimeRemainingColumn())
    console = Console(stderr=True)
    with (
        interruptible(),
        Progress(*columns, console=console, disable=not console.is_terminal) as bar,
    ):
        task = bar.add_task(name, total=None)

        def show(completed: int, total: int) -> None:
            bar.update(task, completed=completed, total=total)

        photos = fetch_and_unpack(name, out, show)
    typer.echo(photos)


def symmetries(
    part: Annotated[str, Argument(help="Mesh file or built-in part.")],
    unit: options.Unit = None,
    tolerance: Annotated[
        float, Option(help="Largest surface deviation, as a share of the diameter.")
    ] = 0.01,
) -> None:
    """Find a part's symmetries and print its entry for BOP's models_info.json."""
    from dopepp.data.part_symmetries import describe_symmetries

    typer.echo(describe_symmetries(part, unit, tolerance))
