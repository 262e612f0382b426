"""Localize by matching; a predicted pose and depth each allow another try, and the best supported answer is kept."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from toolkit.localizers.base import PoseEstimate, Prior, Query, QueryInput, References, agree, rank
from toolkit.localizers.feed_forward import FeedForwardLocalizer, Predicted
from toolkit.localizers.lifting import DepthLifter
from toolkit.localizers.pnp import PnpLocalizer

TIE = 0.8  # of the other's matches: with more, there is no reason to change


class HybridLocalizer:
    """Adds a prediction to the hypotheses of a `PnpLocalizer`, and depth where its points do not suffice."""

    def __init__(self, pnp: PnpLocalizer, feed_forward: FeedForwardLocalizer):
        self.pnp = pnp
        self.feed_forward = feed_forward
        self.lifter = DepthLifter(pnp, feed_forward)
        self.image_names, self.batch_size = pnp.image_names, feed_forward.batch_size

    def predict(self, queries: Sequence[QueryInput], following: Sequence[QueryInput] = ()) -> list[Predicted]:
        """Return what the network says of each query; see `Localizer`."""
        return self.feed_forward.predict(queries, following)

    def localize(
        self,
        query: Query,
        references: Sequence[References],
        prediction: Predicted | None = None,
        priors: Sequence[Prior] = (),
    ) -> PoseEstimate:
        """Return one pose for the cameras of a rig, or for a single camera; `found_by` says from what.

        `pnp`: the prediction has changed nothing. `pnp+feed_forward`: features sought around the predicted pose, in its
        consistent references, support the answer better than those matched without it. `lifted`,
        `lifted+feed_forward`: where that is not `ok`, and features placed by a capture's depth maps, or by predicted
        depth too, support a pose better. `feed_forward`: the predicted pose itself, where matching finds none, or only
        an uncertain one that a certain prediction contradicts.
        """
        answer = self.feed_forward.answer(query, references, prediction)
        predicted = answer.estimate
        prior = _prior(predicted)
        priors = (*priors, *(() if prior is None else (prior,)))
        estimate = self.pnp.localize(query, references, None, priors)
        if estimate.status != "ok" and not estimate.misfit:
            lifted = self.lifter.localize(query, references, answer, priors)
            estimate = estimate if lifted is None else _better(estimate, lifted)
        if predicted.world_from_rig is None:
            return estimate
        lost = estimate.world_from_rig is None
        elsewhere = not agree(estimate.world_from_rig, predicted.world_from_rig)
        if lost or (elsewhere and estimate.status != "ok" and predicted.status == "ok"):
            why = estimate.status if lost else "matching gives an uncertain pose elsewhere"
            return replace(predicted, reason="; ".join(part for part in (predicted.reason, why) if part))
        reason = "; ".join(part for part in (predicted.reason, estimate.reason) if part)
        return replace(estimate, scale_std=predicted.scale_std, rejected=predicted.rejected, reason=reason)


def _better(matched: PoseEstimate, lifted: PoseEstimate) -> PoseEstimate:
    """Return the pose with the better status, else the lifted one only if clearly more matches support it."""
    rank_matched, rank_lifted = rank(matched.status), rank(lifted.status)
    clearly_more = matched.num_guided <= TIE * lifted.num_guided
    return lifted if rank_lifted > rank_matched or (rank_lifted == rank_matched > 0 and clearly_more) else matched


def _prior(predicted: PoseEstimate) -> Prior | None:
    """Return where to look for features; None where the place is not known."""
    if predicted.world_from_rig is None or not np.isfinite(predicted.position_std_m):
        return None
    images = np.array(predicted.references, np.int64)
    stds = predicted.rotation_std_deg, predicted.position_std_m
    return Prior.about(predicted.world_from_rig, images, *stds, "feed_forward")
