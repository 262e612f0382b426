"""Open a predictor by name."""

import logging
from pathlib import Path

from toolkit.capture import Capture
from toolkit.manifest import LocalizeSettings
from toolkit.prediction.architectures import ARCHITECTURES
from toolkit.prediction.interface import Predictor
from toolkit.prediction.network import NetworkPredictor
from toolkit.prediction.simulated import SimulatedPredictor

log = logging.getLogger(__name__)


def open_predictor(settings: LocalizeSettings, capture: Capture, map_dir: Path) -> Predictor:
    """Return the predictor of the settings. Warn about the simulated one, which uses the ground truth.

    Raises:
        ManifestError: the device or the precision does not exist.
        WeightsError: the weights are missing; the message says how to get them.
    """
    predictor = settings.predictor
    if predictor.name != "simulated":
        return NetworkPredictor(
            predictor.checkpoint,
            settings.compute_device,
            settings.dtype_compute,
            architecture=ARCHITECTURES[predictor.name],
            compile=predictor.compile,
        )
    log.warning("predictor: simulated looks up the true poses of the queries. Its poses are no results.")
    sessions = [*capture.usable("map"), *capture.usable("query")]
    return SimulatedPredictor(sessions, map_dir, settings.features.kinds[0], seed=settings.seed)
