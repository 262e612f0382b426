"""The networks. Each loads the official checkpoint, key for key, and computes the official numbers."""
