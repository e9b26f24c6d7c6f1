"""Options that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

from typer import Argument, Option

from dopepp.core.errors import UserError, check_choice

if TYPE_CHECKING:
    from dopepp.inference.estimator import PoseEstimator

MODEL_HELP: Final = (
    "Checkpoint (best.ckpt of a run), pretrained/NAME, exported network, or mesh file of a part."
)
Model = Annotated[Path, Argument(help=MODEL_HELP)]
Intrinsics = Annotated[
    tuple[float, float, float, float] | None,
    Option("--K", help="fx fy cx cy in pixels (instead of --camera)."),
]
CameraFile = Annotated[
    Path | None, Option(help="Camera file: ROS, OpenCV, BOP, COLMAP, or text with a 3×3 matrix.")
]
KSize = Annotated[
    tuple[int, int] | None,
    Option("--K-size", help="Size of the calibrated image, if it was resized."),
]
Crop = Annotated[
    tuple[int, int, int, int] | None,
    Option(help="x y width height, if the calibrated image was cropped."),
]
Distances = Annotated[
    tuple[float, float] | None,
    Option("--distance", help="Distance range of the parts, metres (default: the training range)."),
]
RefineRegion = Annotated[
    str | None, Option("--refine", help="region: refine the poses on the image.")
]
Conf = Annotated[
    float | None,
    Option(help="Minimum score of a pose, 0 to 1 (default: the checkpoint's; mesh 0.5)."),
]
MaxMs = Annotated[
    float | None, Option(help="Time limit of the refinement per image, milliseconds.")
]
ScaleError = Annotated[
    float | None,
    Option(help="Relative error of part size or focal length (default: 0.005; mesh 0.001)."),
]
Track = Annotated[bool, Option("--track", help="Track the parts from frame to frame.")]
Meshes = Annotated[
    list[str] | None, Option("--part", help="Replacement mesh: built-in part, file, or NAME=FILE.")
]
Unit = Annotated[str | None, Option(help="Unit of the mesh files: mm, cm, m or inch.")]
WorkingDistance = Annotated[
    str | None, Option(help="NEAR,FAR: distances of a mesh, metres; required for a mesh.")
]
Tilt = Annotated[
    float | None,
    Option(help="Largest angle from a mesh's +z axis to the camera, degrees (default: 180)."),
]
Device = Annotated[str, Option(help="PyTorch device, e.g. cpu or cuda.")]


def is_mesh(model: Path) -> bool:
    """Return whether a model is a mesh file or a built-in part, and not a checkpoint."""
    from dopepp.parts.catalogue import BUILTIN
    from dopepp.parts.mesh.read import READERS

    return model.suffix.lower() in READERS or (str(model) in BUILTIN and not model.exists())


def load_estimator(
    model: Path,
    device: str,
    unit: str | None,
    working_distance: str | None,
    tilt: float | None,
    parts: list[str] | None = None,
    max_ms: float | None = None,
    scale_error: float | None = None,
) -> PoseEstimator:
    """Load a checkpoint, or make an estimator for a mesh, which always refines by region.

    The arguments are the values of the options of the same names.

    Raises:
        UserError: The model is invalid, or an option does not apply to it.
    """
    from dopepp.inference.estimator import PoseEstimator

    by_mesh = is_mesh(model)
    kind, other = ("mesh", "checkpoint") if by_mesh else ("checkpoint", "mesh")
    excluded = {
        "--part": by_mesh and parts,
        f"--device {device}": by_mesh and device != "cpu",
        "--working-distance": not by_mesh and working_distance is not None,
        "--tilt": not by_mesh and tilt is not None,
        "--unit": not by_mesh and unit is not None and not parts,
    }
    for option in (option for option, is_given in excluded.items() if is_given):
        problem = f"{option} with the {kind} {model}"
        raise UserError(problem, f"{option} with a {other}", f"leave out {option}")
    if not by_mesh:
        return PoseEstimator.load(model, device, max_ms=max_ms, scale_error=scale_error)
    distances, tilt_deg = distance_range(working_distance), 180.0 if tilt is None else tilt
    return PoseEstimator.from_mesh(
        model, unit, distances, tilt_deg, max_ms=max_ms, scale_error=scale_error
    )


def distance_range(text: str | None) -> tuple[float, float] | None:
    """Parse the value of ``--working-distance``, if any."""
    if text is None:
        return None
    pair = text.strip("[]")  # train.py takes the distances in brackets
    return two_numbers("--working-distance", pair, "NEAR,FAR in metres", "0.3,0.5")


def two_numbers(option: str, text: str, allowed: str, example: str) -> tuple[float, float]:
    """Parse the value of an option that consists of two numbers with a comma between them."""
    try:
        first, second = map(float, text.split(","))
    except ValueError:
        raise UserError(
            f"{option} {text:.100}", allowed, f"write e.g. {option} {example}"
        ) from None
    return first, second


def check_region(refine: str | None) -> None:
    """Check the value of ``--refine`` of a command that only offers refinement by region."""
    if refine is not None:
        check_choice("--refine", refine, ("region",))
