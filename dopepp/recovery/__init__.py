"""The one way from maps to poses: peaks, association, PnP."""

from dopepp.recovery.detection import Detection
from dopepp.recovery.recover import Reason, explain, recover, recover_batch
from dopepp.recovery.scoring import RecoveryOptions

__all__ = ["Detection", "Reason", "RecoveryOptions", "explain", "recover", "recover_batch"]
