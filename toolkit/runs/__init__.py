"""Runs: their record, their folder, their kernels, and the pairs of devices that they leave out."""
