"""A run as a whole: its record, its folder, the pairs of devices that it left out."""
