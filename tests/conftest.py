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


@pytest.fixture(scope="session")
def golden_root() -> Path:
    """Folder of the official networks' numbers: $GOLDEN, or beside the clone; skips where absent."""
    root = Path(os.environ.get("GOLDEN", REPOSITORY.parent / "shared" / "golden"))
    if not root.is_dir():
        pytest.skip(f"needs the golden files: no folder {root}; set GOLDEN")
    return root


@pytest.fixture
def no_hub(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """No weights on this machine, and no network to get some."""
    from huggingface_hub import constants

    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "hub"))
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
