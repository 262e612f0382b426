"""What several tests share: a small rendered capture, and real captures where they are present."""

import os
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def small_capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rendered capture of one room, all three devices; do not write to it."""
    from toolkit.synthetic import render_capture

    return render_capture(
        tmp_path_factory.mktemp("data") / "SMALL", rooms=1, frames=6, seed=0, progress=False
    )


@pytest.fixture(scope="session")
def captures_root() -> Path:
    """Folder of the real captures (STRECHA, ...): $CAPTURES, or beside the clone; skips where absent."""
    root = Path(os.environ.get("CAPTURES", REPOSITORY.parent / "shared" / "data" / "captures"))
    if not root.is_dir():
        pytest.skip(f"needs the real captures: no folder {root}; set CAPTURES")
    return root
