"""NDDS and FAT: JSON annotations beside images."""
