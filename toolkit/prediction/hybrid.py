"""Combine matching with prediction: match alone, near the predicted pose, and with depth, and keep the best pose."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from toolkit.pose.base import Localizer, Prior, Query, QueryInput, References
from toolkit.pose.pnp import PnpLocalizer, PnpMatches
from toolkit.pose.result import QueryResult, Status, agree
from toolkit.prediction.feed_forward import FeedForwardLocalizer, QueryPrediction
from toolkit.prediction.lifting import DepthLifter
from toolkit.threads import fixed_sums

TIE = 0.8  # share of the lifted pose's matches above which the pose from matching alone is kept


class HybridLocalizer(Localizer):
    """Adds a predicted pose to the hypotheses of a `PnpLocalizer`, and depth where its map points do not suffice."""

    def __init__(self, pnp: PnpLocalizer, feed_forward: FeedForwardLocalizer):
        self.pnp = pnp
        self.feed_forward = feed_forward
        self.lifter = DepthLifter(pnp, feed_forward.seen_depth)
        self.image_names, self.batch_size = pnp.image_names, feed_forward.batch_size
        self._index_of = {name: index for index, name in enumerate(self.image_names)}

    def predict(self, queries: Sequence[QueryInput]) -> list[QueryPrediction]:
        """Return the prediction of the network for each query; see `Localizer`."""
        return self.feed_forward.predict(queries)

    def match(self, query: Query, references: Sequence[References]) -> PnpMatches:
        """Return the matches of a query with its references; see `Localizer`."""
        return self.pnp.match(query, references)

    @fixed_sums
    def solve(
        self, matches: PnpMatches, prediction: QueryPrediction | None = None, priors: Sequence[Prior] = ()
    ) -> QueryResult:
        """Return one pose for the cameras of a rig, or for a single camera. `found_by` names its source:

        - `pnp`: matching alone; the prediction changed nothing.
        - `pnp+feed_forward`: matches guided by the predicted pose, with its consistent references, support a pose
          better than matches found without it.
        - `lifted`, `lifted+feed_forward`: neither is `ok`, and map features lifted by the depth maps of the capture, or
          also by predicted depth, support a pose better.
        - `feed_forward`: the predicted pose itself; matching finds no pose, or an uncertain one that a certain
          prediction contradicts.
        """
        query, references = matches.query, matches.references
        answer = self.feed_forward.answer(query, references, prediction)
        predicted = answer.estimate
        prior = self._prior(predicted)
        priors = (*priors, *(() if prior is None else (prior,)))
        estimate = self.pnp.solve(matches, None, priors)
        if estimate.status is not Status.OK and not estimate.misfit:
            lifted = self.lifter.localize(query, references, answer, priors)
            estimate = estimate if lifted is None else _better(estimate, lifted)
        if predicted.world_from_rig is None:
            return estimate
        no_pose = estimate.world_from_rig is None
        disagree = not agree(estimate.world_from_rig, predicted.world_from_rig)
        if no_pose or (disagree and estimate.status is not Status.OK and predicted.status is Status.OK):
            why = estimate.status_text if no_pose else "matching gives an uncertain pose elsewhere"
            return replace(predicted, remark="; ".join(filter(None, (predicted.remark, why))))
        remark = "; ".join(filter(None, (predicted.remark, estimate.remark)))
        return replace(estimate, scale_std=predicted.scale_std, rejected=predicted.rejected, remark=remark)

    def _prior(self, predicted: QueryResult) -> Prior | None:
        """Return the predicted pose as a prior for matching; None if its position is unknown."""
        if predicted.world_from_rig is None or not np.isfinite(predicted.position_std):
            return None
        images = np.array([self._index_of[name] for name in predicted.references], np.int64)
        stds = predicted.rotation_std_deg, predicted.position_std
        return Prior.about(predicted.world_from_rig, images, *stds, "feed_forward")


def _better(matched: QueryResult, lifted: QueryResult) -> QueryResult:
    """Return the pose with the better status; at equal status the lifted one only if it has clearly more matches."""
    rank_matched, rank_lifted = matched.status.rank, lifted.status.rank
    clearly_more = matched.num_guided <= TIE * lifted.num_guided
    return lifted if rank_lifted > rank_matched or (rank_lifted == rank_matched > 0 and clearly_more) else matched
