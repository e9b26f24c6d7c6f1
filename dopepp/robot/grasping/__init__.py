"""Simulated grasps by estimated poses, counted as in the paper (4.3, Table 9)."""

import dopepp.virtual.physics  # noqa: F401 (selects MuJoCo's OpenGL backend before its import)
