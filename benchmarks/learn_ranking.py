"""Learn the ranking of template matches, and their final score, from procedural parts.

    python benchmarks/learn_ranking.py samples.pickle --parts 40 --scenes 8 [--seed 0]
    python benchmarks/learn_ranking.py samples.pickle --fit

The first command renders random parts in any rotation among clutter and look-alikes. It stores the
features of the ranked matches, and the start score, verification and error of refined poses. Run it
with several ``--seed`` values in parallel and pass all files to ``--fit``. This command fits both
models, prints their quality on held-out parts, and writes ``ranking.json``.
"""

from __future__ import annotations

import argparse
import json
import pickle
from pathlib import Path

import numpy as np
import torch
from learn_verification import errors, look_alike, random_part, scene_preset
from scipy.optimize import minimize
from sklearn.linear_model import LogisticRegression
from sklearn.metrics import brier_score_loss

from dopepp.geometry.camera import Transform
from dopepp.inference.template_estimator import TemplateEstimator
from dopepp.inference.templates import ranking
from dopepp.inference.templates.detector import TemplateDetector
from dopepp.parts.symmetry_finder import find_symmetries
from dopepp.recovery.detection import refined_features
from dopepp.virtual.backgrounds import find_backgrounds
from dopepp.virtual.factory import Factory

SIZE, FOCAL = (480, 360), 450.0
SMALLEST_PX, LARGEST_PX = 70.0, 260.0
RATIO = 1.5  # farthest working distance / nearest working distance
RIGHT_TURN, RIGHT_PLACE, RIGHT_DEPTH = 12.0, 0.08, 0.06  # degrees, diameters, relative
HELD_OUT = 4  # every fourth part is held out
RIDGE = 1e-2
KEPT = 6  # refined poses per image


def samples(number: int, num_scenes: int, seed: int) -> list[dict[str, np.ndarray]]:
    """Return the features and labels of the matches and refined poses of one part's images."""
    rng = np.random.default_rng([seed, number, 1])
    part = random_part(rng, f"part{number}")
    assert part.mesh is not None
    discrete, continuous = find_symmetries(part.mesh)
    if (discrete is not None and len(discrete)) or continuous:
        return []  # several rotations would be correct
    near = part.diameter * FOCAL / rng.uniform(SMALLEST_PX * RATIO, LARGEST_PX)
    distances = (near, RATIO * near)
    preset = scene_preset(
        SIZE, FOCAL, distances,
        min_visible_fraction=0.6,
        distractors={"number": [0, 6], "lookalike_share": 0.3},
        materials={"metal_share": 0.1, "coloured_share": 0.5},
    )  # fmt: skip
    backgrounds, other = find_backgrounds(None, "train"), look_alike(rng, part)
    true = Factory([part], preset, seed, backgrounds, negatives=[other])
    false = Factory([other], preset, seed, backgrounds, negatives=[])
    detector = TemplateDetector(part, distances)
    estimator = TemplateEstimator([detector], distances)
    rows = []
    for index in range(num_scenes):
        shows_part = index % 3 > 0
        rendered = (true if shows_part else false).render(0, 1000 * number + index)
        scene, image = rendered.scene, rendered.image
        T = scene.objects[scene.targets[0]].T_cam_obj
        views, poses, features = detector.ranked(image, scene.K, distances)
        transforms = detector.transforms(views, poses, scene.K)
        is_right = _near(transforms, T, part.diameter) & shows_part
        refined = estimator.refined(detector.detect(image, scene.K), image, scene.K)
        refined.sort(key=lambda detection: -(detection.probability or 0.0))
        best = refined[:KEPT]
        points = torch.from_numpy(part.points)
        ends = [errors(it.T_cam_obj, T, points, part.diameter) for it in best]
        rows.append(
            {
                "features": features,
                "is_right": is_right,
                "odds": np.array([refined_features(it)[2] for it in best]),
                "is_end_right": np.array([far < 0.1 or near < 0.015 for far, near in ends], bool)
                & shows_part,
                "part": np.array(seed * 1000 + number),
            }
        )
    return rows


def _near(transforms: np.ndarray, T: Transform, diameter: float) -> np.ndarray:
    """Return whether each pose is close enough to the true pose for refinement to converge."""
    trace = np.einsum("nij,ij->n", transforms[:, :3, :3], T[:3, :3])
    turns = np.degrees(np.arccos(np.clip((trace - 1) / 2, -1, 1)))
    apart = np.linalg.norm(transforms[:, :2, 3] - T[:2, 3], axis=1)
    deep = np.abs(transforms[:, 2, 3] / T[2, 3] - 1)
    return (turns < RIGHT_TURN) & (apart < RIGHT_PLACE * diameter) & (deep < RIGHT_DEPTH)


def fit_ranking(rows: list[dict[str, np.ndarray]]) -> np.ndarray:
    """Return weights that maximise the share of right matches under a softmax over each image."""
    shown = [(row["features"], row["is_right"]) for row in rows if row["is_right"].any()]
    table = np.concatenate([features for features, _ in shown])
    scale = table.std(axis=0) + 1e-9

    def loss(weights: np.ndarray) -> tuple[float, np.ndarray]:
        total, gradient = 0.0, np.zeros_like(weights)
        for features, is_right in shown:
            scores = features / scale @ weights
            shares = np.exp(scores - scores.max())
            shares /= shares.sum()
            right = shares * is_right
            total -= np.log(right.sum() + 1e-12)
            gradient -= (features / scale).T @ (right / (right.sum() + 1e-12) - shares)
        penalty = RIDGE * weights
        return total / len(shown) + 0.5 * penalty @ weights, gradient / len(shown) + penalty

    end = minimize(loss, np.zeros(table.shape[1]), jac=True, method="L-BFGS-B")
    return np.asarray(end.x / scale)


def fit_bias(rows: list[dict[str, np.ndarray]], weights: np.ndarray) -> float:
    """Return the bias with which an image's best score is the log odds of a correct match."""
    best = [(row["features"] @ weights).argmax() for row in rows]
    scores = [float(row["features"][i] @ weights) for row, i in zip(rows, best, strict=True)]
    labels = [bool(row["is_right"][i]) for row, i in zip(rows, best, strict=True)]
    model = LogisticRegression().fit(np.array(scores)[:, None], labels)
    return float(model.intercept_[0] / model.coef_[0, 0])


def main() -> None:
    """Write samples, or fit the models."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("samples", type=Path, nargs="+")
    parser.add_argument("--parts", type=int, default=40)
    parser.add_argument("--scenes", type=int, default=8)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--fit", action="store_true")
    options = parser.parse_args()
    if not options.fit:
        rows: list[dict[str, np.ndarray]] = []
        for number in range(options.parts):
            rows += samples(number, options.scenes, options.seed)
            right = [row["is_right"].any() for row in rows]
            print(number, len(rows), f"{np.mean(right):.2f} with a right match", flush=True)
            with options.samples[0].open("wb") as file:
                pickle.dump(rows, file)
        return
    rows = [row for path in options.samples for row in pickle.loads(path.read_bytes())]
    held = [row for row in rows if row["part"] % HELD_OUT == 0]
    learned = [row for row in rows if row["part"] % HELD_OUT]
    report(fit_ranking(learned), fit_slope(learned), held)
    weights = fit_ranking(rows)
    names = [path.name for path in options.samples]
    values = {
        "command": f"python benchmarks/learn_ranking.py {' '.join(names)} --fit",
        "weights": dict(zip(ranking.FEATURES, np.round(weights, 5).tolist(), strict=True)),
        "bias": round(fit_bias(rows, weights), 3),
        "score": {"refined_verification": round(fit_slope(rows)[1], 4)},
    }
    path = Path(ranking.__file__).with_name("ranking.json")
    path.write_text(json.dumps(values, indent=1) + "\n", "utf-8")
    print(f"written: {path}")


def fit_slope(rows: list[dict[str, np.ndarray]]) -> tuple[float, float]:
    """Return offset and slope from the verification's log odds to those of a correct best pose."""
    odds = np.concatenate([row["odds"] for row in rows])
    labels = np.concatenate([row["is_end_right"] for row in rows])
    model = LogisticRegression().fit(odds[:, None], labels)
    return float(model.intercept_[0]), float(model.coef_[0, 0])


def report(
    weights: np.ndarray, line: tuple[float, float], rows: list[dict[str, np.ndarray]]
) -> None:
    """Print the quality on held-out parts."""
    shown = [row for row in rows if row["is_right"].any()]
    ranks = np.array(
        [row["is_right"][np.argsort(-row["features"] @ weights)].argmax() for row in shown]
    )
    print(f"{len(rows)} images; a right match in {len(shown)}, at rank", end="")
    for limit in (1, 10, 60, 300):
        print(f" < {limit}: {np.mean(ranks < limit):.1%}", end="")
    odds = np.concatenate([row["odds"] for row in rows])
    labels = np.concatenate([row["is_end_right"] for row in rows])
    stated = 1 / (1 + np.exp(-line[0] - line[1] * odds))
    print(f"\nrefined poses: Brier {brier_score_loss(labels, stated):.4f}")
    for least in (0.3, 0.5, 0.7, 0.9, 0.95):
        reported = stated >= least
        precision = labels[reported].mean() if reported.any() else 1.0
        print(f"  score {least}: precision {precision:.1%}, {reported.sum()} of {labels.sum()}")


if __name__ == "__main__":
    main()
