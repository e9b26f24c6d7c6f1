"""Refinement under faults: camera matrix, CAD file, material, colour, blur, image size.

    python benchmarks/refine_conditions.py [--checkpoint pretrained/NAME] [--images 60]

Each row compares the network's poses without and with refinement, on the same scenes, which were
not used in training. Degrees, millimetres and "worse" are those of parts that are detected without
and with refinement. For the rows with two touching parts, images are twice as wide and high, so
that a part has the same size in pixels.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np
import trimesh
from common import pose_errors, print_head, print_row, use_one_thread

from dopepp.data.sample import Instance
from dopepp.geometry.camera import Transform, crop_camera, transform
from dopepp.geometry.cuboid import CENTROID
from dopepp.geometry.rotation import rotation_vector_to_matrix
from dopepp.inference.estimator import PoseEstimator
from dopepp.inference.refinement.outline import filled_mask, make_outline_mesh, posed
from dopepp.metrics.pose import assign
from dopepp.parts.catalogue import load_part
from dopepp.parts.part import Mesh, Part
from dopepp.virtual import PRESETS, Factory, Scene, render
from dopepp.virtual.backgrounds import ProceduralBackgrounds
from dopepp.virtual.scene import Grooves, Material
from dopepp.virtual.sensor import capture

SEED = 991
CAD_ERROR = 0.0003  # Metres that are added to the mesh everywhere


def on_target(change: Callable[[Material], Material]) -> Callable[[Scene], Scene]:
    """Return a function that changes the targets' material in a scene."""

    def changed(scene: Scene) -> Scene:
        objects = tuple(
            replace(item, material=change(item.material)) if item.is_target else item
            for item in scene.objects
        )
        return replace(scene, objects=objects)

    return changed


def camouflaged(scene: Scene) -> Scene:
    """Give the background the mean colour of the part in the image, with a faint pattern."""
    rendered = render(scene)
    colour = rendered.image[rendered.instances == scene.targets[0]].mean(axis=0)
    faint = colour + 0.1 * (scene.background - scene.background.mean(axis=(0, 1)))
    return replace(scene, background=np.clip(faint, 0, 255).astype(np.uint8))


def blurred(scene: Scene) -> Scene:
    """Add motion blur of 5 pixels."""
    return replace(scene, sensor=replace(scene.sensor, motion_px=(5.0, 0.0)))


LAYERS = Grooves(axis=(0.0, 0.0, 1.0), pitch=0.0002, slope=0.4)
SCENES: dict[str, Callable[[Scene], Scene]] = {
    "as it is": lambda scene: scene,
    "printed layers": on_target(lambda material: replace(material, grooves=LAYERS)),
    "polished metal": on_target(
        lambda material: replace(material, metallic=1.0, roughness=0.25, colour=(0.75, 0.75, 0.78))
    ),
    "background of the part's colour": camouflaged,
    "motion blur 5 px": blurred,
}
"""Faults of the image."""

SIZES = ((640, 480), (1920, 1080))
PAIRS = {"two touching parts of one kind": 0.0, "the same, one under the other by 15 %": 0.15}
"""Share of the second part that the first part hides."""


def paired(scene: Scene, hidden: float, rng: np.random.Generator) -> Scene:
    """Add an equal part beside the scene's part, in the same plane, and remove distractors.

    With ``hidden`` above 0, the second part lies under the first.
    """
    target = scene.objects[scene.targets[0]]
    part, (width, height) = target.part, scene.size
    assert part is not None
    assert part.mesh is not None
    outline = make_outline_mesh(part.mesh.vertices, part.mesh.faces)
    K, size = crop_camera(scene.K, -width // 2, -height // 2), (2 * width, 2 * height)
    # In its plane, the second part has the opposite rotation of the first.
    first, turned, (a, b) = target.T_cam_obj, np.eye(4), target.T_cam_obj[:2, 0]
    turned[:3, :3] = rotation_vector_to_matrix(np.array([0.0, 0.0, 2.0 * math.atan2(b, a)]))
    way, middle = rng.uniform(0.0, 2.0 * math.pi), part.cuboid[CENTROID]
    thickness = np.ptp(part.cuboid[:, 2]) if hidden else 0.0

    def poses(apart: float) -> tuple[Transform, Transform]:
        second = turned.copy()
        second[:3, 3] = middle - turned[:3, :3] @ middle
        second[:3, 3] += apart * math.cos(way), apart * math.sin(way), -thickness
        both = first.copy(), first @ second
        centre = np.mean([transform(T, middle[None])[0] for T in both], axis=0)
        for T in both:
            T[:2, 3] -= centre[:2]
        return both

    def share(apart: float) -> float:
        views = [posed(outline, T, K) for T in poses(apart)]
        over, under = (filled_mask(outline, at, size) for at in views if at is not None)
        return float((over & under).sum() / under.sum())

    near, far = 0.0, 2.0 * part.diameter
    for _ in range(12):
        apart = (near + far) / 2
        near, far = (apart, far) if share(apart) > hidden else (near, apart)
    objects = tuple(replace(target, T_cam_obj=T) for T in poses(far))
    background = ProceduralBackgrounds().draw(rng, *size)
    return replace(scene, K=K, objects=objects, background=background)


def thicker(part: Part) -> Part:
    """Move every vertex outward along its normal."""
    assert part.mesh is not None
    shape = trimesh.Trimesh(part.mesh.vertices, part.mesh.faces, process=False)
    moved = part.mesh.vertices + CAD_ERROR * shape.vertex_normals
    return replace(part, mesh=Mesh(np.asarray(moved), part.mesh.faces))


def measure(
    name: str,
    network: PoseEstimator,
    estimator: PoseEstimator,
    part: Part,
    scenes: list[Scene],
    focal: float = 1.0,
) -> list[str]:
    """Return a row."""
    rows, kept = [], 0
    for scene in scenes:
        image = capture(render(scene).image, scene.sensor)
        K = scene.K * np.array([[focal], [focal], [1.0]])
        K[:2, 2] = scene.K[:2, 2]
        shown = [
            Instance(part.name, scene.objects[number].T_cam_obj, scene.keypoints(number))
            for number in scene.targets
        ]
        errors = np.full((2, len(shown), 2), np.inf)
        for method, of_method in zip((network, estimator), errors, strict=True):
            detections = method.predict(image, K)
            for detection, number in zip(detections, assign(part, detections, shown), strict=True):
                kept += bool(detection.kept)
                if number >= 0:
                    true = shown[number].T_cam_obj
                    error = pose_errors(detection.T_cam_obj, true, part.points)
                    of_method[number] = error.rotation, error.add
        rows.append(errors)
    both = np.concatenate(rows, axis=1)
    is_found = np.isfinite(both[..., 1])
    twice = both[:, is_found.all(axis=0)]

    def pair(values: Iterable[float], text: str) -> str:
        return " → ".join(f"{value:{text}}" for value in values)

    worse = float(np.mean(twice[1, :, 1] > twice[0, :, 1] + 1)) if twice.size else 0.0
    limits = [1e3 * share * part.diameter for share in (0.1, 0.05)]
    return [
        name,
        pair((~is_found).mean(axis=1), ".0%"),
        *(pair((both[..., 1] < limit).mean(axis=1), ".0%") for limit in limits),
        *(pair(np.median(twice[..., c], axis=1), ".1f") for c in (0, 1)),
        f"{worse:.0%}",
        f"{kept / both.shape[1]:.0%}",
    ]


def main() -> None:
    """Print a row per fault."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--checkpoint", default="pretrained/pivconnector")
    parser.add_argument("--images", type=int, default=60)
    arguments = parser.parse_args()
    use_one_thread()
    estimator = PoseEstimator.load(arguments.checkpoint)
    part = load_part(estimator.parts[0].name)
    preset = PRESETS["quickstart"]
    usual = estimator.refining("region", [part])

    def scenes(size: tuple[int, int] | None = None) -> list[Scene]:
        sized = preset if size is None else preset.reframed(*size)
        factory = Factory([part], sized, SEED)
        return [factory.scene(0, index) for index in range(arguments.images)]

    print_head("fault", "missed", "ADD-0.1d", "ADD-0.05d", "°", "ADD mm", "worse by 1 mm", "kept")

    def show(name: str, *given: object, **options: float) -> None:
        print_row(*measure(name, estimator, *given, **options))  # type: ignore[arg-type]

    plain = scenes()
    for name, change in SCENES.items():
        show(name, usual, part, [change(scene) for scene in plain])
    show("focal length 1 % too long", usual, part, plain, focal=1.01)
    show("CAD 0.3 mm too thick", estimator.refining("region", [thicker(part)]), part, plain)
    for name, hidden in PAIRS.items():
        rng = np.random.default_rng(SEED)
        show(name, usual, part, [paired(scene, hidden, rng) for scene in plain])
    for size in SIZES:
        show(f"{size[0]}×{size[1]} pixels", usual, part, scenes(size))


if __name__ == "__main__":
    main()
