"""DOPE++: from the CAD file of a weakly textured part to a trained and evaluated 6D pose estimator.

``import dopepp`` is light: :class:`PoseEstimator` (and torch with it) loads on first use.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from dopepp.inference.estimator import PoseEstimator

__version__ = "0.1.0"
__all__ = ["PoseEstimator", "__version__"]


def __getattr__(name: str) -> object:
    """Import :class:`PoseEstimator` on first use (PEP 562)."""
    if name == "PoseEstimator":
        from dopepp.inference.estimator import PoseEstimator

        return PoseEstimator
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
