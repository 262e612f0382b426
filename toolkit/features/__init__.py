"""Local features: extractors, matchers, and the files that keep what they found."""
