"""The fingerprint of a test set depends on the evaluated ground truth only."""

from dataclasses import replace

import numpy as np
import pytest

from dopepp.data.sample import Instance, Sample
from dopepp.experiment.results.report import Fingerprint
from dopepp.parts.catalogue import pivconnector, servoholder


def sample(key: str = "0/1") -> Sample:
    T = np.eye(4)
    T[:3, 3] = 0.01, -0.02, 0.4
    item = Instance("pivconnector", T, np.zeros((9, 2)), 0.8)
    return Sample(
        np.zeros((4, 6, 3), np.uint8), np.diag([600.0, 600.0, 1.0]), [item], None, "s", key
    )


def hash_of(*samples: Sample) -> str:
    fingerprint = Fingerprint([pivconnector()])
    for sample in samples:
        fingerprint.add(sample)
    return fingerprint.hexdigest()


def test_equal_images_have_equal_fingerprints():
    again = sample()
    again.image += 1  # pixels may differ in a bit from machine to machine
    again.instances[0].T_cam_obj = again.instances[0].T_cam_obj + 1e-10
    again.instances[0].T_cam_obj[0, 1] = -0.0
    again.instances[0].visible_fraction = 0.81
    assert hash_of(sample()) == hash_of(again)


INSTANCE = sample().instances[0]


@pytest.mark.parametrize(
    "change",
    [
        *({"instances": [replace(INSTANCE, **fields)]} for fields in (
            {"T_cam_obj": INSTANCE.T_cam_obj + 1e-4}, {"label": "servoholder"},
            {"visible_fraction": 0.05}, {"masked_fraction": 0.4},
        )),
        {"instances": []},
        {"key": "0/2"},
        {"source": "photoreal"},
        {"K": np.diag([606.0, 606.0, 1.0])},
        {"image": np.zeros((6, 4, 3), np.uint8)},
    ],
)  # fmt: skip
def test_changed_images_have_other_fingerprints(change):
    assert hash_of(sample()) != hash_of(replace(sample(), **change))


def test_fingerprints_depend_on_number_order_and_objects():
    a, b = sample("a"), sample("b")
    assert len({hash_of(a), hash_of(a, b), hash_of(b, a), hash_of(a, b, b)}) == 4
    fingerprint = Fingerprint([pivconnector(), servoholder()])
    fingerprint.add(a)
    assert fingerprint.hexdigest() != hash_of(a)
