"""Pose errors and the rates made of them: pure, batched, float64 inside.

Poses come as ``(R_est, t_est, R_gt, t_gt)`` with shapes (N, 3, 3), (N, 3), (N, 3, 3), (N, 3), in
metres and ``T_cam_obj`` convention; object points as (V, 3). Every error is (N,). A pose that is
not finite has an infinite error: it is a miss, and no function here returns NaN.

To add an error, write one function of this form, its formula in ``docs/reference/metrics.md`` and
a test against an independent implementation.
"""

from dopepp.metrics.functional.distances import BOP_MSPD_THRESHOLDS as BOP_MSPD_THRESHOLDS
from dopepp.metrics.functional.distances import BOP_THRESHOLDS as BOP_THRESHOLDS
from dopepp.metrics.functional.distances import VSD_DELTA as VSD_DELTA
from dopepp.metrics.functional.distances import add as add
from dopepp.metrics.functional.distances import add_s as add_s
from dopepp.metrics.functional.distances import mahalanobis as mahalanobis
from dopepp.metrics.functional.distances import mspd as mspd
from dopepp.metrics.functional.distances import mssd as mssd
from dopepp.metrics.functional.distances import reprojection_error as reprojection_error
from dopepp.metrics.functional.distances import rotation_error_deg as rotation_error_deg
from dopepp.metrics.functional.distances import translation_error as translation_error
from dopepp.metrics.functional.distances import vsd as vsd
from dopepp.metrics.functional.rates import MATCH_DISTANCE as MATCH_DISTANCE
from dopepp.metrics.functional.rates import auc as auc
from dopepp.metrics.functional.rates import average_precision as average_precision
from dopepp.metrics.functional.rates import average_recall as average_recall
from dopepp.metrics.functional.rates import expected_calibration_error as expected_calibration_error
from dopepp.metrics.functional.rates import match as match
from dopepp.metrics.functional.rates import pass_rate as pass_rate
from dopepp.metrics.functional.rates import wilson_interval as wilson_interval
