"""Import captures and images; export models, pairs, poses and submissions."""
