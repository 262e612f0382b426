"""Recordings with odometry: pose graphs, and frame by frame."""
