"""The one way from maps to poses: peaks, association, PnP."""

from dopepp.recovery.detection import Detection
from dopepp.recovery.recover import RecoveryOptions, explain, recover, recover_batch

__all__ = ["Detection", "RecoveryOptions", "explain", "recover", "recover_batch"]
