"""``dopepp calibrate``: calibrate cameras, a tool, a bench, and the camera's pose on the robot."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, cast

import typer
from typer import Argument, Option

from dopepp.core.errors import UserError, check_choice

if TYPE_CHECKING:
    from collections.abc import Sequence

    from dopepp.robot.calibration.board import BoardPose
    from dopepp.robot.calibration.hand_eye import HandEye, Mount
    from dopepp.robot.calibration.lens import LensCalibration
    from dopepp.robot.calibration.quality import CalibrationQuality
    from dopepp.robot.calibration.records import PoseFormat
    from dopepp.robot.calibration.rig import Rig
    from dopepp.robot.calibration.tool import Bench

BOARD: Final = "charuco:8x11:20:15, chess:7x10:25 or circles:4x11:40 (columns × rows, mm)."

Out = Annotated[Path, Option(help="YAML file to write.")]
Force = Annotated[
    bool, Option("--force", help="Write even a doubtful calibration, marked as not trusted.")
]
BoardSpec = Annotated[str, Option("--board", help=BOARD)]
Poses = Annotated[
    Path, Argument(help="CSV, JSON or YAML: x y z and a quaternion, rotation vector or angles.")
]
Unit = Annotated[str, Option(help="Unit of positions: m, mm, cm or inch.")]
Angles = Annotated[str, Option(help="Unit of rx ry rz and roll pitch yaw: rad or deg.")]
Quaternion = Annotated[str, Option(help="Order of a quaternion: wxyz or xyzw.")]
Direction = Annotated[str, Option(help="Poses are flange-to-base (usual) or base-to-flange.")]

app = typer.Typer(
    no_args_is_help=True, help="Calibrate cameras, a tool, a bench, or the camera on the robot."
)


@app.command()
def board(
    spec: Annotated[str, Argument(help=BOARD)],
    out: Annotated[Path, Option(help="PDF or PNG to print.")],
) -> None:
    """Write a calibration board for printing at true scale."""
    from dopepp.robot.calibration.board import parse_board

    typer.echo(f"{out}: {parse_board(spec).write(out)}")


@app.command()
def camera(
    source: Annotated[
        str,
        Argument(
            help="Images of the board: a folder, a video, a ROS bag, or the number or address of "
            "a camera (Ctrl-C ends the recording)."
        ),
    ],
    board: BoardSpec,
    out: Out,
    force: Force = False,
) -> None:
    """Calibrate a camera from images of a board, and write a file for predict --camera."""
    from dopepp.cli.board_images import detect_in_folder, detect_in_stream
    from dopepp.core.files import check_target
    from dopepp.robot.calibration.board import parse_board
    from dopepp.robot.calibration.lens import calibrate_lens, write_camera
    from dopepp.robot.calibration.records import check_trust

    check_target(out, (".yaml", ".yml"))
    target, folder = parse_board(board), Path(source)
    if folder.is_dir() and not (folder / "metadata.yaml").exists():
        detections, size = detect_in_folder(folder, target)
    else:
        detections, size = detect_in_stream(source, target)
    calibration = calibrate_lens(detections, size)
    _show_lens(calibration)
    check_trust(calibration.findings, force)
    write_camera(out, calibration.camera, not calibration.findings)
    typer.echo(f"written: {out}")


@app.command()
def tcp(
    poses: Poses,
    out: Out,
    force: Force = False,
    unit: Unit = "m",
    angles: Angles = "rad",
    quaternion: Quaternion = "wxyz",
    direction: Direction = "flange-to-base",
) -> None:
    """Calibrate a tool's tip from flange poses in which the tip touches a fixed point."""
    from dopepp.robot.calibration.records import read_robot_poses, write_calibration
    from dopepp.robot.calibration.tool import find_tip

    pose_format = _pose_format(unit, angles, quaternion, direction)
    tip = find_tip(read_robot_poses(poses).transforms(pose_format))
    for number, residual in enumerate(tip.residuals, 1):
        typer.echo(f"pose {number}: {1000 * residual:.2f} mm")
    position, deviations = (
        ", ".join(f"{1000 * value:.2f}" for value in vector)
        for vector in (tip.position, tip.deviations)
    )
    typer.echo(f"tip at ({position}) mm in the flange frame, ± ({deviations}) mm")
    values = {"tip": tip.position.tolist(), "deviations": tip.deviations.tolist()}
    write_calibration(out, "tool", values, tip.findings, force)
    typer.echo(f"written: {out}")


@app.command()
def bench(
    source: Annotated[
        Path,
        Argument(
            help="CSV with x, y, z of points that the tip touched, or a folder with images of a "
            "board on the bench."
        ),
    ],
    out: Out,
    board: Annotated[str | None, Option(help=BOARD)] = None,
    camera: Annotated[Path | None, Option(help="With --board: camera file.")] = None,
    hand_eye: Annotated[Path | None, Option(help="With --board: hand-eye file.")] = None,
    poses: Annotated[Path | None, Option(help="With a camera on the flange: robot poses.")] = None,
    unit: Unit = "m",
    angles: Angles = "rad",
    quaternion: Quaternion = "wxyz",
    direction: Direction = "flange-to-base",
    force: Force = False,
) -> None:
    """Calibrate the plane and the frame of the bench.

    From touched points, the origin is the first point, x points to the second and z upwards. From
    a board, origin and x are the board's, and z points out of the board.
    """
    from dopepp.geometry.transform_file import transform_record
    from dopepp.robot.calibration.records import read_points, write_calibration
    from dopepp.robot.calibration.tool import find_bench

    pose_format = _pose_format(unit, angles, quaternion, direction)
    for_board = {"--camera": camera, "--hand-eye": hand_eye, "--poses": poses}
    if board is not None:
        result, names = _bench_from_board(source, board, camera, hand_eye, poses, pose_format)
    elif given := [word for word, path in for_board.items() if path is not None]:
        problem, fix = f"{' and '.join(given)} without --board", "add --board, or leave them out"
        raise UserError(problem, "these options with images of a board", fix)
    elif source.is_dir():
        problem = f"{source}, which is a folder, without --board"
        fix = "describe the board, e.g. --board charuco:8x11:20:15"
        raise UserError(problem, "a CSV, or images with --board", fix)
    else:
        result = find_bench(read_points(source, unit))
        names = [f"point {number}" for number in range(1, len(result.residuals) + 1)]
    for name, residual in zip(names, result.residuals, strict=True):
        typer.echo(f"{name}: {1000 * residual:+.2f} mm off the plane")
    values = {"T_base_bench": transform_record(result.T_base_bench)}
    write_calibration(out, "bench", values, result.findings, force)
    typer.echo(f"written: {out}")


@app.command()
def handeye(
    images: Annotated[Path, Argument(help="Folder with images of the board.")],
    poses: Poses,
    board: BoardSpec,
    camera: Annotated[Path, Option(help="Camera file.")],
    mount: Annotated[str, Option(help="Mount of the camera: hand or bench.")],
    out: Out,
    unit: Unit = "m",
    angles: Angles = "rad",
    quaternion: Quaternion = "wxyz",
    direction: Direction = "flange-to-base",
    force: Force = False,
) -> None:
    """Calibrate the camera's pose on the robot from images of a board and the robot's poses."""
    from dopepp.cli.board_images import board_poses, image_names
    from dopepp.core.files import check_target
    from dopepp.robot.calibration.hand_eye import MOUNTS, calibrate_hand_eye
    from dopepp.robot.calibration.quality import assess, check_poses
    from dopepp.robot.calibration.records import match_images, read_robot_poses, write_calibration

    check_target(out, (".yaml", ".yml"))
    check_choice("--mount", mount, MOUNTS)
    checked_mount = cast("Mount", mount)
    pose_format = _pose_format(unit, angles, quaternion, direction)
    robot = read_robot_poses(poses)
    rows = match_images(robot, image_names(images))
    boards = [pose for pose in board_poses(images, board, camera) if pose.name in rows]
    used_rows = [rows[pose.name] for pose in boards]
    flanges = check_poses(robot, used_rows, pose_format, boards, checked_mount)
    calibration = calibrate_hand_eye(flanges, boards, checked_mount)
    quality = assess(flanges, boards, calibration)
    _show_hand_eye(boards, calibration, quality)
    record = _hand_eye_record(calibration, quality)
    write_calibration(out, "hand-eye", record, quality.findings, force)
    typer.echo(f"written: {out}")


@app.command()
def rig(
    folder: Annotated[
        Path,
        Argument(
            help="For each camera NAME, a folder NAME with images of the board and a camera file "
            "NAME.yaml. Images of one name show the same moment."
        ),
    ],
    board: BoardSpec,
    out: Out,
    hand_eye: Annotated[
        Path | None,
        Option(
            help="Result of `handeye --mount bench` for the first camera: poses in the robot's "
            "base frame (default: poses in the first camera's frame)."
        ),
    ] = None,
    force: Force = False,
) -> None:
    """Calibrate the poses of two to eight fixed cameras, and write the file for predict --views."""
    from os.path import relpath

    import numpy as np

    from dopepp.cli.board_images import detect_in_folder
    from dopepp.core.files import check_target
    from dopepp.core.yaml import read_yaml
    from dopepp.geometry.camera_file import read_camera
    from dopepp.geometry.transform_file import read_transform, transform_record
    from dopepp.robot.calibration.board import parse_board
    from dopepp.robot.calibration.records import write_calibration
    from dopepp.robot.calibration.rig import calibrate_rig

    check_target(out, (".yaml", ".yml"))
    target = parse_board(board)
    T_base_first, doubts = np.eye(4), list[str]()
    if hand_eye is not None:
        T_base_first = read_transform(hand_eye, "T_base_cam")
        doubts = _doubts(read_yaml(hand_eye), hand_eye)
    boards, cameras = {}, {}
    for images in sorted(path for path in folder.glob("*") if path.is_dir()):
        detections, size = detect_in_folder(images, target)
        boards[images.name] = {detection.name: detection for detection in detections}
        cameras[images.name] = read_camera(folder / f"{images.name}.yaml").for_picture(size)
    calibration = calibrate_rig(boards, cameras)
    _show_rig(calibration)
    shift, rotation = calibration.deviations.max(axis=0)
    axes = np.kron(np.eye(2), T_base_first[:3, :3])
    views = {
        name: {
            "camera": relpath(folder / f"{name}.yaml", out.parent),
            "T_world_cam": transform_record(T_base_first @ calibration.T_world_cam[number]),
            "covariance": (axes @ calibration.covariances[number] @ axes.T).tolist(),
            "error_px": float(calibration.errors_px[number]),
        }
        for number, name in enumerate(calibration.names)
    }
    record = {"camera_error": [float(shift), float(np.degrees(rotation))], "views": views}
    write_calibration(out, "rig", record, [*calibration.findings, *doubts], force)
    typer.echo(f"written: {out}")


def _pose_format(unit: str, angles: str, quaternion: str, direction: str) -> PoseFormat:
    """Return the conventions of a file of robot poses from the options, after checking them."""
    from dopepp.parts.part import UNITS
    from dopepp.robot.calibration.records import PoseFormat

    check_choice("--unit", unit, UNITS)
    check_choice("--angles", angles, ("rad", "deg"))
    check_choice("--quaternion", quaternion, ("wxyz", "xyzw"))
    check_choice("--direction", direction, ("flange-to-base", "base-to-flange"))
    return PoseFormat(unit, angles == "deg", quaternion, direction == "base-to-flange")


def _bench_from_board(
    folder: Path,
    spec: str,
    camera: Path | None,
    hand_eye: Path | None,
    poses: Path | None,
    pose_format: PoseFormat,
) -> tuple[Bench, list[str]]:
    """Calibrate the bench from images of a board on it; return the bench and the images' names."""
    from dopepp.cli.board_images import board_poses, image_names
    from dopepp.core.yaml import read_yaml
    from dopepp.geometry.transform_file import read_transform
    from dopepp.robot.calibration.board import parse_board
    from dopepp.robot.calibration.records import match_images, read_robot_poses
    from dopepp.robot.calibration.tool import bench_of_board

    if camera is None or hand_eye is None:
        problem = "--board without --camera or --hand-eye"
        fix = "add the files from `dopepp calibrate camera` and `dopepp calibrate handeye`"
        raise UserError(problem, "--board with both --camera and --hand-eye", fix)
    content = read_yaml(hand_eye)
    record = content if isinstance(content, dict) else {}
    mount = "flange" if "T_flange_cam" in record else "bench"
    if (mount == "flange") != (poses is not None):
        problem = f"{hand_eye} of a camera on the {mount}, with{'out' * (not poses)} --poses"
        fix = "leave out --poses" if poses else "add --poses FILE with the robot's poses"
        raise UserError(problem, "--poses if, and only if, the camera is on the flange", fix)
    T_mount_cam = read_transform(hand_eye, "T_flange_cam" if poses else "T_base_cam")
    boards = {pose.name: pose.T_cam_board for pose in board_poses(folder, spec, camera)}
    T_base_cam = dict.fromkeys(boards, T_mount_cam)
    if poses is not None:
        robot = read_robot_poses(poses)
        flanges, rows = robot.transforms(pose_format), match_images(robot, image_names(folder))
        T_base_cam = {name: flanges[row] @ T_mount_cam for name, row in rows.items()}
    used = [name for name in boards if name in T_base_cam]
    bench = bench_of_board([T_base_cam[name] @ boards[name] for name in used], parse_board(spec))
    return replace(bench, findings=(*bench.findings, *_doubts(content, hand_eye))), used


def _doubts(content: object, hand_eye: Path) -> list[str]:
    """Return the finding that a hand-eye file with this content is not trusted, if it is not."""
    is_trusted = isinstance(content, dict) and content.get("trusted") is True
    return [] if is_trusted else [f"{hand_eye} is not trusted"]


def _show_lens(calibration: LensCalibration) -> None:
    for name, error in zip(calibration.names, calibration.errors_px, strict=True):
        typer.echo(f"{name}: {error:.3f} px")
    for name in calibration.outliers:
        typer.echo(f"{name}: rejected, because its error is far above the median")
    typer.echo(f"points cover {calibration.coverage:.0%} of the image:")
    for row in calibration.covered:
        typer.echo("  " + "".join("■ " if cell else "· " for cell in row))
    values = calibration.camera.K[[0, 1, 0, 1], [0, 1, 2, 2]]
    numbers = zip(("fx", "fy", "cx", "cy"), values, calibration.deviations, strict=True)
    typer.echo(", ".join(f"{name} {value:.2f} ± {std:.2f}" for name, value, std in numbers) + " px")
    views = len(calibration.names)
    typer.echo(f"reprojection error {calibration.error_px:.3f} px over {views} views")


def _show_hand_eye(
    boards: Sequence[BoardPose], calibration: HandEye, quality: CalibrationQuality
) -> None:
    from math import degrees

    for number, board in enumerate(boards):
        rejected = "" if calibration.inliers[number] else "  rejected: contradicts the others"
        typer.echo(
            f"{board.name}: {degrees(calibration.rotation_errors[number]):.3f}°, "
            f"{1000 * calibration.shifts[number]:.2f} mm; without it the camera moves by "
            f"{1000 * quality.leave_one_out[number]:.2f} mm{rejected}"
        )
    rotation, shift = calibration.robot_noise
    rotations = ", ".join(f"{degrees(axis):.0f}°" for axis in quality.diversity)
    typer.echo(
        f"estimated error of the robot: {degrees(rotation):.3f}°, {1000 * shift:.2f} mm\n"
        f"rotations about the three main axes, RMS over pairs: {rotations}\n"
        f"to improve the calibration: {quality.next_pose}\n"
        f"expected error at the board's distance: {1000 * quality.shift:.2f} mm, "
        f"{degrees(quality.rotation):.3f}°"
    )


def _show_rig(calibration: Rig) -> None:
    from math import degrees, hypot

    for moment in calibration.outliers:
        typer.echo(f"{moment}: rejected, because it contradicts the other images")
    for number, name in enumerate(calibration.names):
        line = f"{name}: {calibration.shared[number]} images with another camera, "
        line += f"{calibration.errors_px[number]:.3f} px"
        if number:
            distance_mm = 1000 * hypot(*calibration.T_world_cam[number][:3, 3])
            shift, rotation = calibration.deviations[number]
            line += f", {distance_mm:.1f} mm from {calibration.names[0]}, standard deviations "
            line += f"{1000 * shift:.2f} mm and {degrees(rotation):.3f}°"
        typer.echo(line)


def _hand_eye_record(calibration: HandEye, quality: CalibrationQuality) -> dict[str, object]:
    """Return the content of the hand-eye file: poses of camera and board, and their errors."""
    from dopepp.geometry.transform_file import transform_record

    mount, other = ("flange", "base") if calibration.mount == "hand" else ("base", "flange")
    return {
        "mount": calibration.mount,
        f"T_{mount}_cam": transform_record(calibration.T_mount_cam),
        f"T_{other}_board": transform_record(calibration.T_other_board),
        "covariance": calibration.covariance.tolist(),
        "expected_error": {"position": quality.shift, "rotation": quality.rotation},
        "poses_used": int(calibration.inliers.sum()),
        "frames": "camera: OpenCV (x right, y down, z forward); metres and radians",
    }
