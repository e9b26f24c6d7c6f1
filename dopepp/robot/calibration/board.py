"""Calibration boards: printing at true scale, detection in images, and their poses.

A board's frame has x to the right, y down and z into the board. Its origin is the board's upper
left corner (ChArUco) or the first point (other kinds). To add a kind of board, extend
:meth:`Board.points`, :meth:`Board.drawing` and the ``_detect_`` methods.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from dopepp.core.errors import UserError
from dopepp.core.files import check_target, write_file
from dopepp.drawing.pictures import RGBImage
from dopepp.geometry.camera import Transform, make_transform
from dopepp.geometry.camera_file import Camera

PX_PER_MM: Final = 10  # of a printed board: 254 dots per inch, exact for tenths of millimetres
MARGIN_MM: Final = 10
LONGEST_MM: Final = 1200
MIN_POINTS: Final = 8  # fewer points do not separate a board's tilt from its distance
SPELLING: Final = (
    "charuco:COLUMNSxROWS:SQUARE:MARKER[:DICTIONARY], chess:COLUMNSxROWS:SQUARE (inner corners), "
    "circles:COLUMNSxROWS:SPACING (asymmetric); lengths in mm"
)
NUM_FIELDS: Final = {"charuco": (3, 4), "chess": (2, 2), "circles": (2, 2)}
DICTIONARY: Final = "5X5_100"
PIXEL_NOISE: Final = 0.1  # smallest standard deviation of a detected point, pixels
OVERSAMPLING: Final = 2
BACKGROUND: Final = 110

Transforms = Float[np.ndarray, "poses 4 4"]
Grey = UInt8[np.ndarray, "height width"]


@dataclass(frozen=True, eq=False)
class BoardDetection:
    """Points of a calibration board that are detected in an image."""

    name: str  # name of the image
    points: Float[np.ndarray, "n 3"]  # detected points in the board's frame, metres
    pixels: Float[np.ndarray, "n 2"]  # these points in the image


@dataclass(frozen=True, eq=False)
class BoardPose:
    """Pose of a calibration board in the camera frame, estimated from an image."""

    name: str  # name of the image
    T_cam_board: Transform
    # Of the rotation about the board's origin (radians) and translation (metres), camera axes
    covariance: Float[np.ndarray, "6 6"]
    distance: float  # depth of the mean of the detected points, metres


@dataclass(frozen=True)
class Board:
    """A flat calibration target: a ChArUco board, a chessboard or an asymmetric circle grid."""

    kind: str  # `charuco`, `chess` or `circles`
    columns: int  # squares (ChArUco), inner corners (chess board) or circles in a row
    rows: int
    spacing: float  # side of a square; of circles, twice the distance between rows; metres
    marker: float = 0.0  # side of a ChArUco marker, metres
    dictionary: str = DICTIONARY  # ChArUco marker dictionary, without OpenCV's prefix `DICT_`

    @cached_property
    def points(self) -> Float[np.ndarray, "n 3"]:
        """Corners or circle centres that the detector finds, in the board's frame, metres."""
        if self.kind == "charuco":
            return np.asarray(self._charuco.getChessboardCorners(), np.float64)
        column, row = np.meshgrid(np.arange(self.columns), np.arange(self.rows))
        x, y = column * self.spacing, row * self.spacing
        if self.kind == "circles":
            x, y = x + (row % 2) * self.spacing / 2, y / 2
        return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)

    def detect(self, image: RGBImage, name: str) -> BoardDetection | None:
        """Detect the board in an RGB image; return None for under 8 points, or points in a line.

        Raises:
            UserError: The image shows two ChArUco markers of the same number, i.e. two boards.
        """
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        indices, pixels = getattr(self, f"_detect_{self.kind}")(grey)
        points = self.points[indices]
        # Points in a line determine no homography, and OpenCV would reject all views.
        if len(points) < MIN_POINTS or np.linalg.matrix_rank(points - points[0]) < 2:
            return None
        return BoardDetection(name, points, np.asarray(pixels, np.float64).reshape(-1, 2))

    @property
    def first_px(self) -> float:
        """Distance of the board's origin from the upper and left edge of the drawing, pixels."""
        squares = {"charuco": 0.0, "chess": 1.0, "circles": 0.5}[self.kind]
        return PX_PER_MM * (MARGIN_MM + 1000 * squares * self.spacing)

    def drawing(self) -> Grey:
        """Return the grey image to print, with :data:`PX_PER_MM` pixels per millimetre."""
        step, margin = round(self.spacing * 1000 * PX_PER_MM), MARGIN_MM * PX_PER_MM
        if self.kind == "charuco":
            size = (self.columns * step + 2 * margin, self.rows * step + 2 * margin)
            return np.asarray(self._charuco.generateImage(size, marginSize=margin, borderBits=1))
        if self.kind == "chess":
            row, column = np.indices((self.rows + 1, self.columns + 1))
            squares = np.where((row + column) % 2, 255, 0).astype(np.uint8)
            inner = np.kron(squares, np.ones((step, step), np.uint8))
            return np.pad(inner, margin, constant_values=255)
        centres = np.rint(self.points[:, :2] * 1000 * PX_PER_MM + self.first_px).astype(int)
        width, height = (centres.max(axis=0) + margin + step // 2).tolist()
        page = np.full((height, width), 255, np.uint8)
        for x, y in centres.tolist():
            half_px = (2 * x - 1, 2 * y - 1)  # (0, 0) is the centre of a pixel
            cv2.circle(page, half_px, step // 2, 0, -1, cv2.LINE_AA, shift=1)
        return page

    def write(self, path: Path) -> str:
        """Write a PDF or PNG to print; return a text with the page's size and printing advice.

        Raises:
            UserError: The file cannot be written, or a length is not a number of whole pixels.
        """
        step = self.spacing / 2 if self.kind == "circles" else self.spacing
        lengths_px = np.array([step, self.marker]) * 1000 * PX_PER_MM
        if np.abs(lengths_px - np.rint(lengths_px)).max() > 1e-6:
            lengths = " and ".join(f"{1000 * x:g} mm" for x in (self.spacing, self.marker) if x)
            allowed = "lengths in tenths of a millimetre (circles: in fifths)"
            raise UserError(f"a board with {lengths}", allowed, "round the lengths")
        check_target(path, (".pdf", ".png"))
        page, content, dpi = self.drawing(), io.BytesIO(), PX_PER_MM * 25.4
        kind = path.suffix[1:].upper()
        Image.fromarray(page).save(content, kind, resolution=dpi, dpi=(dpi, dpi))
        write_file(path, content.getvalue())
        height, width = (side / PX_PER_MM for side in page.shape)
        return f"{width:g} × {height:g} mm; print at 100 %, not fitted to the page, and measure it"

    @cached_property
    def _charuco(self) -> Any:
        size = (self.columns, self.rows)
        return cv2.aruco.CharucoBoard(size, self.spacing, self.marker, _markers(self.dictionary))

    @cached_property
    def _detector(self) -> Any:
        return cv2.aruco.CharucoDetector(self._charuco)

    def _detect_charuco(self, grey: Grey) -> tuple[Any, Any]:
        """Return indices into :attr:`points` and pixel positions of the detected corners."""
        pixels, indices, _, markers = self._detector.detectBoard(grey)
        if markers is not None and len(np.unique(markers)) < len(markers):
            problem = "an image of two boards with the same markers"
            fix = "cover or remove the second board and take the image again"
            raise UserError(problem, "one visible board", fix)
        return ([], []) if indices is None else (np.ravel(indices), pixels)

    def _detect_chess(self, grey: Grey) -> tuple[Any, Any]:
        """Return indices into :attr:`points` and pixel positions of all inner corners, or none."""
        is_found, pixels = cv2.findChessboardCornersSB(grey, (self.columns, self.rows), None)
        if not is_found:
            return [], []
        # The detector may start at either end of the board. Of the two squares compared here, the
        # first is the darker one if the detector starts at the board's origin.
        grid = pixels.reshape(self.rows, self.columns, 2)
        centres = (grid[:2, k : k + 2].mean(axis=(0, 1)) for k in (0, 1))
        first, second = (
            float(cv2.getRectSubPix(grey, (3, 3), (float(x), float(y))).mean()) for x, y in centres
        )
        return np.arange(len(pixels)), pixels if first < second else pixels[::-1]

    def _detect_circles(self, grey: Grey) -> tuple[Any, Any]:
        """Return indices into :attr:`points` and pixel positions of all circles, or none."""
        size, layout = (self.columns, self.rows), cv2.CALIB_CB_ASYMMETRIC_GRID
        is_found, pixels = cv2.findCirclesGrid(grey, size, None, layout)
        return (np.arange(len(pixels)), pixels) if is_found else ([], [])


def _markers(dictionary: str) -> Any:
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{dictionary}"))


def parse_board(text: str) -> Board:
    """Parse a board's description in the notation of :data:`SPELLING`.

    Raises:
        UserError: The description cannot be parsed, or the board breaks a rule, e.g. on its size.
    """
    kind, *fields = text.split(":")
    fewest, most = NUM_FIELDS.get(kind, (1, 0))
    try:
        if not fewest <= len(fields) <= most:
            raise ValueError(text)
        columns, rows = (int(number) for number in fields[0].lower().split("x"))
        spacing, *marker = (float(length) / 1000 for length in fields[1:3])
        board = Board(kind, columns, rows, spacing, sum(marker), (*fields[3:], DICTIONARY)[0])
        allowed = _violated_rule(board)
    except ValueError:
        allowed = SPELLING
    if allowed:
        fix = "describe the printed board, e.g. charuco:8x11:20:15"
        raise UserError(f"board {text!r:.100}", allowed, fix)
    return board


def _violated_rule(board: Board) -> str:
    """Return the first rule on size, spacing or markers that the board breaks, or ""."""
    if min(board.columns, board.rows) < 3 or not board.spacing >= 0.001:
        return "at least 3×3, squares of at least 1 mm"
    if max(board.columns, board.rows) * board.spacing * 1000 > LONGEST_MM:
        return f"a board of at most {LONGEST_MM} mm"
    if board.kind == "chess" and (board.columns + board.rows) % 2 == 0:
        return "one even and one odd number of corners, so that a half turn changes the board"
    if board.kind == "circles" and board.rows % 2 == 0:
        return "circles in an odd number of rows, so that a half turn changes the board"
    if board.kind != "charuco":
        return ""
    names = [name.removeprefix("DICT_") for name in dir(cv2.aruco) if name.startswith("DICT_")]
    if board.dictionary not in names:
        return f"a dictionary of {', '.join(names)}"
    if not 0 < board.marker < board.spacing:
        return "markers smaller than their squares"
    num_markers = len(_markers(board.dictionary).bytesList)
    if board.columns * board.rows // 2 > num_markers:
        return f"at most {num_markers} markers, the size of {board.dictionary}"
    return ""


def board_pose(detection: BoardDetection, camera: Camera) -> BoardPose:
    """Estimate the board's pose with the smallest reprojection error in a calibrated camera.

    Raises:
        UserError: OpenCV finds no finite pose for the detected points.
    """
    points, pixels = detection.points, detection.pixels
    lens = (camera.K, camera.coefficients)
    _, rotations, shifts, _ = cv2.solvePnPGeneric(points, pixels, *lens, flags=cv2.SOLVEPNP_IPPE)
    poses = [
        cv2.solvePnPRefineLM(points, pixels, *lens, rotation.copy(), shift.copy())
        for rotation, shift in zip(rotations, shifts, strict=True)
    ]
    projections = [cv2.projectPoints(points, *pose, *lens)[0][:, 0] for pose in poses]
    errors = [float(np.square(projection - pixels).sum()) for projection in projections]
    if not errors or not np.isfinite(min(errors)):
        problem = f"{detection.name}, from which no pose of the board can be estimated"
        fix = "delete this image, or take it again with the board facing the camera"
        raise UserError(problem, "a board that faces the camera", fix)
    error = min(errors)
    rotation, shift = poses[errors.index(error)]
    T = make_transform(cv2.Rodrigues(rotation)[0], shift.ravel())
    noise = max(PIXEL_NOISE**2, error / max(1, 2 * len(points) - 6))
    # The derivatives by a rotation of the rotated points are those of a step of `move_pose`.
    jacobian = cv2.projectPoints(points @ T[:3, :3].T, np.zeros(3), T[:3, 3], *lens)[1][:, :6]
    covariance = np.linalg.inv(jacobian.T @ jacobian) * noise
    distance = float((T[:3, :3] @ points.mean(axis=0) + T[:3, 3])[2])
    return BoardPose(detection.name, T, covariance, distance)


def draw_view(
    board: Board, T_cam_board: Transform, camera: Camera, rng: np.random.Generator
) -> RGBImage:
    """Render a board with lens distortion, blur and Gaussian noise of 4 grey levels."""
    assert camera.size is not None
    width, height = camera.size
    steps = (np.arange(OVERSAMPLING) + 0.5) / OVERSAMPLING - 0.5
    u = (np.arange(width)[:, None] + steps).ravel()
    v = (np.arange(height)[:, None] + steps).ravel()
    pixels = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 1, 2)
    rays = cv2.undistortPoints(pixels, camera.K, camera.coefficients)[:, 0]
    R, t = T_cam_board[:3, :3], T_cam_board[:3, 3]
    # A point (x, y, 0) of the board is at R[:, :2] (x, y) + t in the camera.
    homography = np.linalg.inv(np.column_stack([R[:, 0], R[:, 1], t]))
    on_board = np.column_stack([rays, np.ones(len(rays))]) @ homography.T
    on_page = 1000 * PX_PER_MM * on_board[:, :2] / on_board[:, 2:]
    on_page = (on_page + board.first_px - 0.5).astype(np.float32).reshape(len(v), len(u), 2)
    blur = 0.4 * PX_PER_MM * float(1000 * t[2] / camera.K[0, 0])  # blur of the lens, page pixels
    page = cv2.GaussianBlur(board.drawing(), (0, 0), blur)
    border = {"borderMode": cv2.BORDER_CONSTANT, "borderValue": BACKGROUND}
    drawn = cv2.remap(page, on_page[..., 0], on_page[..., 1], cv2.INTER_LINEAR, **border)
    grey = drawn.reshape(height, OVERSAMPLING, width, OVERSAMPLING).mean(axis=(1, 3))
    grey = 20 + 0.8 * grey + rng.normal(0, 4.0, grey.shape)
    return np.repeat(np.clip(np.rint(grey), 0, 255).astype(np.uint8)[..., None], 3, axis=2)
