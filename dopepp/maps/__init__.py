"""The DOPE representation: encoding poses as belief maps and vector fields, and finding peaks."""

from dopepp.maps.codec import MapGeometry, Peaks, encode, find_peaks

__all__ = ["MapGeometry", "Peaks", "encode", "find_peaks"]
