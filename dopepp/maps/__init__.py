"""The DOPE representation: belief maps and vector fields, drawn and read."""

from dopepp.maps.encode import MapGeometry, encode
from dopepp.maps.peaks import Peaks, find_peaks

__all__ = ["MapGeometry", "Peaks", "encode", "find_peaks"]
