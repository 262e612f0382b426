"""The networks. Each loads the official checkpoint key by key, and computes the same numbers as the official code."""
