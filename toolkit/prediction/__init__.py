"""Poses by feed-forward networks: inputs, predictors, alignment to the map, lifting of predicted points."""
