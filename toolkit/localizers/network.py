"""VGGT as a predictor: the adapter between `toolkit.models.vggt` and the localizers."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from toolkit.compute import PRECISIONS, check_device_name
from toolkit.errors import ManifestError
from toolkit.files import files_fingerprint
from toolkit.localizers.prediction import Prediction, View
from toolkit.models.weights import VGGT, resolve_any


class NetworkPredictor:
    """Runs VGGT. The weights are looked for at once, and loaded when the first prediction is asked for."""

    name = "vggt"
    simulated = False

    def __init__(
        self, checkpoint: str | Path | None = None, compute_device: str = "auto", dtype_compute: str = "auto"
    ) -> None:
        """
        Args:
            checkpoint: file with the weights; None: the hub's cache, else a download.
            compute_device, dtype_compute: as `toolkit.compute` takes them.

        Raises:
            ManifestError: no such device or precision.
            WeightsError: no weights.
        """
        check_device_name(compute_device)
        if dtype_compute not in PRECISIONS:
            raise ManifestError(f"dtype_compute is {dtype_compute!r}; expected one of {', '.join(PRECISIONS)}.")
        self.checkpoint = resolve_any(VGGT, checkpoint)
        self.compute_device, self.dtype_compute = compute_device, dtype_compute

    @property
    def settings(self) -> dict[str, Any]:
        """What the predictions depend on besides the views. A device changes rounding only, a type more."""
        return {"weights": files_fingerprint([self.checkpoint]), "dtype_compute": self.dtype_compute}

    def predict(self, groups: Sequence[Sequence[View]]) -> list[Prediction]:
        """Return a prediction for each group of views."""
        raise NotImplementedError("the network is not part of this version; set `localize.method: pnp`")
