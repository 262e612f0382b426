"""VGGT as a predictor: the adapter between `toolkit.models.vggt` and the localizers."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from toolkit.compute import PRECISIONS, check_device_name
from toolkit.errors import ManifestError
from toolkit.files import files_fingerprint
from toolkit.localizers.prediction import Prediction, View
from toolkit.models.weights import VGGT_1B, VGGT_1B_COMMERCIAL, find_weights, resolve_weights


def require_weights(checkpoint: str | Path | None = None) -> Path:
    """Return the file with the weights: the one given, one in the hub's cache, or else a download.

    Raises:
        WeightsError: there are none to be had; says what to do.
    """
    cached = None if checkpoint is not None else find_weights(VGGT_1B) or find_weights(VGGT_1B_COMMERCIAL)
    return cached or resolve_weights(VGGT_1B, checkpoint)


class NetworkPredictor:
    """Runs VGGT. The weights are looked for at once, and loaded when the first prediction is asked for."""

    name = "vggt"
    simulated = False

    def __init__(
        self, checkpoint: str | Path | None = None, compute_device: str = "auto", dtype_compute: str = "auto"
    ) -> None:
        """
        Args:
            checkpoint: see `require_weights`.
            compute_device, dtype_compute: as `toolkit.compute` takes them.

        Raises:
            ManifestError: no such device or precision.
            WeightsError: no weights.
        """
        check_device_name(compute_device)
        if dtype_compute not in PRECISIONS:
            raise ManifestError(f"dtype_compute is {dtype_compute!r}; expected one of {', '.join(PRECISIONS)}.")
        self.checkpoint = require_weights(checkpoint)
        self.compute_device, self.dtype_compute = compute_device, dtype_compute

    @property
    def settings(self) -> dict[str, Any]:
        """What the predictions depend on besides the views. A device changes rounding only, a type more."""
        return {"weights": files_fingerprint([self.checkpoint]), "dtype_compute": self.dtype_compute}

    def predict(self, groups: Sequence[Sequence[View]]) -> list[Prediction]:
        """Return a prediction for each group of views."""
        raise NotImplementedError("the network is not part of this version; set `localize.method: pnp`")
