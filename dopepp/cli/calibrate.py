"""``dopepp calibrate``: a camera, a tool, a bench, and where the camera is on the robot."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from dopepp.cli.errors import report_errors
from dopepp.core.errors import UserError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from dopepp.drawing.pictures import Picture
    from dopepp.robot.calibration.board import Board, BoardPose, Sighting
    from dopepp.robot.calibration.files import Reading
    from dopepp.robot.calibration.hand_eye import HandEye
    from dopepp.robot.calibration.lens import LensCalibration
    from dopepp.robot.calibration.quality import Explanation
    from dopepp.robot.calibration.tool import Bench

BOARD: Final = "e.g. charuco:8x11:20:15, chess:7x10:25, circles:4x11:40 (columns × rows, mm)"

Out = Annotated[Path, typer.Option(help="YAML to write")]
Force = Annotated[
    bool, typer.Option("--force", help="write it even where it is not to be trusted, marked so")
]
BoardSpec = Annotated[str, typer.Option("--board", help=BOARD)]
Pictures = Annotated[Path, typer.Argument(help="folder with pictures of the board")]
Poses = Annotated[
    Path,
    typer.Argument(help="CSV, JSON or YAML: x y z and qw qx qy qz, rx ry rz or roll pitch yaw"),
]
Unit = Annotated[str, typer.Option(help="of positions: m, mm, cm, inch")]
Angles = Annotated[str, typer.Option(help="of rx ry rz and roll pitch yaw: rad, deg")]
Quaternion = Annotated[
    str, typer.Option(help="wxyz as the columns are named; xyzw if w stands in the last")
]
Direction = Annotated[
    str, typer.Option(help="flange-to-base as controllers show it, or base-to-flange")
]

app = typer.Typer(no_args_is_help=True, help=__doc__)


@app.command()
def board(
    what: Annotated[str, typer.Argument(help=BOARD)],
    out: Annotated[Path, typer.Option(help="PDF or PNG to print")],
) -> None:
    """Write a board to print, at true scale."""
    from dopepp.robot.calibration.board import parse_board

    with report_errors():
        typer.echo(f"{out}: {parse_board(what).write(out)}")


@app.command()
def camera(
    source: Annotated[
        str,
        typer.Argument(
            help="pictures of the board: a folder, a video, a ROS bag, a "
            "camera's number or address (Ctrl-C ends it)"
        ),
    ],
    board: BoardSpec,
    out: Out,
    force: Force = False,
) -> None:
    """Calibrate a camera's lens from pictures of a board; write the file that --camera reads."""
    from dopepp.core.files import check_target
    from dopepp.robot.calibration.board import parse_board
    from dopepp.robot.calibration.files import check_trust
    from dopepp.robot.calibration.lens import calibrate_lens, write_camera

    with report_errors():
        check_target(out, (".yaml", ".yml"))
        target = parse_board(board)
        if Path(source).is_dir() and not (Path(source) / "metadata.yaml").exists():
            seen, size = _sightings(Path(source), target)
        else:
            seen, size = _chosen_views(source, target)
        found = calibrate_lens(seen, size)
        _show_lens(found)
        check_trust(found.findings, force)
        write_camera(out, found.camera, not found.findings)
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
    """Find a tool's tip from poses of the flange in which it touches one point."""
    from dopepp.robot.calibration.files import read_robot_poses, write_calibration
    from dopepp.robot.calibration.tool import find_tip

    with report_errors():
        reading = _reading(unit, angles, quaternion, direction)
        tip = find_tip(read_robot_poses(poses).transforms(reading))
        for number, residual in enumerate(tip.residuals):
            typer.echo(f"pose {number + 1}: {1000 * residual:.2f} mm")
        at = ", ".join(f"{1000 * one:.2f}" for one in tip.position)
        off = ", ".join(f"{1000 * one:.2f}" for one in tip.deviations)
        typer.echo(f"tip at ({at}) mm of the flange, ± ({off}) mm")
        values = {"tip": tip.position.tolist(), "deviations": tip.deviations.tolist()}
        write_calibration(out, "tool", values, tip.findings, force)
    typer.echo(f"written: {out}")


@app.command()
def bench(
    source: Annotated[
        Path,
        typer.Argument(
            help="CSV with x, y, z that the tip has touched, or a folder with pictures of a board "
            "that lies on the bench"
        ),
    ],
    out: Out,
    board: Annotated[str | None, typer.Option(help=BOARD)] = None,
    camera: Annotated[Path | None, typer.Option(help="with --board: camera file")] = None,
    hand_eye: Annotated[
        Path | None, typer.Option(help="with --board: what `dopepp calibrate handeye` wrote")
    ] = None,
    poses: Annotated[
        Path | None, typer.Option(help="with --board and a camera in the hand: the robot's poses")
    ] = None,
    unit: Unit = "m",
    angles: Angles = "rad",
    quaternion: Quaternion = "wxyz",
    direction: Direction = "flange-to-base",
    force: Force = False,
) -> None:
    """Find the bench's plane and frame.

    From touched points: origin at the first, x towards the second, z up. From a board: its first
    point and its columns, z out of the board.
    """
    from dopepp.robot.calibration.files import (
        check_unit,
        read_points,
        transform_record,
        write_calibration,
    )
    from dopepp.robot.calibration.tool import find_bench

    with report_errors():
        reading = _reading(unit, angles, quaternion, direction)
        if board is None and source.is_dir():
            got = f"{source}, a folder, without --board"
            raise UserError(got, "a CSV, or pictures with --board", "say which board it is")
        if board is None:
            found = find_bench(read_points(source, check_unit(unit)))
            names = [f"point {number + 1}" for number in range(len(found.residuals))]
        else:
            found, names = _bench_of_board(source, board, camera, hand_eye, poses, reading)
        for name, residual in zip(names, found.residuals, strict=True):
            typer.echo(f"{name}: {1000 * residual:+.2f} mm off the plane")
        values = {"T_base_bench": transform_record(found.T_base_bench)}
        write_calibration(out, "bench", values, found.findings, force)
    typer.echo(f"written: {out}")


@app.command()
def handeye(
    pictures: Pictures,
    poses: Poses,
    board: BoardSpec,
    camera: Annotated[Path, typer.Option(help="camera file, as `dopepp calibrate camera` writes")],
    mount: Annotated[str, typer.Option(help="where the camera is: hand or bench")],
    out: Out,
    unit: Unit = "m",
    angles: Angles = "rad",
    quaternion: Quaternion = "wxyz",
    direction: Direction = "flange-to-base",
    force: Force = False,
) -> None:
    """Find where the camera is, from pictures of a board and the robot's poses."""
    from dopepp.core.files import check_target
    from dopepp.geometry.camera_file import read_camera
    from dopepp.robot.calibration.board import board_pose, parse_board
    from dopepp.robot.calibration.files import matched, read_robot_poses, write_calibration
    from dopepp.robot.calibration.hand_eye import calibrate_hand_eye, check_mount
    from dopepp.robot.calibration.quality import check_poses, explain

    with report_errors():
        check_target(out, (".yaml", ".yml"))
        seat = check_mount(mount)
        reading = _reading(unit, angles, quaternion, direction)
        robot, names = read_robot_poses(poses), _names(pictures)
        paired = matched(robot, names)
        seen, size = _sightings(pictures, parse_board(board))
        lens = read_camera(camera).for_picture(size)
        rows = {names[picture]: row for row, picture in paired}
        boards = [board_pose(one, lens) for one in seen if one.name in rows]
        chosen = [rows[one.name] for one in boards]
        flanges = check_poses(robot, chosen, reading, boards, seat)
        found = calibrate_hand_eye(flanges, boards, seat)
        worth = explain(flanges, boards, found)
        _show_hand_eye(boards, found, worth)
        write_calibration(out, "hand-eye", _hand_eye_record(found, worth), worth.findings, force)
    typer.echo(f"written: {out}")


def _reading(unit: str, angles: str, quaternion: str, direction: str) -> Reading:
    from dopepp.robot.calibration.files import Reading, check_unit

    for name, value, allowed in (
        ("--angles", angles, ("rad", "deg")),
        ("--quaternion", quaternion, ("wxyz", "xyzw")),
        ("--direction", direction, ("flange-to-base", "base-to-flange")),
    ):
        if value not in allowed:
            raise UserError(f"{name} {value}", " or ".join(allowed), "pass one of these")
    return Reading(check_unit(unit), angles == "deg", quaternion, direction == "base-to-flange")


def _names(folder: Path) -> list[str]:
    """Return the names of a folder's pictures, sorted."""
    from dopepp.core.files import PICTURES

    suffixes = (*PICTURES, ".tif", ".tiff")
    names = sorted(one.name for one in folder.glob("*") if one.suffix.lower() in suffixes)
    if not names:
        got = f"{folder} without pictures"
        raise UserError(got, f"a folder with {', '.join(suffixes)}", "pass the pictures' folder")
    return names


def _sightings(folder: Path, board: Board) -> tuple[list[Sighting], tuple[int, int]]:
    """Find the board on a folder's pictures, which have one size."""
    from dopepp.drawing.pictures import read_photo

    seen, size = [], None
    for name in _names(folder):
        picture = read_photo(folder / name)
        own = (picture.shape[1], picture.shape[0])
        if size is not None and own != size:
            got = f"{folder / name} of {own[0]}×{own[1]} among pictures of {size[0]}×{size[1]}"
            raise UserError(got, "pictures of one size", "leave out those of another camera")
        size = own
        sighting = _found(board, picture, name, quiet=False)
        if sighting is not None:
            seen.append(sighting)
    if not seen or size is None:
        raise _unseen(f"{folder}: the board is on none of {len(_names(folder))} pictures")
    return seen, size


def _found(board: Board, picture: Picture, name: str, quiet: bool) -> Sighting | None:
    """Find the board on a picture; where there is none, or more than one, say so."""
    try:
        sighting = board.find(picture, name)
    except UserError as error:
        typer.echo(f"{name}: left out, {error}", err=True)
        return None
    if sighting is None and not quiet:
        typer.echo(f"{name}: no board", err=True)
    return sighting


def _unseen(got: str) -> UserError:
    fix = "check --board: kind, numbers of columns and rows, dictionary"
    return UserError(got, "pictures of the board that --board describes", fix)


def _chosen_views(source: str, board: Board) -> tuple[list[Sighting], tuple[int, int]]:
    """Find the board in a video or before a camera, until it ends, Ctrl-C, or views are enough."""
    from contextlib import suppress

    from dopepp.core.errors import Interruption, interruptible
    from dopepp.inference.frames import open_sources
    from dopepp.robot.calibration.lens import LOOKS_PER_S, Views

    views, size, looked = Views(0), None, 0
    with suppress(Interruption), interruptible(""):
        for one in open_sources([source]):
            stride = 1 if one.count is None else max(1, round((one.rate or 0) / LOOKS_PER_S))
            for frame in one.frames(stride):
                own = (frame.image.shape[1], frame.image.shape[0])
                if size is None:
                    views, size = Views(own[0]), own
                name = Path(frame.name).name if one.rate is None else f"frame {frame.number}"
                sighting = _found(board, frame.image, name, quiet=True) if own == size else None
                looked += 1
                if sighting is not None and views.offer(sighting):
                    typer.echo(f"{name}: view {len(views.kept)}", err=True)
                if views.is_full:
                    break
    if not views.kept or size is None:
        raise _unseen(f"{source}: the board is on none of {looked} pictures")
    typer.echo(f"{len(views.kept)} views that differ, of {looked} pictures", err=True)
    return views.kept, size


def _bench_of_board(
    folder: Path,
    spec: str,
    camera: Path | None,
    hand_eye: Path | None,
    poses: Path | None,
    reading: Reading,
) -> tuple[Bench, list[str]]:
    """Find the bench from pictures of a board on it; return their names, too."""
    from dopepp.core.yaml import read_yaml
    from dopepp.geometry.camera_file import read_camera
    from dopepp.robot.calibration.board import board_pose, parse_board
    from dopepp.robot.calibration.files import matched, read_robot_poses, read_transform
    from dopepp.robot.calibration.tool import bench_of_board

    if camera is None or hand_eye is None:
        got = "--board without --camera and --hand-eye"
        raise UserError(got, "both", "pass what `dopepp calibrate` camera and handeye have written")
    content = read_yaml(hand_eye)
    record = content if isinstance(content, dict) else {}
    in_hand = "T_flange_cam" in record
    if in_hand != (poses is not None):
        got = f"{hand_eye} of a camera {'in the hand' if in_hand else 'on the bench'}, and "
        got += "no --poses" if in_hand else "--poses"
        fix = "add the robot's poses" if in_hand else "leave them out"
        raise UserError(got, "--poses with a camera in the hand, and only then", fix)
    T_mount_cam = read_transform(hand_eye, "T_flange_cam" if in_hand else "T_base_cam")
    seen, size = _sightings(folder, parse_board(spec))
    lens = read_camera(camera).for_picture(size)
    boards = {one.name: board_pose(one, lens).T_cam_board for one in seen}
    mounts = dict.fromkeys(boards, T_mount_cam)
    if poses is not None:
        robot, names = read_robot_poses(poses), _names(folder)
        flanges = robot.transforms(reading)
        paired = {names[picture]: flanges[row] @ T_mount_cam
                  for row, picture in matched(robot, names)}  # fmt: skip
        mounts = {name: paired[name] for name in boards if name in paired}
    found = bench_of_board([mounts[name] @ boards[name] for name in mounts], parse_board(spec))
    if record.get("trusted") is not True:
        found = replace(found, findings=(*found.findings, f"{hand_eye} is not to be trusted"))
    return found, [*mounts]


def _show_lens(found: LensCalibration) -> None:
    for name, error in zip(found.names, found.errors_px, strict=True):
        typer.echo(f"{name}: {error:.3f} px")
    for name in found.outliers:
        typer.echo(f"{name}: left out, far worse than the others")
    typer.echo(f"points cover {found.coverage:.0%} of the picture:")
    for row in found.covered:
        typer.echo("  " + "".join("■ " if cell else "· " for cell in row))
    K, off = found.camera.K, found.deviations
    numbers = zip(("fx", "fy", "cx", "cy"), (K[0, 0], K[1, 1], K[0, 2], K[1, 2]), off, strict=True)
    typer.echo(", ".join(f"{name} {value:.2f} ± {by:.2f}" for name, value, by in numbers) + " px")
    typer.echo(f"reprojection error {found.error_px:.3f} px over {len(found.names)} views")


def _show_hand_eye(boards: Sequence[BoardPose], found: HandEye, worth: Explanation) -> None:
    from math import degrees

    for number, board in enumerate(boards):
        left = "" if found.inliers[number] else "  left out: contradicts the others"
        typer.echo(
            f"{board.name}: {degrees(found.turns[number]):.3f}°, "
            f"{1000 * found.shifts[number]:.2f} mm; without it the camera moves by "
            f"{1000 * worth.leave_one_out[number]:.2f} mm{left}"
        )
    turn, shift = found.robot_noise
    turns = ", ".join(f"{degrees(axis):.0f}°" for axis in worth.diversity)
    typer.echo(
        f"the robot's own error as these show it: {degrees(turn):.3f}°, {1000 * shift:.2f} mm\n"
        f"turns about the three main axes, RMS over pairs: {turns}\n"
        f"to know it better: {worth.next_pose}\n"
        f"expected error at the board's distance: {1000 * worth.shift:.2f} mm, "
        f"{degrees(worth.turn):.3f}°"
    )


def _hand_eye_record(found: HandEye, worth: Explanation) -> dict[str, object]:
    from dopepp.robot.calibration.files import transform_record

    mount, other = ("flange", "base") if found.mount == "hand" else ("base", "flange")
    return {
        "mount": found.mount,
        f"T_{mount}_cam": transform_record(found.T_mount_cam),
        f"T_{other}_board": transform_record(found.T_other_board),
        "covariance": [[float(one) for one in row] for row in found.covariance],
        "expected_error": {"position": worth.shift, "rotation": worth.turn},
        "poses_used": int(found.inliers.sum()),
        "frames": "camera: OpenCV (x right, y down, z forward); metres and radians",
    }
