"""The DOPE representation: belief maps and vector fields, drawn and read."""

from dopepp.maps.codec import MapGeometry, Peaks, encode, find_peaks

__all__ = ["MapGeometry", "Peaks", "encode", "find_peaks"]
