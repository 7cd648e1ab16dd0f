"""The forward problem: the radiance of a scene with known materials and lights (Sec. 3.1)."""
