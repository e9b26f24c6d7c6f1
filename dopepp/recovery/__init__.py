"""Recovery of object poses from belief maps and vector fields: peaks, association, PnP."""

from dopepp.recovery.detection import Detection, RecoveryOptions
from dopepp.recovery.reasons import Reason
from dopepp.recovery.recover import explain, recover, recover_batch

__all__ = ["Detection", "Reason", "RecoveryOptions", "explain", "recover", "recover_batch"]
