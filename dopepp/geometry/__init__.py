"""Pure maths on numpy: camera, rotations, the cuboid and perspective-n-point."""
