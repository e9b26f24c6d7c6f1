"""Pose errors and the rates made of them: pure, batched, float64 inside.

Poses come as ``(R_est, t_est, R_gt, t_gt)`` with shapes (N, 3, 3), (N, 3), (N, 3, 3), (N, 3), in
metres and ``T_cam_obj`` convention; object points as (V, 3). Every error is (N,). A pose that is
not finite has an infinite error: it is a miss, and no function here returns NaN.

To add an error, write one function of this form, its formula in ``docs/metrics.md`` and a test
against an independent implementation.
"""

from dopepp.metrics.functional.distances import (
    BOP_THRESHOLDS,
    VSD_DELTA,
    add,
    add_s,
    mahalanobis,
    mspd,
    mssd,
    reprojection_error,
    rotation_error_deg,
    translation_error,
    vsd,
)
from dopepp.metrics.functional.rates import (
    BOP_MSPD_THRESHOLDS,
    MATCH_DISTANCE,
    auc,
    average_precision,
    average_recall,
    expected_calibration_error,
    match,
    pass_rate,
    wilson_interval,
)

__all__ = [
    "BOP_MSPD_THRESHOLDS",
    "BOP_THRESHOLDS",
    "MATCH_DISTANCE",
    "VSD_DELTA",
    "add",
    "add_s",
    "auc",
    "average_precision",
    "average_recall",
    "expected_calibration_error",
    "mahalanobis",
    "match",
    "mspd",
    "mssd",
    "pass_rate",
    "reprojection_error",
    "rotation_error_deg",
    "translation_error",
    "vsd",
    "wilson_interval",
]
