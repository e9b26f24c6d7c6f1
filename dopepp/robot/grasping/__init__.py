"""Grasping in simulation: 200 grasps from pictures, as the paper counts them (4.3, Table 9)."""
