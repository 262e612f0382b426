"""Fixtures that several rooms share."""

from tests.predicted_run import finished, run, world

__all__ = ["finished", "run", "world"]
