"""The predictors by name."""

import logging
from pathlib import Path

from toolkit.capture import Capture
from toolkit.localizers.architectures import ARCHITECTURES
from toolkit.localizers.network import NetworkPredictor
from toolkit.localizers.prediction import Predictor
from toolkit.localizers.simulated import SimulatedPredictor
from toolkit.manifest import LocalizeSettings

log = logging.getLogger(__name__)


def open_predictor(settings: LocalizeSettings, capture: Capture, map_dir: Path) -> Predictor:
    """Return what predicts cameras; warn of one that looks up the answers.

    Raises:
        ManifestError: no such device or precision.
        WeightsError: no weights; says what to do.
    """
    asked = settings.predictor
    if asked.name != "simulated":
        return NetworkPredictor(
            asked.checkpoint,
            settings.compute_device,
            settings.dtype_compute,
            architecture=ARCHITECTURES[asked.name],
            compile=asked.compile,
            conditioned=asked.conditioned,
        )
    log.warning("predictor: simulated looks up the true poses of the queries. What comes out is no result.")
    sessions = [*capture.usable("map"), *capture.usable("query")]
    return SimulatedPredictor(sessions, map_dir, settings.features.kinds[0], seed=settings.seed)
