"""Calibration boards: printed at true scale, found on pictures, with their poses.

A board's frame has its origin at the first point, x along the columns, y along the rows and z
into the board. :func:`draw_view` renders pictures of a board to rehearse a calibration. To add a
kind, write its points, its picture and its finder below.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image
from scipy.spatial.transform import Rotation

from dopepp.core.errors import UserError
from dopepp.core.files import check_target, write_whole
from dopepp.drawing.pictures import Picture
from dopepp.geometry.camera import Transform, make_transform
from dopepp.geometry.camera_file import Camera

PX_PER_MM: Final = 10
"""Of a printed board: 254 dots per inch, so that sizes in tenths of millimetres are exact."""

MARGIN_MM: Final = 10
LONGEST_MM: Final = 1200
MIN_POINTS: Final = 8  # fewer do not tell a board's turn from its distance
SPELLING: Final = (
    "charuco:COLUMNSxROWS:SQUARE:MARKER[:DICTIONARY], chess:COLUMNSxROWS:SQUARE (inner corners), "
    "circles:COLUMNSxROWS:SPACING (asymmetric); lengths in mm"
)

DICTIONARY: Final = "5X5_100"

PIXEL_NOISE: Final = 0.1  # of a found point, pixels, where the picture itself shows less
OVERSAMPLED: Final = 2
BACKGROUND: Final = 110

Transforms = Float[np.ndarray, "poses 4 4"]


@dataclass(frozen=True, eq=False)
class Sighting:
    """A board on a picture."""

    name: str  # of the picture
    points: Float[np.ndarray, "n 3"]  # of the board that were found, in its frame, metres
    pixels: Float[np.ndarray, "n 2"]  # where they are


@dataclass(frozen=True, eq=False)
class BoardPose:
    """A board's pose on a picture."""

    name: str  # the picture's
    T_cam_board: Transform  # the pose
    # Of a turn about the board's origin and a shift, camera axes (radians, metres).
    covariance: Float[np.ndarray, "6 6"]
    error_px: float  # RMS reprojection error, pixels
    distance: float  # from the camera to the middle of the points, metres


@dataclass(frozen=True)
class Board:
    """A flat target."""

    kind: str  # `charuco`, `chess` or `circles`
    columns: int  # squares across (ChArUco), inner corners (chess board), circles in a row
    rows: int  # the same, downwards
    spacing: float  # side of a square; of circles, twice the step from row to row; metres
    marker: float = 0.0  # side of a ChArUco marker, metres
    dictionary: str = DICTIONARY  # of the ChArUco markers, without OpenCV's `DICT_`

    @cached_property
    def points(self) -> Float[np.ndarray, "n 3"]:
        """All points in the board's frame, metres."""
        if self.kind == "charuco":
            return np.asarray(self._charuco.getChessboardCorners(), np.float64)
        column, row = np.meshgrid(np.arange(self.columns), np.arange(self.rows))
        x, y = column * self.spacing, row * self.spacing
        if self.kind == "circles":
            x, y = x + (row % 2) * self.spacing / 2, y / 2
        return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)

    def find(self, picture: Picture, name: str) -> Sighting | None:
        """Find the board on an RGB picture; None where fewer than 8 points are seen.

        A :class:`UserError`: two ChArUco boards of one kind are in sight.
        """
        grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
        chosen, pixels = getattr(self, f"_find_{self.kind}")(grey)
        if len(chosen) < MIN_POINTS:
            return None
        return Sighting(name, self.points[chosen], np.asarray(pixels, np.float64).reshape(-1, 2))

    @property
    def first_px(self) -> float:
        """Where the frame's origin is from the drawing's upper and left border, pixels."""
        squares = {"charuco": 0.0, "chess": 1.0, "circles": 0.5}[self.kind]
        return PX_PER_MM * (MARGIN_MM + 1000 * squares * self.spacing)

    def drawing(self) -> UInt8[np.ndarray, "height width"]:
        """Return the board as it is printed, :data:`PX_PER_MM` pixels a millimetre."""
        step, margin = round(self.spacing * 1000 * PX_PER_MM), MARGIN_MM * PX_PER_MM
        if self.kind == "charuco":
            size = (self.columns * step + 2 * margin, self.rows * step + 2 * margin)
            return np.asarray(self._charuco.generateImage(size, marginSize=margin, borderBits=1))
        if self.kind == "chess":
            row, column = np.indices((self.rows + 1, self.columns + 1))
            squares = np.where((row + column) % 2, 255, 0).astype(np.uint8)
            inner = np.kron(squares, np.ones((step, step), np.uint8))
            return np.pad(inner, margin, constant_values=255)
        at = np.rint(self.points[:, :2] * 1000 * PX_PER_MM + self.first_px).astype(int)
        height, width = at[:, 1].max() + margin + step // 2, at[:, 0].max() + margin + step // 2
        page = np.full((height, width), 255, np.uint8)
        for x, y in at.tolist():
            middle = (2 * x - 1, 2 * y - 1)  # half pixels: (0, 0) is a pixel's centre
            cv2.circle(page, middle, step // 2, 0, -1, cv2.LINE_AA, shift=1)
        return page

    def write(self, path: Path) -> str:
        """Write the board for printing, PDF or PNG; return its size in words."""
        import io

        check_target(path, (".pdf", ".png"))
        page, content = self.drawing(), io.BytesIO()
        dots = PX_PER_MM * 25.4
        if path.suffix.lower() == ".pdf":
            Image.fromarray(page).save(content, "PDF", resolution=dots)
        else:
            Image.fromarray(page).save(content, "PNG", dpi=(dots, dots))
        write_whole(path, content.getvalue())
        height, width = (one / PX_PER_MM for one in page.shape)
        return f"{width:g} × {height:g} mm; print at 100 %, not fitted to the page, and measure it"

    @cached_property
    def _charuco(self) -> Any:
        markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{self.dictionary}"))
        return cv2.aruco.CharucoBoard((self.columns, self.rows), self.spacing, self.marker, markers)

    @cached_property
    def _detector(self) -> Any:
        return cv2.aruco.CharucoDetector(self._charuco)

    def _find_charuco(self, grey: UInt8[np.ndarray, "h w"]) -> tuple[Any, Any]:
        pixels, numbers, _, markers = self._detector.detectBoard(grey)
        if markers is not None and len(np.unique(markers)) < len(markers):
            raise UserError("two boards with the same markers", "one in sight", "cover the other")
        return ([], []) if numbers is None else (np.ravel(numbers), pixels)

    def _find_chess(self, grey: UInt8[np.ndarray, "h w"]) -> tuple[Any, Any]:
        found, pixels = cv2.findChessboardCornersSB(grey, (self.columns, self.rows), None)
        if not found:
            return [], []
        pixels = pixels.reshape(-1, 2)
        # The finder may begin at either end: the square behind the first corner is black.
        grid = pixels.reshape(self.rows, self.columns, 2)
        first, second = (self._shade(grey, grid[:2, k : k + 2]) for k in (0, 1))
        return np.arange(len(pixels)), pixels if first < second else pixels[::-1]

    def _shade(self, grey: UInt8[np.ndarray, "h w"], corners: Float[np.ndarray, "2 2 2"]) -> float:
        """Return the brightness in the middle of a square."""
        x, y = corners.mean(axis=(0, 1))
        return float(cv2.getRectSubPix(grey, (3, 3), (float(x), float(y))).mean())

    def _find_circles(self, grey: UInt8[np.ndarray, "h w"]) -> tuple[Any, Any]:
        layout = cv2.CALIB_CB_ASYMMETRIC_GRID
        found, pixels = cv2.findCirclesGrid(grey, (self.columns, self.rows), None, layout)
        return (np.arange(len(pixels)), pixels) if found else ([], [])


def parse_board(text: str) -> Board:
    """Read a board's description (:data:`SPELLING`); what is none is a :class:`UserError`."""
    kind, _, rest = text.partition(":")
    fields = rest.split(":")
    try:
        columns, rows = (int(one) for one in fields[0].lower().split("x"))
        spacing, *marker = (float(one) / 1000 for one in fields[1:3])
    except ValueError as error:
        raise _refused(text, SPELLING) from error
    fewest, most = {"charuco": (3, 4), "chess": (2, 2), "circles": (2, 2)}.get(kind, (0, 0))
    if not fewest <= len(fields) <= most:
        raise _refused(text, SPELLING)
    dictionary = (*fields[3:], DICTIONARY)[0]
    board = Board(kind, columns, rows, spacing, sum(marker), dictionary)
    _check(board, text)
    return board


def _check(board: Board, text: str) -> None:
    longest = max(board.columns, board.rows) * board.spacing * 1000
    if min(board.columns, board.rows) < 3 or not board.spacing >= 0.001:
        raise _refused(text, "at least 3×3, squares of at least 1 mm")
    if longest > LONGEST_MM:
        raise _refused(text, f"a board of at most {LONGEST_MM} mm")
    if board.kind == "charuco":
        names = [one[5:] for one in dir(cv2.aruco) if one.startswith("DICT_")]
        if board.dictionary not in names:
            raise _refused(text, "a dictionary of " + ", ".join(names))
        if not 0 < board.marker < board.spacing:
            raise _refused(text, "markers smaller than their squares")
        markers = cv2.aruco.getPredefinedDictionary(
            getattr(cv2.aruco, f"DICT_{board.dictionary}")
        ).bytesList
        if board.columns * board.rows // 2 > len(markers):
            raise _refused(text, f"at most {len(markers)} markers, as {board.dictionary} has")
    if board.kind == "chess" and (board.columns + board.rows) % 2 == 0:
        raise _refused(text, "one even and one odd number of corners: others look the same turned")


def _refused(text: str, allowed: str) -> UserError:
    return UserError(f"board {text!r:.100}", allowed, "e.g. charuco:8x11:20:15")


def board_pose(sighting: Sighting, camera: Camera) -> BoardPose:
    """Find a board's pose from its points on a picture of a calibrated camera.

    A :class:`UserError`: the points give no pose.
    """
    points, pixels = sighting.points, sighting.pixels
    lens = camera.coefficients
    _, turns, shifts, _ = cv2.solvePnPGeneric(
        points, pixels, camera.K, lens, flags=cv2.SOLVEPNP_IPPE
    )
    found = [
        cv2.solvePnPRefineLM(points, pixels, camera.K, lens, turn.copy(), shift.copy())
        for turn, shift in zip(turns, shifts, strict=True)
    ]
    projected = [cv2.projectPoints(points, *one, camera.K, lens) for one in found]
    errors = [float(np.square(one[0][:, 0] - pixels).sum()) for one in projected]
    if not errors or not np.isfinite(min(errors)):
        raise UserError(
            f"{sighting.name}: a board without a pose",
            "a board seen from the front",
            "leave it out",
        )
    best = int(np.argmin(errors))
    turn, shift = found[best]
    R = cv2.Rodrigues(turn)[0]
    T = make_transform(R, shift.ravel())
    count = len(points)
    noise = max(PIXEL_NOISE**2, errors[best] / max(1, 2 * count - 6))
    jacobian = _pose_jacobian(points, T, camera)
    covariance = np.linalg.inv(jacobian.T @ jacobian) * noise
    distance = float((T[:3, :3] @ points.mean(axis=0) + T[:3, 3])[2])
    return BoardPose(sighting.name, T, covariance, float(np.sqrt(errors[best] / count)), distance)


def _pose_jacobian(
    points: Float[np.ndarray, "n 3"], T: Transform, camera: Camera
) -> Float[np.ndarray, "m 6"]:
    """Return how pixels move with a turn about the origin and a shift, camera axes."""
    step = np.concatenate([np.full(3, 1e-5), np.full(3, 1e-6)])
    columns = []
    for k in range(6):
        sides = []
        for sign in (-1, 1):
            delta = np.zeros(6)
            delta[k] = sign * step[k]
            moved = displaced(T[None], delta[None])[0]
            turn = cv2.Rodrigues(moved[:3, :3])[0]
            sides.append(
                cv2.projectPoints(points, turn, moved[:3, 3], camera.K, camera.coefficients)[0]
            )
        columns.append((sides[1] - sides[0]).ravel() / (2 * step[k]))
    return np.stack(columns, axis=1)


def displaced(T: Transforms, step: Float[np.ndarray, "poses 6"]) -> Transforms:
    """Turn poses about their own origins and shift them."""
    moved = T.copy()
    moved[:, :3, :3] = Rotation.from_rotvec(step[:, :3]).as_matrix() @ T[:, :3, :3]
    moved[:, :3, 3] += step[:, 3:]
    return moved


def draw_view(
    board: Board,
    T_cam_board: Transform,
    camera: Camera,
    rng: np.random.Generator,
    noise: float = 4.0,
) -> Picture:
    """Draw a board at a pose, with the camera's lens and noise (grey levels).

    Every pixel looks along its ray at the board's plane; two by two rays a pixel.
    """  # fmt: skip
    assert camera.size is not None
    width, height = camera.size
    steps = (np.arange(OVERSAMPLED) + 0.5) / OVERSAMPLED - 0.5
    u = (np.arange(width)[:, None] + steps).ravel()
    v = (np.arange(height)[:, None] + steps).ravel()
    pixels = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 1, 2)
    rays = cv2.undistortPoints(pixels, camera.K, camera.coefficients)[:, 0]
    R, t = T_cam_board[:3, :3], T_cam_board[:3, 3]
    # A point of the board, (x, y, 0), is seen along R[:, :2] (x, y) + t.
    homography = np.linalg.inv(np.column_stack([R[:, 0], R[:, 1], t]))
    on_board = np.column_stack([rays, np.ones(len(rays))]) @ homography.T
    at = 1000 * PX_PER_MM * on_board[:, :2] / on_board[:, 2:]
    at = (at + board.first_px - 0.5).astype(np.float32).reshape(len(v), len(u), 2)
    blur = 0.4 * PX_PER_MM * float(1000 * t[2] / camera.K[0, 0])  # of the page, as a lens does
    page = cv2.GaussianBlur(board.drawing(), (0, 0), blur)
    drawn = cv2.remap(
        page, at[..., 0], at[..., 1], cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT, borderValue=BACKGROUND,
    )  # fmt: skip
    grey = drawn.reshape(height, OVERSAMPLED, width, OVERSAMPLED).mean(axis=(1, 3))
    grey = 20 + 0.8 * grey + rng.normal(0, noise, grey.shape)
    return np.repeat(np.clip(np.rint(grey), 0, 255).astype(np.uint8)[..., None], 3, axis=2)
