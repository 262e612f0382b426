"""Tell where a photograph was taken: metric 6-DoF poses of queries in a map of posed photographs."""

import os

# HDF5's own locks fail on file systems without locks. The toolkit writes whole files and moves them into place.
os.environ.setdefault("HDF5_USE_FILE_LOCKING", "FALSE")

__version__ = "0.1.0"
