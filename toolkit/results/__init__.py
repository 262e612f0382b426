"""Results of the localize stage: the one reader, errors, recall."""
