"""Render captures with exact ground truth, for demos, tests and benchmarks."""

from toolkit.synthetic.capture import render_capture
