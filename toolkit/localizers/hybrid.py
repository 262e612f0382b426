"""Localize by matching, and let a predicted pose guide a second try; the better supported answer is kept."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pycolmap
from numpy.typing import NDArray

from toolkit.features import LocalFeatures
from toolkit.localizers.pnp import PnpLocalizer, PoseEstimate, Prior, agree

Floats = NDArray[np.float64]

SEARCH_DEG = (1.0, 6.0)  # limits of the radius in which features are sought about a predicted pose
NEARBY_M = 3.0  # depth at which the uncertainty of a place is seen as an angle


class HybridLocalizer:
    """Adds a prediction to the hypotheses of a `PnpLocalizer`."""

    def __init__(self, pnp: PnpLocalizer):
        self.pnp = pnp

    def localize(
        self,
        cameras: Sequence[pycolmap.Camera],
        rig_from_cams: Floats,
        features: Sequence[LocalFeatures],
        references: Sequence[Sequence[int]],
        predicted: PoseEstimate,
    ) -> PoseEstimate:
        """Return one pose for the cameras of a rig, or for a single camera; `found_by` says from what.

        `pnp`: the prediction has changed nothing. `pnp+vggt`: features sought about the predicted pose, in its
        consistent references, support the answer better than those matched without it. `vggt`: the predicted pose
        itself, where matching finds none, or only an uncertain one that a certain prediction contradicts.

        Args:
            cameras, rig_from_cams, features, references: as for `PnpLocalizer.localize`.
            predicted: the pose of the same rig from `toolkit.localizers.vggt`.
        """
        prior = _prior(predicted)
        found = self.pnp.localize(cameras, rig_from_cams, features, references, () if prior is None else (prior,))
        if predicted.world_from_rig is None:
            return found
        lost = found.world_from_rig is None
        elsewhere = not agree(found.world_from_rig, predicted.world_from_rig)
        if lost or (elsewhere and found.status != "ok" and predicted.status == "ok"):
            why = found.status if lost else "matching gives an uncertain pose elsewhere"
            return replace(predicted, reason="; ".join(part for part in (predicted.reason, why) if part))
        return replace(found, scale_std=predicted.scale_std, rejected=predicted.rejected, reason=predicted.reason)


def _prior(predicted: PoseEstimate) -> Prior | None:
    """Return where to look for features; None where the place is not known."""
    if predicted.world_from_rig is None or not np.isfinite(predicted.position_std_m):
        return None
    spread_deg = predicted.rotation_std_deg + np.degrees(np.arctan(predicted.position_std_m / NEARBY_M))
    radius_deg = float(np.clip(2 * spread_deg, *SEARCH_DEG))
    return Prior(predicted.world_from_rig, np.array(predicted.references, np.int64), radius_deg)

