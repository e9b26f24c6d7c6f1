"""``dopepp node``: poses of what a robot's camera sees, over ROS, a bag, UDP or stdout."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from dopepp.cli.errors import resumable
from dopepp.cli.options import Device, Intrinsics, MaxMs, Region, Track, check_region
from dopepp.core.errors import UserError, require

if TYPE_CHECKING:
    from dopepp.robot.nodes.worker import Worker

LINES: Final = ("--json", "--udp")

TOPIC: Final = "/camera/image_raw"

PACKAGES: Final = {"--ros2": ("rclpy", "ros2"), "--bag": ("rosbags", "bags")}
"""What a way needs, and the extra that has it."""


def node(
    model: Annotated[Path, typer.Argument(help="best.ckpt of a run, or a released network")],
    source: Annotated[
        list[str] | None, typer.Argument(help="of --json and --udp: as `dopepp predict` takes it")
    ] = None,
    ros2: Annotated[bool, typer.Option("--ros2", help="a node of ROS 2 (extra ros2)")] = False,
    bag: Annotated[
        Path | None, typer.Option(help="answer a recording: .bag, .mcap, a folder; with --out")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="recording to write, .mcap")] = None,
    json_lines: Annotated[
        bool, typer.Option("--json", help="a line of JSON for each picture, on stdout")
    ] = False,
    udp: Annotated[str | None, typer.Option(help="HOST:PORT: these lines as datagrams")] = None,
    topic: Annotated[
        str | None,
        typer.Option(help="of the pictures, raw or …/compressed; else /camera/image_raw"),
    ] = None,
    name: Annotated[str, typer.Option(help="of the node, which its topics begin with")] = "dope",
    params: Annotated[
        Path | None, typer.Option(help="of --ros2: YAML of parameters to begin with")
    ] = None,
    intrinsics: Intrinsics = None,
    camera: Annotated[Path | None, typer.Option(help="camera file in place of camera_info")] = None,
    frame: Annotated[
        str | None, typer.Option(help="the camera's optical frame, else that of the pictures")
    ] = None,
    conf: Annotated[float, typer.Option(help="least score of a pose, 0 to 1")] = 0.0,
    refine: Region = None,
    max_ms: MaxMs = None,
    track: Track = False,
    overlay: Annotated[
        bool, typer.Option("--overlay", help="publish pictures with the poses drawn on them")
    ] = False,
    device: Device = "cpu",
) -> None:
    """Say the poses on every picture of a camera, until Ctrl-C.

    Exit codes: 0 done; 1 stopped (a camera delivers no more); 2 wrong input; 130, 143 interrupted.
    """
    words = list(source or ())
    with resumable("the node has ended"):
        ways = {"--ros2": ros2, "--bag": bag, "--json": json_lines, "--udp": udp}
        way = _way([one for one, given in ways.items() if given], words, out, params)
        check_region(refine)

        from dopepp.geometry.camera import camera_matrix
        from dopepp.inference.frames.source import choose_camera, given_camera

        known = given_camera(None if intrinsics is None else camera_matrix(*intrinsics), camera)

        from dopepp.inference.estimator import PoseEstimator
        from dopepp.inference.frames import open_sources
        from dopepp.robot.nodes.worker import Settings, Worker

        sources = open_sources(words, topic) if way in LINES else []
        cameras = [known or choose_camera(None, None, one) for one in sources]
        refining = "region" if track or refine else None
        estimator = PoseEstimator.load(model, device, refining, max_ms=max_ms)
        settings = Settings(conf, refining is not None, overlay)
        worker = Worker(estimator, settings, known, frame, track)
        if way in LINES:
            from dopepp.robot.nodes.lines import say_lines

            say_lines(worker, zip(sources, cameras, strict=True), udp)
        elif bag is not None and out is not None:
            _answer(worker, bag, out, topic, name)
        else:
            from dopepp.robot.nodes.ros2 import run

            run(worker, topic or TOPIC, name, params)


def _way(given: Sequence[str], words: Sequence[str], out: Path | None, params: Path | None) -> str:
    """Return which way was asked for; a UserError where options do not go together."""
    if len(given) != 1:
        got = " and ".join(given) or "no way in and out"
        allowed = "one of --ros2, --bag FILE --out FILE, --json, --udp HOST:PORT"
        raise UserError(got, allowed, "say how pictures come in and poses go out")
    way = given[0]
    for wrong, got, allowed, fix in (
        (way in LINES and not words, f"{way} without a source", "a camera, a video, pictures, …",
         "name it behind the model"),
        (way not in LINES and words, f"{way} with {words[:1]}", "no source: pictures come "
         "from --topic, or from the recording", "leave it out"),
        ((way == "--bag") != (out is not None), "--bag without --out, or --out without --bag",
         "both", "add --out poses.mcap"),
        (way != "--ros2" and params, f"--params with {way}", "--params with --ros2",
         "leave it out"),
    ):  # fmt: skip
        if wrong:
            raise UserError(got, allowed, fix)
    if way in PACKAGES:
        require(PACKAGES[way][0], way, PACKAGES[way][1])
    return way


def _answer(worker: Worker, bag: Path, out: Path, topic: str | None, name: str) -> None:
    """Answer a recording, and say how many pictures there were and what was found."""
    from dopepp.robot.nodes.bag import answer_bag

    pictures = answered = poses = 0
    for one in answer_bag(worker, bag, out, topic, name):
        pictures, answered = pictures + 1, answered + (one is not None)
        poses += 0 if one is None else len(one.result.detections)
    left = pictures - answered
    typer.echo(f"{out}: {poses} poses on {answered} pictures" + f", {left} left out" * bool(left))
