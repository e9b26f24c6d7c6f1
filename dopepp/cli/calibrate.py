"""``dopepp calibrate``: a camera, a tool, a bench, and where the camera is on the robot."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from dopepp.cli.errors import report_errors
from dopepp.core.errors import UserError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from dopepp.robot.calibration.board import Board, Sighting
    from dopepp.robot.calibration.explanation import Explanation
    from dopepp.robot.calibration.hand_eye import BoardPose, HandEye
    from dopepp.robot.calibration.lens import LensCalibration
    from dopepp.robot.calibration.robot_poses import Reading

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
def camera(pictures: Pictures, board: BoardSpec, out: Out, force: Force = False) -> None:
    """Calibrate a camera's lens from pictures of a board; write the file that --camera reads."""
    from dopepp.core.files import check_target
    from dopepp.robot.calibration.board import parse_board
    from dopepp.robot.calibration.files import check_trust
    from dopepp.robot.calibration.lens import calibrate_lens, write_camera

    with report_errors():
        check_target(out, (".yaml", ".yml"))
        seen, size = _sightings(pictures, parse_board(board))
        found = calibrate_lens(seen, size)
        _show_lens(found)
        check_trust(found.findings, force)
        write_camera(out, found.camera, not found.findings)
    typer.echo(f"written: {out}")


@app.command()
def tcp(
    poses: Poses,
    out: Out,
    unit: Unit = "m",
    angles: Angles = "rad",
    quaternion: Quaternion = "wxyz",
    direction: Direction = "flange-to-base",
    force: Force = False,
) -> None:
    """Find a tool's tip from poses of the flange in which it touches one point."""
    from dopepp.robot.calibration.files import write_calibration
    from dopepp.robot.calibration.robot_poses import read_robot_poses
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
    points: Annotated[Path, typer.Argument(help="CSV with x, y, z that the tip has touched")],
    out: Out,
    unit: Unit = "m",
    force: Force = False,
) -> None:
    """Find the bench's plane and frame: origin at the first point, x towards the second."""
    from dopepp.robot.calibration.files import transform_record, write_calibration
    from dopepp.robot.calibration.robot_poses import check_unit, read_points
    from dopepp.robot.calibration.tool import find_bench

    with report_errors():
        found = find_bench(read_points(points, check_unit(unit)))
        for number, residual in enumerate(found.residuals):
            typer.echo(f"point {number + 1}: {1000 * residual:+.2f} mm off the plane")
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
    from dopepp.robot.calibration.board import parse_board
    from dopepp.robot.calibration.explanation import explain
    from dopepp.robot.calibration.faults import check_poses
    from dopepp.robot.calibration.files import write_calibration
    from dopepp.robot.calibration.hand_eye import board_pose, calibrate_hand_eye, check_mount
    from dopepp.robot.calibration.robot_poses import matched, read_robot_poses

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
    from dopepp.robot.calibration.robot_poses import Reading, check_unit

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
        sighting = board.find(picture, name)
        if sighting is None:
            typer.echo(f"{name}: no board", err=True)
        else:
            seen.append(sighting)
    if not seen or size is None:
        got = f"{folder}: the board is on none of {len(_names(folder))} pictures"
        fix = "check --board: kind, numbers of columns and rows, dictionary"
        raise UserError(got, "pictures of the board that --board describes", fix)
    return seen, size


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
    import math

    for number, one in enumerate(boards):
        left = "" if found.inliers[number] else "  left out: contradicts the others"
        typer.echo(
            f"{one.name}: {math.degrees(found.turns[number]):.3f}°, "
            f"{1000 * found.shifts[number]:.2f} mm; without it the camera moves by "
            f"{1000 * worth.leave_one_out[number]:.2f} mm{left}"
        )
    turn, shift = found.robot_noise
    typer.echo(f"the robot's own error as these show it: {math.degrees(turn):.3f}°, "
               f"{1000 * shift:.2f} mm")  # fmt: skip
    turns = ", ".join(f"{math.degrees(one):.0f}°" for one in worth.diversity)
    typer.echo(f"turns about the three main axes, RMS over pairs: {turns}")
    typer.echo(f"to know it better: {worth.next_pose}")
    typer.echo(
        f"expected error at the board's distance: {1000 * worth.shift:.2f} mm, "
        f"{math.degrees(worth.turn):.3f}°"
    )


def _hand_eye_record(found: HandEye, worth: Explanation) -> dict[str, object]:
    from dopepp.robot.calibration.files import transform_record

    places = (
        ("T_flange_cam", "T_base_board")
        if found.mount == "hand"
        else ("T_base_cam", "T_flange_board")
    )
    return {
        "mount": found.mount,
        places[0]: transform_record(found.T_mount_cam),
        places[1]: transform_record(found.T_other_board),
        "covariance": [[float(one) for one in row] for row in found.covariance],
        "expected_error": {"position": worth.shift, "rotation": worth.turn},
        "poses_used": int(found.inliers.sum()),
        "frames": "camera: OpenCV (x right, y down, z forward); metres and radians",
    }
