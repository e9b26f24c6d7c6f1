"""``dopepp node``: publish poses in a camera's images over ROS 2, a bag, UDP or stdout."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer
from typer import Argument, Option

from dopepp.cli import options
from dopepp.core.errors import UserError, interruptible, require
from dopepp.core.validation import Range, check

if TYPE_CHECKING:
    from dopepp.inference.estimator import PoseEstimator
    from dopepp.robot.nodes.worker import Worker, WorkerSettings

LINES: Final = ("--json", "--udp")
TOPIC: Final = "/camera/image_raw"


def node(
    model: options.Model,
    source: Annotated[
        list[str] | None, Argument(help="With --json or --udp: sources as in `dopepp predict`.")
    ] = None,
    ros2: Annotated[bool, Option("--ros2", help="Run as a ROS 2 node.")] = False,
    bag: Annotated[Path | None, Option(help="Recording to process; with --out.")] = None,
    out: Annotated[Path | None, Option(help="With --bag: recording to write, .mcap")] = None,
    json_lines: Annotated[bool, Option("--json", help="Print lines of JSON.")] = False,
    udp: Annotated[str | None, Option(help="HOST:PORT: send the lines over UDP.")] = None,
    topic: Annotated[
        list[str] | None,
        Option(
            help="Image topic (default: /camera/image_raw). With --ros2: several topics of cameras "
            "with known poses."
        ),
    ] = None,
    views: Annotated[
        Path | None,
        Option(help="With several topics: file of the camera poses (default: poses from TF)."),
    ] = None,
    world: Annotated[
        str | None, Option(help="With several topics: frame of the poses (default: world).")
    ] = None,
    lag: Annotated[
        float | None,
        Option(help="With several topics: largest lag of a set's images, seconds (default: 1/60)."),
    ] = None,
    name: Annotated[
        str | None, Option(help="Name of the node and prefix of its topics (default: dope).")
    ] = None,
    params: Annotated[Path | None, Option(help="With --ros2: YAML of parameters.")] = None,
    intrinsics: options.Intrinsics = None,
    camera: Annotated[Path | None, Option(help="Camera file, for camera_info.")] = None,
    frame: Annotated[
        str | None, Option(help="Optical frame of the camera (default: the images' frame).")
    ] = None,
    conf: options.Conf = None,
    refine: options.RefineRegion = None,
    max_ms: options.MaxMs = None,
    scale_error: options.ScaleError = None,
    track: options.Track = False,
    overlay: Annotated[bool, Option("--overlay", help="Publish drawn poses.")] = False,
    unit: options.Unit = None,
    working_distance: options.WorkingDistance = None,
    tilt: options.Tilt = None,
    device: options.Device = "cpu",
) -> None:
    """Publish the poses in every image of a camera, until Ctrl-C.

    Exit codes: 0 done; 1 stopped (the camera stream ended); 2 wrong input; 130 or 143 interrupted.
    """
    words = list(source or ())
    with interruptible("the node has stopped"):
        transports = {"--ros2": ros2, "--bag": bag, "--json": json_lines, "--udp": udp}
        chosen = [option for option, is_given in transports.items() if is_given]
        for_ros = {"--frame": frame, "--overlay": overlay, "--name": name}
        transport = _check_transport(chosen, words, out, params, for_ros)
        topics, name = topic or [TOPIC], name or "dope"
        for_several: dict[str, object] = {"--views": views, "--world": world, "--lag": lag}
        for_one: dict[str, object] = {"--camera": camera, "--K": intrinsics, "--frame": frame}
        _check_topics(topics, transport, for_one if len(topics) > 1 else for_several)
        lag = None if lag is None else check("--lag", lag, float, Range(0, 10))
        options.check_region(refine)

        from dopepp.geometry.camera import camera_matrix
        from dopepp.inference.frames import open_sources
        from dopepp.inference.frames.source import choose_camera, given_camera
        from dopepp.robot.nodes.worker import Worker, WorkerSettings

        K = None if intrinsics is None else camera_matrix(*intrinsics)
        fixed_camera = given_camera(K, camera)
        sources = open_sources(words, topics[0] if topic else None) if transport in LINES else []
        cameras = [choose_camera(None, fixed_camera, opened) for opened in sources]
        estimator = options.load_estimator(
            model, device, unit, working_distance, tilt, max_ms=max_ms, scale_error=scale_error
        )
        if track or refine or len(topics) > 1:
            estimator = estimator.refining("region")
        settings = WorkerSettings(conf, estimator.refiner is not None, overlay)
        if len(topics) > 1:
            worker = _views_worker(estimator, settings, topics, views, world, track)
        else:
            worker = Worker(estimator, settings, fixed_camera, frame, track)
        if transport == "--ros2":
            from dopepp.robot.nodes.image_queue import MAX_LAG_S
            from dopepp.robot.nodes.ros2 import run

            run(worker, topics, name, params, MAX_LAG_S if lag is None else lag)
        elif transport in LINES:
            from dopepp.robot.nodes.standalone import send_lines

            send_lines(worker, zip(sources, cameras, strict=True), udp)
        elif bag is not None and out is not None:
            _process_bag(worker, bag, out, topics[0] if topic else None, name)


def _views_worker(
    estimator: PoseEstimator,
    settings: WorkerSettings,
    topics: Sequence[str],
    views: Path | None,
    world: str | None,
    track: bool,
) -> Worker:
    """Return the worker for several topics; the camera poses are those of ``views`` or of TF."""
    from dopepp.inference.several_views.view_files import read_camera_poses
    from dopepp.robot.nodes.views_worker import WORLD, ViewsWorker

    poses, error = None, None
    if views is not None:
        file = read_camera_poses(views)
        error = file.error
        poses = [file.of(Path(topic.removesuffix("/compressed"))) for topic in topics]
    return ViewsWorker(estimator, poses, world or WORLD, error, settings, track)


def _process_bag(worker: Worker, bag: Path, out: Path, topic: str | None, name: str) -> None:
    """Write the poses in a recording's images to ``out``, and print their number."""
    from dopepp.robot.nodes.standalone import process_bag

    found = weaker = processed = skipped = 0
    for answer in process_bag(worker, bag, out, topic, name):
        if answer is None:
            skipped += 1
            continue
        processed += 1
        found += len(answer.result.detections)
        weaker += answer.result.num_weaker
    note = f", {skipped} skipped" if skipped else ""
    note += f"; {weaker} weaker candidates" if weaker else ""
    typer.echo(f"{out}: {found} poses in {processed} images{note}")


def _check_topics(topics: Sequence[str], transport: str, excluded: Mapping[str, object]) -> None:
    """Reject topics that do not suit, and ``excluded`` options (values by name) that are set."""
    if len(topics) > 1 and transport != "--ros2":
        fix = "pass one --topic, or use --ros2"
        raise UserError(f"{len(topics)} topics with {transport}", "one topic", fix)
    if repeated := [topic for topic in topics if topics.count(topic) > 1]:
        fix = "pass the topic of another camera"
        raise UserError(f"--topic {repeated[0]} twice", "different topics", fix)
    if given := ", ".join(option for option, value in excluded.items() if value is not None):
        number = "several topics" if len(topics) > 1 else "one topic"
        raise UserError(f"{given} with {number}", f"{number} without it", f"leave out {given}")


def _check_transport(
    chosen: Sequence[str],
    words: Sequence[str],
    out: Path | None,
    params: Path | None,
    for_ros: Mapping[str, object],
) -> str:
    """Return the only entry of ``chosen``; reject other numbers, and options that do not suit.

    ``for_ros`` are options (values by name) that only suit ROS messages.
    """
    if len(chosen) != 1:
        problem = " and ".join(chosen) or "no input and output"
        allowed = "one of --ros2, --bag FILE --out FILE, --json, --udp HOST:PORT"
        raise UserError(problem, allowed, "pass one of these options and leave out the others")
    transport = chosen[0]
    if transport in LINES and not words:
        fix = "write the source after the network, e.g. 0 for the first camera"
        raise UserError(f"{transport} without a source", "a camera, a video, images, …", fix)
    if transport in LINES and (given := ", ".join(name for name, it in for_ros.items() if it)):
        problem, allowed = f"{given} with {transport}", f"{given} with --ros2 or --bag"
        raise UserError(problem, allowed, f"leave out {given}")
    if transport not in LINES and words:
        allowed = "no source: the images come from --topic or from the recording"
        raise UserError(f"{transport} with the source {words[0]}", allowed, f"leave out {words[0]}")
    if (transport == "--bag") != (out is not None):
        problem = "--out without --bag" if out else "--bag without --out"
        fix = "add --bag FILE" if out else "add --out poses.mcap"
        raise UserError(problem, "--bag together with --out", fix)
    if transport != "--ros2" and params:
        raise UserError(f"--params with {transport}", "--params with --ros2", "leave out --params")
    if transport == "--ros2":
        require("rclpy", transport, "ros2")
    return transport
