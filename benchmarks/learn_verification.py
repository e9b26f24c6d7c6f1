"""Learn the verification of poses from refined poses of procedural parts.

    python benchmarks/learn_verification.py samples.npz --parts 60 --scenes 40 [--photos DIR]
    python benchmarks/learn_verification.py samples.npz --fit

The first command renders random parts among clutter, occluders and look-alikes. It refines poses
that start near and far from the true pose, and stores their evidence and whether they are correct.
Run it with several ``--seed`` values in parallel and pass all files to ``--fit``. This command fits
the model, prints its quality on held-out parts, and writes ``verification.json``.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
import trimesh
from manifold3d import Manifold
from sklearn.metrics import average_precision_score, brier_score_loss, log_loss

from dopepp.geometry.camera import Transform, make_transform, move_pose
from dopepp.geometry.rotation import random_rotation
from dopepp.inference.refinement import verification
from dopepp.inference.refinement.outline import make_outline_mesh
from dopepp.inference.refinement.refiner import INFLATION
from dopepp.inference.refinement.region import RegionRefiner
from dopepp.inference.refinement.solver import Prior
from dopepp.inference.refinement.verification import EVIDENCE, VerificationModel, Verifier
from dopepp.metrics.functional import add, add_s
from dopepp.parts.part import Mesh, Part, make_part
from dopepp.virtual.backgrounds import find_backgrounds
from dopepp.virtual.factory import Factory
from dopepp.virtual.presets import Preset, preset_of

SIZE, FOCAL = (320, 240), 300.0
SMALLEST_PX, LARGEST_PX = 40.0, 190.0
UNITS, WEIGHT_DECAY, STEPS, BLUR = 6, 3e-4, 3000, 0.15
WEAKENED = ("shading", "crease_gain")
FOR_OR_AGAINST = {
    **dict.fromkeys(("outline", "outline_gain", "outline_weakest", "crease", "crease_gain"), 1.0),
    **dict.fromkeys(("contrast", "inside", "shading"), 1.0),
    **dict.fromkeys(("outside", "residual", "moved", "spread"), -1.0),
}
MACHINED = 0.5  # share of parts with holes and pockets
HELD_OUT = 5  # every fifth part is held out


def random_part(rng: np.random.Generator, name: str) -> Part:
    """Return a machined part, a bumpy body with primitives on it, or touching primitives."""
    if rng.random() < MACHINED:
        solid = _machined(rng).to_mesh()
        return _scaled(rng, name, np.asarray(solid.vert_properties, np.float64), solid.tri_verts)
    is_lump = rng.random() < 0.5
    pieces = [_lump(rng) if is_lump else _primitive(rng, 1.0)]
    for _ in range(int(rng.integers(0, 4) if is_lump else rng.integers(1, 7))):
        piece = _primitive(rng, rng.uniform(0.15, 0.6))
        base = pieces[int(rng.integers(len(pieces)))]
        point = base.bounds[0] + rng.uniform(0, 1, 3) * np.ptp(base.bounds, axis=0)
        axis = int(rng.integers(3))
        point[axis] = base.bounds[int(rng.integers(2))][axis]
        piece.apply_translation(point)
        pieces.append(piece)
    colours = rng.integers(20, 236, (len(pieces), 3)) if rng.random() < 0.3 else None
    mesh = trimesh.util.concatenate(pieces)
    painted = None
    if colours is not None:
        painted = np.repeat(colours, [len(p.vertices) for p in pieces], axis=0).astype(np.uint8)
    return _scaled(rng, name, np.asarray(mesh.vertices, np.float64), mesh.faces, painted)


def _scaled(
    rng: np.random.Generator,
    name: str,
    vertices: np.ndarray,
    faces: np.ndarray,
    colours: np.ndarray | None = None,
) -> Part:
    """Return a part of random size, centred at its origin."""
    vertices = vertices - (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    vertices *= rng.uniform(0.03, 0.2) / np.ptp(vertices, axis=0).max()
    return make_part(name, Mesh(vertices, faces.astype(np.int32), colours=colours))


def _machined(rng: np.random.Generator) -> Manifold:
    """Return plates and blocks at right angles, with bosses, holes, slots and pockets."""
    sides = np.array([1.0, rng.uniform(0.3, 1.0), rng.uniform(0.05, 0.4)])[rng.permutation(3)]
    solid = Manifold.cube(sides, True)
    for _ in range(int(rng.integers(0, 4))):
        sides = np.array([*rng.uniform(0.2, 0.9, 2), rng.uniform(0.05, 0.3)])[rng.permutation(3)]
        solid += Manifold.cube(sides, True).translate(_spot(rng, solid))
    for _ in range(int(rng.integers(0, 4))):
        solid += _bore(rng, rng.uniform(0.05, 0.25), rng.uniform(0.1, 0.5), solid)
    for _ in range(int(rng.integers(1, 9))):
        depth = 3.0 if rng.random() < 0.6 else rng.uniform(0.05, 0.4)
        if rng.random() < 0.65:
            solid -= _bore(rng, rng.uniform(0.02, 0.18), depth, solid)
        else:
            sides = np.array([*rng.uniform(0.05, 0.4, 2), depth])[rng.permutation(3)]
            solid -= Manifold.cube(sides, True).translate(_spot(rng, solid))
    largest = max(solid.decompose(), key=lambda piece: piece.volume())
    return largest if largest.volume() > 1e-4 else Manifold.cube([1.0, 0.6, 0.2], True)


def _bore(rng: np.random.Generator, radius: float, length: float, solid: Manifold) -> Manifold:
    """Return a cylinder along an axis, at a random point of the solid's bounding box."""
    turns = [[0, 0, 0], [90, 0, 0], [0, 90, 0]][int(rng.integers(3))]
    sections = int(rng.choice([6, 32, 32, 32]))
    bore = Manifold.cylinder(length, radius, -1.0, sections, True).rotate(turns)
    return bore.translate(_spot(rng, solid))


def _spot(rng: np.random.Generator, solid: Manifold) -> np.ndarray:
    """Return a random point on the faces of a solid's bounding box."""
    low, high = np.array(solid.bounding_box()).reshape(2, 3)
    point = low + rng.uniform(0.05, 0.95, 3) * (high - low)
    axis = int(rng.integers(3))
    point[axis] = (low, high)[int(rng.integers(2))][axis]
    return point


def _lump(rng: np.random.Generator) -> trimesh.Trimesh:
    """Return a bumpy body, similar to a scanned object."""
    lump = trimesh.creation.icosphere(4, 0.5)
    points = lump.vertices * rng.uniform(0.35, 1.0, 3)
    for _ in range(int(rng.integers(3, 12))):
        wave, frequency = rng.normal(size=3), rng.uniform(3.0, 30.0)
        height = rng.uniform(0.01, 0.25) / math.sqrt(frequency)
        phase = frequency * (points @ wave / np.linalg.norm(wave)) + rng.uniform(0, 2 * math.pi)
        points = points * (1 + height * np.sin(phase))[:, None]
    lump.vertices = points
    return lump


def _primitive(rng: np.random.Generator, size: float) -> trimesh.Trimesh:
    sides = size * rng.uniform(0.12, 1.0, 3)
    kind = rng.integers(6)
    if kind <= 1:
        piece = trimesh.creation.box(sides)
    elif kind == 2:
        sections = int(rng.choice([3, 6, 8, 32]))
        piece = trimesh.creation.cylinder(sides[0] / 2, sides[1], sections=sections)
    elif kind == 3:
        piece = trimesh.creation.annulus(sides[0] * rng.uniform(0.2, 0.4), sides[0] / 2, sides[1])
    elif kind == 4:
        piece = trimesh.creation.cone(sides[0] / 2, sides[1], sections=int(rng.choice([4, 32])))
    else:
        piece = trimesh.creation.icosphere(2, sides[0] / 2)
    if rng.random() < 0.3:
        turned = random_rotation(rng)
    else:
        turned = np.eye(3)[rng.permutation(3)]
        turned *= np.linalg.det(turned)
    piece.apply_transform(make_transform(turned, np.zeros(3)))
    return piece


def look_alike(rng: np.random.Generator, part: Part) -> Part:
    """Return a part that is mirrored, stretched, or cut off at one end."""
    assert part.mesh is not None
    vertices, faces = part.mesh.vertices.copy(), part.mesh.faces
    kind, axis = rng.integers(3), int(rng.integers(3))
    if kind == 0:
        vertices[:, axis] *= -1
        faces = faces[:, ::-1]
    elif kind == 1:
        vertices[:, axis] *= rng.choice([0.7, 1.3, 1.45])
    else:
        centre = vertices[faces].mean(axis=1)[:, axis]
        low, high = centre.min(), centre.max()
        faces = faces[centre < low + rng.uniform(0.5, 0.75) * (high - low)]
    return make_part(
        "other", Mesh(vertices, np.ascontiguousarray(faces), colours=part.mesh.colours)
    )


def starts(
    rng: np.random.Generator, T: Transform, part: Part, K: np.ndarray
) -> Iterator[tuple[Transform, np.ndarray]]:
    """Yield start poses with covariances similar to those of a network."""
    depth = T[2, 3]
    for turn_deg, across, along in (
        (3.0, 0.01, 0.01), (6.0, 0.03, 0.03), (9.0, 0.04, 0.05), (15.0, 0.05, 0.08),
        (30.0, 0.05, 0.05), (180.0, 0.02, 0.08), (180.0, 0.6, 0.1), (180.0, 2.0, 0.3),
    ):  # fmt: skip
        turn = rng.normal(size=3)
        turn *= math.radians(turn_deg) * rng.uniform(0.2, 1.0) / np.linalg.norm(turn)
        # The line of sight is almost parallel to z in these images.
        shift = np.array([*(across * part.diameter * rng.normal(size=2)), along * depth])
        shift[2] *= rng.normal() if along < 0.3 else rng.uniform(-1.0, 1.0)
        start = move_pose(T, np.concatenate([turn, shift]))
        if across >= 1.0:  # anywhere in the image
            pixel = rng.uniform(0.15, 0.85, 2) * SIZE
            start[:2, 3] = (pixel - K[:2, 2]) / FOCAL * start[2, 3]
        stated = rng.uniform(0.5, 2.0) * np.array([math.radians(7.0), 0.03, 0.04])
        deviations = np.repeat([stated[0], stated[1] * part.diameter, stated[2] * depth], [3, 2, 1])
        yield start, np.diag(deviations**2)


def scene_preset(
    size: tuple[int, int], focal: float, distances: tuple[float, float], **fields: object
) -> Preset:
    """Return a preset with any rotation among clutter.

    Args:
        size: Width and height in pixels.
        focal: Focal length in pixels.
        distances: Nearest and farthest distance of the part, metres.
        fields: Other fields of the preset.
    """
    width, height = size
    return preset_of(
        "wide",
        {
            "width": width, "height": height,
            "intrinsics_px": [focal, focal, width / 2 - 0.5, height / 2 - 0.5],
            "turning": {"kind": "free"},
            "placement": {"kind": "distance", "nearest": distances[0], "farthest": distances[1]},
            "clutter": [0, 60], "background_contrast": [0.5, 1.8],
            **fields,
        },
        "scene",
    )  # fmt: skip


def samples(number: int, num_scenes: int, seed: int, photos: str | None) -> Iterator[np.ndarray]:
    """Yield evidence, label and part number of the refined poses of one part."""
    rng = np.random.default_rng([seed, number])
    part = random_part(rng, f"part{number}")
    assert part.mesh is not None
    diameter = part.diameter
    preset = scene_preset(
        SIZE, FOCAL, (diameter * FOCAL / LARGEST_PX, diameter * FOCAL / SMALLEST_PX),
        min_visible_fraction=0.35,
        distractors={"number": [0, 6], "lookalike_share": 0.4},
        materials={"metal_share": 0.15, "coloured_share": 0.6},
        sensors={
            "blur_probability": 0.6, "blur_px": [0.2, 2.2],
            "motion_probability": 0.3, "motion_px": [1.0, 6.0],
            "read_noise": [0.3, 4.0], "shot_noise": [0.5, 5.0],
            "jpeg_probability": 0.4, "jpeg_quality": [50, 95],
        },
    )  # fmt: skip
    other = look_alike(rng, part)
    # A print has another size than its CAD file.
    printed = replace(part.mesh, vertices=part.mesh.vertices * rng.normal(1.0, 0.008))
    shown_part = make_part(part.name, printed)
    backgrounds = find_backgrounds(photos, "train")
    true, false = (
        Factory([shown], preset, seed, backgrounds, negatives=[unlike])
        for shown, unlike in ((shown_part, other), (other, shown_part))
    )
    mesh = make_outline_mesh(part.mesh.vertices, part.mesh.faces)
    refiner, verifier = RegionRefiner(part.mesh.vertices, part.mesh.faces), Verifier(mesh, diameter)
    points = torch.from_numpy(part.points)
    for index in range(num_scenes):
        shows_part = index % 4 > 0
        rendered = (true if shows_part else false).render(0, 1000 * number + index)
        scene, image = rendered.scene, rendered.image
        T = scene.objects[scene.targets[0]].T_cam_obj
        empty = np.full_like(image, rng.integers(0, 256, 3))
        for start, covariance in starts(rng, T, part, scene.K):
            refined = refiner.refine(image, scene.K, start, INFLATION**2 * covariance, starts=list)
            given = Prior(start, np.linalg.inv(covariance))
            stated = covariance if refined.covariance is None else refined.covariance
            sure = rng.uniform(0.05, 1.0) * covariance
            moved_by = given.squared_distance(refined.T_cam_obj) ** 0.5
            # Unrefined poses are verified too, also on an image without the part.
            for pixels, end, deviation, distance in (
                (image, refined.T_cam_obj, stated, moved_by),
                (image, start, sure, 0.0),
                (empty + rng.integers(0, int(rng.integers(1, 40)), image.shape), start, sure, 0.0),
            ):
                clipped = np.clip(pixels, 0, 255).astype(np.uint8)
                evidence = verifier.evidence(clipped, scene.K, end, deviation, distance)
                if evidence is not None:
                    far, near = errors(end, T, points, diameter)
                    # ADD-S is small for a correct pose of a nearly symmetric part.
                    looks_right = far < 0.1 or near < 0.015
                    is_right = shows_part and pixels is image and looks_right
                    yield np.array([*evidence, is_right, number, far, near])


def errors(
    T_est: Transform, T_true: Transform, points: torch.Tensor, diameter: float
) -> tuple[float, float]:
    """Return ADD and ADD-S, diameters."""
    poses = [torch.from_numpy(np.ascontiguousarray(T[None])) for T in (T_est, T_true)]
    R_t = [piece for T in poses for piece in (T[:, :3, :3], T[:, :3, 3])]
    return float(add(*R_t, points)) / diameter, float(add_s(*R_t, points)) / diameter


def fit(inputs: np.ndarray, labels: np.ndarray, seed: int = 0) -> VerificationModel:
    """Fit the model by maximum likelihood, monotone in the evidence of ``FOR_OR_AGAINST``.

    Real images have weaker creases and less regular shading than renders. Therefore both are
    weakened at random, and noise is added to all evidence.
    """
    torch.manual_seed(seed)
    mean, scale = inputs.mean(axis=0), inputs.std(axis=0) + 1e-6
    x, y = torch.from_numpy((inputs - mean) / scale).float(), torch.from_numpy(labels).float()
    signs = torch.tensor([FOR_OR_AGAINST.get(name, 0.0) for name in EVIDENCE])[:, None]
    weakened = [EVIDENCE.index(name) for name in WEAKENED]
    offsets = torch.from_numpy(mean / scale).float()[weakened]
    hidden = torch.nn.Parameter(0.3 * torch.randn(len(signs), UNITS))
    shifts = torch.nn.Parameter(0.5 * torch.randn(UNITS))
    output = torch.nn.Parameter(0.3 * torch.randn(UNITS))
    bias = torch.nn.Parameter(torch.zeros(()))

    def weights() -> tuple[torch.Tensor, torch.Tensor]:
        positive = torch.nn.functional.softplus
        return torch.where(signs == 0, hidden, signs * positive(hidden - 1.5)), positive(
            output - 0.5
        )

    optimizer = torch.optim.AdamW([hidden, shifts, output, bias], 1e-2, weight_decay=WEIGHT_DECAY)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, STEPS)
    for _ in range(STEPS):
        chosen = torch.randint(len(x), (1024,))
        batch = x[chosen].clone()
        factors = torch.empty(len(batch), len(weakened)).uniform_(0.25, 1.0)
        batch[:, weakened] = (batch[:, weakened] + offsets) * factors - offsets
        batch += BLUR * torch.randn_like(batch)
        inside, outside = weights()
        odds = torch.tanh(batch.clamp(-4, 4) @ inside + shifts) @ outside + bias
        loss = torch.nn.functional.binary_cross_entropy_with_logits(odds, y[chosen])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    learned = (
        array.detach().double().numpy() for array in (weights()[0], shifts, weights()[1], bias)
    )
    return VerificationModel(mean, scale, *learned)


def main() -> None:
    """Write samples, or fit the model."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("samples", type=Path, nargs="+")
    parser.add_argument("--parts", type=int, default=60)
    parser.add_argument("--scenes", type=int, default=40)
    parser.add_argument("--first", type=int, default=0, help="number of the first part")
    parser.add_argument("--photos", help="folder of background photos; default: procedural")
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--fit", action="store_true")
    options = parser.parse_args()
    if not options.fit:
        rows: list[np.ndarray] = []
        for number in range(options.first, options.first + options.parts):
            rows += samples(number, options.scenes, options.seed, options.photos)
            right = np.mean([row[len(EVIDENCE)] for row in rows])
            print(number, len(rows), f"{right:.2f} correct", flush=True)
            np.savez(options.samples[0], rows=np.array(rows))
        return
    table = np.concatenate([np.load(path)["rows"] for path in options.samples])
    count = len(EVIDENCE)
    inputs, labels, parts = table[:, :count], table[:, count], table[:, count + 1].astype(int)
    held = parts % HELD_OUT == 0
    model = fit(inputs[~held], labels[~held])
    report(model, inputs[held], labels[held])
    final = fit(inputs, labels)
    names = " ".join(path.name for path in options.samples)
    values = {
        "command": f"python benchmarks/learn_verification.py {names} --fit",
        "evidence": EVIDENCE,
        **{name: np.round(value, 5).tolist() for name, value in final._asdict().items()},
    }
    path = Path(verification.__file__).with_name("verification.json")
    path.write_text(json.dumps(values, indent=1) + "\n", "utf-8")
    print(f"written: {path}")


def report(model: VerificationModel, inputs: np.ndarray, labels: np.ndarray) -> None:
    """Print the quality on held-out parts, and the average precision of each single number."""
    probability = 1 / (1 + np.exp(-model.log_odds(inputs)))
    print(f"{len(labels)} poses, {labels.mean():.1%} right")
    print(
        f"AP {average_precision_score(labels, probability):.4f}, "
        f"log loss {log_loss(labels, probability):.4f}, "
        f"Brier {brier_score_loss(labels, probability):.4f}"
    )
    for low in np.arange(0, 1, 0.1):
        bin_ = (probability >= low) & (probability < low + 0.1)
        if bin_.any():
            stated, observed = probability[bin_].mean(), labels[bin_].mean()
            print(f"  stated {stated:.2f}, observed {observed:.2f} ({bin_.sum()})")
    for name, column in zip(EVIDENCE, inputs.T, strict=True):
        both = [average_precision_score(labels, sign * column) for sign in (1, -1)]
        print(f"  {name:16s} alone: AP {max(both):.3f}")


if __name__ == "__main__":
    main()
