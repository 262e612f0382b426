"""Localize by matching; a predicted pose and depth each allow another try, and the best supported answer is kept."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pycolmap
from numpy.typing import NDArray

from toolkit.features.features import LocalFeatures
from toolkit.localizers.lifting import DepthLifter
from toolkit.localizers.mapped import Known
from toolkit.localizers.pnp import PnpLocalizer, PoseEstimate, Prior, agree
from toolkit.localizers.vggt import VggtAnswer

Floats = NDArray[np.float64]

SEARCH_DEG = (1.0, 6.0)  # limits of the radius in which features are sought about a predicted pose
TIE = 0.8  # of the other's matches: with more, there is no reason to change
NEARBY_M = 3.0  # depth at which the uncertainty of a place is seen as an angle


class HybridLocalizer:
    """Adds a prediction to the hypotheses of a `PnpLocalizer`, and depth where its points do not suffice."""

    def __init__(self, pnp: PnpLocalizer, lifter: DepthLifter | None = None):
        """
        Args:
            pnp: matches with triangulated points.
            lifter: of the same map; None: features without a point are not used.
        """
        self.pnp = pnp
        self.lifter = lifter

    def localize(
        self,
        cameras: Sequence[pycolmap.Camera],
        rig_from_cams: Floats,
        features: Sequence[LocalFeatures | Sequence[LocalFeatures]],
        references: Sequence[Sequence[int]],
        answer: VggtAnswer,
        known: Sequence[Sequence[Known | None]] = (),
    ) -> PoseEstimate:
        """Return one pose for the cameras of a rig, or for a single camera; `found_by` says from what.

        `pnp`: the prediction has changed nothing. `pnp+vggt`: features sought about the predicted pose, in its
        consistent references, support the answer better than those matched without it. `lifted`, `lifted+vggt`: where
        that is not `ok`, and features placed by a capture's depth maps, or by predicted depth too, support a pose
        better. `vggt`: the predicted pose itself, where matching finds none, or only an uncertain one that a certain
        prediction contradicts.

        Args:
            cameras, rig_from_cams, features, references, known: as for `PnpLocalizer.localize`.
            answer: what `toolkit.localizers.vggt` says of the same rig.
        """
        predicted = answer.estimate
        prior = _prior(predicted)
        priors = () if prior is None else (prior,)
        found = self.pnp.localize(cameras, rig_from_cams, features, references, priors, known)
        if found.status != "ok" and self.lifter is not None:
            lifted = self.lifter.localize(cameras, rig_from_cams, features, references, answer, priors, known)
            found = found if lifted is None else _better(found, lifted)
        if predicted.world_from_rig is None:
            return found
        lost = found.world_from_rig is None
        elsewhere = not agree(found.world_from_rig, predicted.world_from_rig)
        if lost or (elsewhere and found.status != "ok" and predicted.status == "ok"):
            why = found.status if lost else "matching gives an uncertain pose elsewhere"
            return replace(predicted, reason="; ".join(part for part in (predicted.reason, why) if part))
        reason = "; ".join(part for part in (predicted.reason, found.reason) if part)
        return replace(found, scale_std=predicted.scale_std, rejected=predicted.rejected, reason=reason)


def _better(found: PoseEstimate, lifted: PoseEstimate) -> PoseEstimate:
    """Return the pose with the better status, else the lifted one only if clearly more matches support it."""
    rank = {"ok": 2, "low_confidence": 1}
    one, other = rank.get(found.status, 0), rank.get(lifted.status, 0)
    clearly_more = found.num_guided <= TIE * lifted.num_guided
    return lifted if other > one or (other == one > 0 and clearly_more) else found


def _prior(predicted: PoseEstimate) -> Prior | None:
    """Return where to look for features; None where the place is not known."""
    if predicted.world_from_rig is None or not np.isfinite(predicted.position_std_m):
        return None
    spread_deg = predicted.rotation_std_deg + np.degrees(np.arctan(predicted.position_std_m / NEARBY_M))
    radius_deg = float(np.clip(2 * spread_deg, *SEARCH_DEG))
    return Prior(predicted.world_from_rig, np.array(predicted.references, np.int64), radius_deg)

