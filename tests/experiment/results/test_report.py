import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dopepp.data.sample import Instance, Sample
from dopepp.experiment.results.folder import read_json, write_json
from dopepp.experiment.results.report import Cost, Fingerprint, Report
from dopepp.metrics.row import PoseRow
from dopepp.parts.catalogue import pivconnector, servoholder


def make_report(share: float | None = 0.5) -> Report:
    def rows(method: str, share: float | None) -> dict[str, PoseRow]:
        return {
            label: PoseRow(label, method, 4, share, 1.0, 1.0, share, 1.0, 0.9, 12.0, 0.003)
            for label in ("part0", "part1", "mean")
        }

    errors = {label: np.array([0.001, 0.02, np.inf, 0.3]) for label in ("part0", "part1")}
    references = {"best constant pose": rows("best constant pose", 0.2)}
    return Report("dopepp", rows("dopepp", share), references, errors, Cost(1, 1.5, 7.25), 4)


@given(
    errors=st.lists(st.floats(0, 10) | st.just(np.inf), max_size=5),
    share=st.none() | st.floats(0, 1),
    ms=st.none() | st.floats(0, 1e6),
)
def test_a_report_survives_json(errors, share, ms):
    report = make_report(share)
    report.errors["part0"] = np.array(errors, np.float64)
    report.rotation_deg = {"part0": np.array(errors, np.float64) * 10}
    report.diameters, report.test_set = {"part0": 0.1}, "abc"
    report.cost = Cost(1, 2.0, ms)
    report.details = {"checkpoint": "best.ckpt", "without_part": {"threshold": 0.5}}
    report.refined = make_report(share)
    text = json.dumps(report.to_record(), allow_nan=False)
    back = Report.from_record(json.loads(text))
    np.testing.assert_array_equal(back.errors["part0"], report.errors["part0"])
    np.testing.assert_array_equal(back.rotation_deg["part0"], report.rotation_deg["part0"])
    assert (back.diameters, back.test_set) == ({"part0": 0.1}, "abc")
    assert (back.rows, back.references) == (report.rows, report.references)
    assert (back.name, back.cost, back.num_images) == ("dopepp", report.cost, 4)
    assert back.details == report.details
    assert back.refined is not None
    assert back.refined.to_record() == report.refined.to_record()


def test_json_with_nan_is_not_written(tmp_path):
    path = tmp_path / "x.json"
    write_json(path, {"a": 1})
    with pytest.raises(ValueError, match="JSON"):
        write_json(path, {"a": float("nan")})
    assert read_json(path) == {"a": 1}


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


@pytest.mark.parametrize("change", [
    *({"instances": [replace(INSTANCE, **fields)]} for fields in (
        {"T_cam_obj": INSTANCE.T_cam_obj + 1e-4}, {"label": "servoholder"},
        {"visible_fraction": 0.05}, {"masked_fraction": 0.4},
    )),
    {"instances": []}, {"key": "0/2"}, {"source": "photoreal"},
    {"K": np.diag([606.0, 606.0, 1.0])}, {"image": np.zeros((6, 4, 3), np.uint8)},
])  # fmt: skip
def test_changed_images_have_other_fingerprints(change):
    assert hash_of(sample()) != hash_of(replace(sample(), **change))


def test_fingerprints_depend_on_number_order_and_objects():
    a, b = sample("a"), sample("b")
    assert len({hash_of(a), hash_of(a, b), hash_of(b, a), hash_of(a, b, b)}) == 4
    fingerprint = Fingerprint([pivconnector(), servoholder()])
    fingerprint.add(a)
    assert fingerprint.hexdigest() != hash_of(a)
