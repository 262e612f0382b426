"""The map of a session: pairs, triangulated points, and whether poses and intrinsics agree with the images."""
