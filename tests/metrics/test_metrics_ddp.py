"""Two gloo processes compute the same numbers as one process, also if a rank has no images."""

import json
import multiprocessing
from collections import namedtuple
from dataclasses import asdict

import numpy as np
import pytest
import torch.distributed as dist
from scipy.spatial.transform import Rotation

from dopepp.data.sample import Instance
from dopepp.geometry.cuboid import cuboid_keypoints
from dopepp.metrics.pose import PoseMetrics
from dopepp.parts.part import Part

NUM_IMAGES = 13
Detection = namedtuple("Detection", ["object", "score", "T_cam_obj", "covariance"], defaults=[None])


def measured(images):
    """Add images to a metric: every third is missed, and every second has a duplicate."""
    points = np.random.default_rng(0).uniform(-0.05, 0.05, (100, 3)) * [1, 0.6, 0.2]
    cuboid = cuboid_keypoints(points.min(0), points.max(0))
    turning = (((0.0, 0.0, 1.0), (0.0, 0.0, 0.0)),)
    box = Part("box", cuboid, 0.12, points, symmetries_continuous=turning)
    metric = PoseMetrics([box, Part("none", cuboid, 0.12, points)])
    for i in images:
        rng = np.random.default_rng(i)
        T = np.eye(4)
        T[:3, :3] = Rotation.random(random_state=i).as_matrix()
        T[:3, 3] = rng.normal([0, 0, 1], 0.1)
        E = T.copy()
        E[:3, 3] += rng.normal(0, 0.01, 3)
        # Two scores only, so that ties run across the ranks.
        result = Detection("box", 0.5 + 0.1 * (i % 2), E)
        detections = [] if i % 3 == 0 else [result] * (1 + i % 2)
        K = np.array([[500.0 + i, 0, 320], [0, 500, 240], [0, 0, 1]])
        metric.update(detections, [Instance("box", T, np.zeros((9, 2)))], K, 640 + 10 * i)
    references = {name: asdict(rows["box"]) for name, rows in metric.references().items()}
    rows = {name: asdict(row) for name, row in metric.compute().items()}
    return {"rows": rows, "errors": sorted(metric.errors("box").tolist()), "references": references}


SPLITS = {
    "uneven": [range(5), range(5, NUM_IMAGES)],
    "one rank empty": [range(0), range(NUM_IMAGES)],
}


def run_rank(rank, folder):
    dist.init_process_group("gloo", f"file://{folder / 'store'}", rank=rank, world_size=2)
    results = {split: measured(shares[rank]) for split, shares in SPLITS.items()}
    (folder / f"{rank}.json").write_text(json.dumps(results))
    dist.destroy_process_group()


@pytest.mark.ddp
def test_two_processes_compute_the_numbers_of_one_process(tmp_path):
    fork = multiprocessing.get_context("fork")
    ranks = [fork.Process(target=run_rank, args=(rank, tmp_path)) for rank in range(2)]
    for process in ranks:
        process.start()
    expected = json.loads(json.dumps(measured(range(NUM_IMAGES))))
    for process in ranks:
        process.join(120)
        assert process.exitcode == 0
    box = expected["rows"]["box"]
    assert box["num_instances"] == NUM_IMAGES
    assert box["false_per_frame"] == 4 / NUM_IMAGES  # images 1, 5, 7 and 11
    for measure in ("ar_mssd", "ar_mspd", "average_precision", "mssd_01d"):
        assert 0 < box[measure] < 1
    results = [json.loads((tmp_path / f"{rank}.json").read_text()) for rank in range(2)]
    for result in (rank[split] for rank in results for split in SPLITS):
        assert result["errors"] == expected["errors"]
        for part in ("rows", "references"):
            for name, row in expected[part].items():
                for measure, value in row.items():
                    near = pytest.approx(value, rel=1e-12) if isinstance(value, float) else value
                    assert result[part][name][measure] == near, (part, name, measure)
