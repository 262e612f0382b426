"""What a run keeps on disk: items that grow one by one, and HDF5 files for other tools."""
