"""The one way from maps to poses: peaks, association, PnP."""

from dopepp.recovery.detection import Detection
from dopepp.recovery.recover import RecoveryOptions, recover, recover_batch

__all__ = ["Detection", "RecoveryOptions", "recover", "recover_batch"]
