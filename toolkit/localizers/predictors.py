"""The predictors by name."""

from collections.abc import Sequence
from pathlib import Path

from toolkit.capture import Session
from toolkit.errors import ManifestError
from toolkit.localizers.architectures import ARCHITECTURES
from toolkit.localizers.network import NetworkPredictor
from toolkit.localizers.prediction import Predictor
from toolkit.localizers.simulated import SimulatedPredictor

PREDICTORS = (*ARCHITECTURES, "simulated")
"""Names that `create_predictor` takes. `simulated` is taken only where it is asked for by name."""


def create_predictor(
    name: str,
    *,
    sessions: Sequence[Session] = (),
    map_dir: str | Path | None = None,
    features: str = "sift",
    checkpoint: str | Path | None = None,
    compute_device: str = "auto",
    dtype_compute: str = "auto",
    compile: bool = False,  # noqa: A002
    conditioned: bool = False,
    seed: int = 0,
) -> Predictor:
    """Return a ready predictor.

    Args:
        name: `vggt`, `vggt-omega`, `da3-base`, `da3-small`, or `simulated`, which looks up true poses and is for tests
            and for trying out.
        sessions: of `simulated`: where the true poses are.
        map_dir, features: of `simulated`: folder of the triangulated maps, for depth, and their kind of features.
        checkpoint: of a network: file with the weights; None: the hub's cache, else a download.
        compute_device, dtype_compute: of a network, as `toolkit.models.compute` takes them.
        compile: of a network, see `PredictorSettings`.
        conditioned: of a network: tell it cameras of the map, see `NetworkPredictor`.
        seed: of `simulated`.

    Raises:
        ManifestError: unknown name, device or precision; a network that cannot be told cameras.
        WeightsError: a network and no weights to be had; says what to do.
    """
    if name not in PREDICTORS:
        raise ManifestError(f"Unknown predictor {name!r}. Known: {', '.join(PREDICTORS)}.")
    if name == "simulated":
        return SimulatedPredictor(sessions, map_dir, features, seed=seed)
    return NetworkPredictor(
        checkpoint,
        compute_device,
        dtype_compute,
        architecture=ARCHITECTURES[name],
        compile=compile,
        conditioned=conditioned,
    )
