"""Localize by matching a query's features to triangulated map points, and PnP for single cameras and rigs.

Several kinds of features can be used together: their matches are pooled, and a pose is sought that explains them all.

In two steps. First, descriptors alone: the query against its retrieved references, then LO-RANSAC. Then, with that
pose, the points of all covisible map images are projected into the query and matched only near where they should be,
which finds several times as many and makes the pose more precise.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from toolkit import geometry
from toolkit.geometry import Floats, Ints
from toolkit.localizers.base import CAMERA, NetworkMatches, PoseEstimate, Prior, Query, QueryInput, References, agree
from toolkit.localizers.confidence import EVIDENCE, probability_right
from toolkit.localizers.correspondences import Correspondences, Rival
from toolkit.localizers.matches import KnownMatches, MapMatcher, MappedFeatures, Vicinity
from toolkit.localizers.misfit import find_misfit
from toolkit.localizers.rig import Matches, RigQuery, least_squares_covariance
from toolkit.manifest import PnpSettings

FIRST_REFERENCES = {2: 200, 4: 100}
"""How many references of an image are matched first, and the independent inliers with which the pose that these give is
the one to start from. With fewer inliers, the next number of references is tried, and at last all."""
VIEWS = 4
"""References of an estimate whose keypoints are kept with its correspondences, those that see the most of them."""


@dataclass(frozen=True)
class _Hypothesis:
    """A pose and the guided matches that it rests on."""

    rig_from_world: Floats
    matches: Matches

    @property
    def world_from_rig(self) -> Floats:
        return geometry.invert(self.rig_from_world)


class PnpLocalizer:
    """Localizes queries in one map by matching, with one or several kinds of its features together.

    Safe to use from several threads; the map is never changed.
    """

    batch_size = 1

    def __init__(self, mapped: Sequence[MappedFeatures], settings: PnpSettings | None = None, seed: int = 0):
        self.settings = settings or PnpSettings()
        self.seed = seed
        self.matcher = MapMatcher(mapped, self.settings)
        self.map = self.matcher.map

    @property
    def image_names(self) -> list[str]:
        return self.map.image_names

    def predict(self, queries: Sequence[QueryInput], following: Sequence[QueryInput] = ()) -> list[None]:
        """Return nothing for each query: no network is asked."""
        return [None] * len(queries)

    def localize(
        self, query: Query, references: Sequence[References], prediction: None = None, priors: Sequence[Prior] = ()
    ) -> PoseEstimate:
        """Return one pose for the cameras of a rig, or for a single camera; see `Localizer`.

        Images without features are left out. Priors are hypotheses too: one wins if clearly more guided matches support
        it; one that confirms an `ok` pose changes nothing.
        """
        usable = [index for index, features in enumerate(query.features) if not isinstance(features, str)]
        if len(usable) < len(query.features):
            missing = "; ".join(features for features in query.features if isinstance(features, str))
            if not usable:
                return PoseEstimate(f"failed: no readable image ({missing})")
            estimate = self.localize(query.part(usable), [references[index] for index in usable], None, priors)
            used = replace(estimate.correspondences, camera=np.array(usable, np.int64)[estimate.correspondences.camera])
            focals_px = np.full(len(query.features), np.nan)
            focals_px[usable] = estimate.focals_px or np.nan
            reason = "; ".join(filter(None, [estimate.reason, missing]))
            return replace(estimate, correspondences=used, focals_px=tuple(focals_px.tolist()), reason=reason)
        if not any(len(retrieved.images) for retrieved in references):
            return PoseEstimate("failed: no references")
        rig = RigQuery(
            [view.camera for view in query.views],
            np.asarray(query.rig_from_cams, np.float64),
            [features for features in query.features if not isinstance(features, str)],
        )
        matches, best, start = self._first_pose(rig, references, query.network_matches)
        hypotheses = [] if start is None else self._hypotheses(rig, start, best, matches, references)
        if hypotheses:
            estimate = self._estimate(rig, matches, hypotheses, references)
        else:
            status = f"failed: {'no consistent pose' if len(np.unique(matches.point)) >= 4 else 'too few matches'}"
            estimate = PoseEstimate(status, num_matches=len(matches), correspondences=self._rejected(matches))
        for prior in priors:
            estimate = self._compare(rig, matches, hypotheses, estimate, references, prior)
        return self._with_misfit(rig, matches, estimate)

    def _with_misfit(self, query: RigQuery, matches: Matches, estimate: PoseEstimate) -> PoseEstimate:
        """Return the estimate, doubted where matches made without the pose contradict the cameras.

        The pose stays that of the stated intrinsics; its covariance then reaches to where those that fit would put it.
        """
        if estimate.world_from_rig is None:
            return estimate
        misfit = find_misfit(
            query,
            geometry.invert(estimate.world_from_rig),
            matches[self.map.track_lengths(matches.point) > 1],  # the depth of others is not known from the map alone
            self.map.points,
            self.settings.ransac_max_error_deg,
            focal_alone=estimate.rival_support > self.settings.ok_rival_support,
        )
        if misfit is None:
            return estimate
        covariance = estimate.covariance
        return replace(
            estimate,
            status=CAMERA if misfit.doubtful else estimate.status,
            covariance=None if covariance is None else covariance + np.outer(misfit.shift, misfit.shift),
            misfit=True,
            focals_px=misfit.focals_px(query.cameras),
            reason=misfit.reason(query.cameras),
        )

    def _compare(
        self,
        query: RigQuery,
        matches: Matches,
        hypotheses: list[_Hypothesis],
        estimate: PoseEstimate,
        references: Sequence[References],
        prior: Prior,
    ) -> PoseEstimate:
        """Return the estimate that was found without a prior, or the one found with it if it is better supported."""
        if estimate.status == "ok" and agree(estimate.world_from_rig, prior.world_from_rig):
            return estimate  # each confirms the other
        of_prior = geometry.invert(prior.world_from_rig)
        vicinity = self.matcher.vicinity(query, of_prior, self._seeing_the_same(prior.images), prior.radius_deg)
        near = vicinity.guided(of_prior, prior.radius_deg, self.settings.max_guided_matches)
        start = self._ransac(query, near, self.settings.ransac_max_error_deg) if len(near) else None
        if start is None:
            return estimate
        hypothesis = self._improve(query, start, near)
        same = bool(hypotheses) and not _differ(hypotheses[0], hypothesis)
        support = len(hypotheses[0].matches) if hypotheses else 0
        support_of_prior = len(hypothesis.matches)
        clearly_more = support <= self.settings.ok_rival_support * support_of_prior  # a tie is no reason to change
        if (support_of_prior >= support and estimate.status != "ok") if same else clearly_more:
            # Judged by the matches about the prior, which is as independent of the pose as descriptors alone are.
            seen = [References.of(prior.images.tolist())]
            with_prior = self._estimate(query, near, [hypothesis, *hypotheses], seen)
            lost = estimate.world_from_rig is None
            if with_prior.world_from_rig is not None and (not same or lost or with_prior.status == "ok"):
                return replace(with_prior, found_by=f"pnp+{prior.source}")
            return estimate
        if same or estimate.world_from_rig is None:
            return estimate
        rivals = sorted([*hypotheses, hypothesis], key=lambda rival: -len(rival.matches))
        return self._estimate(query, matches, rivals, references)

    def _seeing_the_same(self, images: Ints) -> Ints:
        """Return the map images that see the most of what the given ones see."""
        points = [self.map.observations(int(image))[1] for image in images]
        return self.matcher.covisible(np.unique(np.concatenate([np.zeros(0, np.int64), *points])))

    def _first_pose(
        self,
        query: RigQuery,
        references: Sequence[References],
        network_matches: Sequence[Sequence[NetworkMatches | None]],
    ) -> tuple[Matches, Matches, Floats | None]:
        """Return matches by descriptors, those among which a pose is sought, and the pose that the most agree with.

        The best references have most of the right matches, the further ones mostly wrong ones, which slow RANSAC down.
        So a pose is sought with the best few, and with more if it has few inliers. If most matches of the best are
        inliers, further references are matched only if they show another place, which may be a rival.
        """
        settings, known = self.settings, KnownMatches()
        start: Floats | None = None
        for count, enough in FIRST_REFERENCES.items():
            if all(len(part.images) <= count for part in references):
                break
            best = [part.take(np.arange(len(part.images)) < count) for part in references]
            among = self.matcher.by_descriptors(query, best, network_matches, known)
            start = self._ransac(query, among, settings.ransac_max_error_deg)
            inliers = among[np.zeros(len(among), bool) if start is None else self._inliers(query, start, among)]
            if self._independent(inliers) < enough:
                start = None
            elif len(inliers) > settings.clear_inlier_ratio * len(among):
                same = self.map.images_seeing(np.unique(inliers.point)) >= settings.min_inliers
                references = [
                    part.take((np.arange(len(part.images)) < count) | ~same[part.images]) for part in references
                ]
                break
        matches = self.matcher.by_descriptors(query, references, network_matches, known)
        if start is not None:
            return matches, among, start
        return matches, matches, self._ransac(query, matches, settings.ransac_max_error_deg)

    def _hypotheses(
        self, query: RigQuery, start: Floats, best: Matches, matches: Matches, references: Sequence[References]
    ) -> list[_Hypothesis]:
        """Return refined poses, best supported first; one of them is refined from `start`, RANSAC's pose.

        Repeated structure (a row of like windows) gives several poses that many descriptors agree with, and
        RANSAC may take one of them or something in between. So unless the first is clear, others are sought, with a
        tighter limit, among the matches that the first leaves over and among those of single references, and the
        guided matches decide: only the right pose puts the rest of the map where it is seen.
        """
        settings = self.settings
        hypotheses = [self._improve(query, start, matches)]
        inliers = self._inliers(query, hypotheses[0].rig_from_world, matches)
        share = float(inliers.mean())
        if share > settings.clear_inlier_ratio:
            return hypotheses
        if share < settings.contested_inlier_ratio:
            other = self._ransac(query, best, settings.max_error_deg)
            if other is not None:
                hypotheses.append(self._improve(query, other, matches))
                inliers |= self._inliers(query, hypotheses[1].rig_from_world, matches)
        rest = matches[~inliers]
        # No need to look for less than half of the support.
        other = self._ransac(query, rest, settings.ransac_max_error_deg, least_inliers=int(inliers.sum() / 2))
        if other is not None:
            support = self._inliers(query, other, rest).sum()
            if share < settings.contested_inlier_ratio or support >= inliers.sum() / 2:
                hypotheses.append(self._improve(query, other, matches))
        if share < settings.contested_inlier_ratio:
            self._add_by_reference(query, matches, references, hypotheses)
        return sorted(hypotheses, key=lambda hypothesis: -len(hypothesis.matches))

    def _add_by_reference(
        self, query: RigQuery, matches: Matches, references: Sequence[References], hypotheses: list[_Hypothesis]
    ) -> None:
        """Add the poses that matches with single references agree on, where they are clearly others."""
        every = dict.fromkeys(int(index) for retrieved in references for index in retrieved.images)
        shown = {index: np.isin(matches.point, self.map.observations(index)[1]) for index in every}
        best = sorted(shown, key=lambda index: -int(shown[index].sum()))
        for index in best[: self.settings.contested_references]:
            start = self._ransac(query, matches[shown[index]], self.settings.ransac_max_error_deg, least_inliers=5)
            if start is not None and not any(
                agree(hypothesis.world_from_rig, geometry.invert(start)) for hypothesis in hypotheses
            ):
                hypotheses.append(self._improve(query, start, matches))

    def _independent(self, inliers: Matches) -> int:
        """Return how many of the matches are independent evidence."""
        # A point matched in several ways, or several points on one keypoint, are one piece of it.
        places = inliers.pixels.astype(np.float32).view(np.uint64)[:, 0]  # x and y as one number
        keypoints = sum(len(np.unique(places[inliers.camera == camera])) for camera in np.unique(inliers.camera))
        return min(len(np.unique(inliers.point)), keypoints)

    def _inliers(self, query: RigQuery, rig_from_world: Floats, matches: Matches) -> NDArray[np.bool_]:
        errors = query.errors_deg(rig_from_world, matches, self.map.points)
        return errors < self.settings.ransac_max_error_deg

    def _improve(self, query: RigQuery, rig_from_world: Floats, matches: Matches) -> _Hypothesis:
        """Match again around a pose and refine it, as long as that finds support."""
        settings = self.settings
        best = _Hypothesis(rig_from_world, matches[self._inliers(query, rig_from_world, matches)])
        least = max(4, 0.5 * len(np.unique(best.matches.point)))
        vicinity: Vicinity | None = None
        for radius in settings.guided_radii_deg:
            pose = best.rig_from_world
            if vicinity is None or not vicinity.reaches(pose, radius):
                images = self.matcher.covisible(np.unique(best.matches.point))
                vicinity = self.matcher.vicinity(query, pose, images, radius)
            near = vicinity.guided(pose, radius, settings.max_guided_matches)
            if len(near) < least:
                break
            refined = query.refine(pose, near, self.map.points)
            near = near[query.errors_deg(refined, near, self.map.points) < settings.max_error_deg]
            if len(near) < least:
                break
            best = _Hypothesis(query.refine(refined, near, self.map.points), near)
        return best

    def _estimate(
        self, query: RigQuery, matches: Matches, hypotheses: list[_Hypothesis], references: Sequence[References]
    ) -> PoseEstimate:
        """Judge the best pose by the matches that were made without it, and by its rivals."""
        settings = self.settings
        rig_from_world, guided = hypotheses[0].rig_from_world, hypotheses[0].matches
        inliers = matches[self._inliers(query, rig_from_world, matches)]
        independent = self._independent(inliers)
        if independent < settings.min_inliers:
            return PoseEstimate(
                f"failed: too few inliers ({independent} within {settings.ransac_max_error_deg} deg)",
                num_matches=len(matches),
                num_inliers=independent,
                correspondences=self._rejected(matches),
            )
        errors = query.errors_px(rig_from_world, guided, self.map.points)
        # Guided matches were sought around the pose, so their errors are small wherever it is. The covariance rests on
        # those that descriptors alone found, too.
        found_twice = guided[np.isin(guided.rows(), inliers.rows())]
        others = matches[~np.isin(matches.rows(), guided.rows())]
        others_agree = query.errors_deg(rig_from_world, others, self.map.points) < settings.max_error_deg
        every = Matches.pooled([guided, others])
        agreeing = np.concatenate([np.ones(len(guided), bool), others_agree])
        images = np.unique(np.concatenate([retrieved.images for retrieved in references]))
        seen = self.map.images_seeing(np.unique(every.point[agreeing]))[images]
        shown = [int(images[index]) for index in np.argsort(-seen, kind="stable") if seen[index]]
        estimate = PoseEstimate(
            status="ok",
            world_from_rig=geometry.invert(rig_from_world),
            covariance=self._covariance(query, rig_from_world, found_twice),
            num_matches=len(matches),
            num_inliers=independent,
            num_guided=len(guided),
            rmse_px=float(np.sqrt(np.mean(errors**2))) if len(errors) else float("nan"),
            rival_support=self._rival_support(hypotheses),
            rivals=tuple(self._rivals(hypotheses)),
            coverage=self._coverage(query, inliers),
            agreement=self._agreement(inliers),
            references=tuple(shown),
            correspondences=self._correspondences(every, agreeing, len(guided), shown),
        )
        evidence = {name: getattr(estimate, name) for name in EVIDENCE}
        estimate = replace(estimate, p_correct=float(probability_right(evidence)))
        certain = estimate.p_correct >= settings.ok_probability and estimate.rival_support <= settings.ok_rival_support
        return estimate if certain else replace(estimate, status="low_confidence")

    def _agreement(self, inliers: Matches) -> int:
        """Return the number of points matched by the second best kind of features."""
        counts = np.unique(self.matcher.kind_names(np.unique(inliers.point)), return_counts=True)[1]
        return int(np.sort(counts)[-2]) if len(counts) > 1 else 0

    def _coverage(self, query: RigQuery, inliers: Matches) -> float:
        """Return the share of the cells of a 4 x 4 grid over each query image in which an inlier lies."""
        sizes = np.array([(camera.width, camera.height) for camera in query.cameras])
        cells = np.clip(4 * inliers.pixels / sizes[inliers.camera], 0, 3).astype(np.int64)
        return len(np.unique(np.column_stack([inliers.camera, cells]), axis=0)) / (16 * len(sizes))

    def _correspondences(
        self, matches: Matches, inlier: NDArray[np.bool_], guided: int, references: Sequence[int]
    ) -> Correspondences:
        """Return matches as correspondences, with the places where the first references show their points.

        Args:
            inlier: (K,) whether the pose agrees.
            guided: how many of them, the first, were found near where a pose puts their points.
            references: map images, those that see the most of the inliers first.
        """
        views = [(rank, *self.matcher.keypoints(i, matches.point)) for rank, i in enumerate(references[:VIEWS])]
        found_by = np.repeat(["/guided", "/descriptors"], [guided, len(matches) - guided])
        return Correspondences(
            camera=matches.camera,
            pixels=matches.pixels,
            points=self.map.points[matches.point],
            point_index=matches.point,
            inlier=inlier,
            found_by=np.char.add(self.matcher.kind_names(matches.point), found_by),
            view_of=np.concatenate([np.zeros(0, np.int64), *(at for _, at, _ in views)]),
            view_reference=np.concatenate([np.zeros(0, np.int64), *(np.full(len(at), rank) for rank, at, _ in views)]),
            view_pixels=np.concatenate([np.zeros((0, 2)), *(pixels for _, _, pixels in views)]),
        )

    def _covariance(self, query: RigQuery, rig_from_world: Floats, matches: Matches) -> Floats | None:
        """Return the covariance (6, 6) of a pose that rests on matches; None where it is not defined."""
        of_pose, of_point = query.jacobians(rig_from_world, matches, self.map.points)
        errors = query.errors_px(rig_from_world, matches, self.map.points)
        return least_squares_covariance(of_pose, errors, self._noise_of_points(query, matches, of_point))

    def _noise_of_points(self, query: RigQuery, matches: Matches, of_point: Floats) -> Floats:
        """Return the covariance (K, 2, 2) of projections that comes from their points, square pixels; NaN if unknown.

        `of_point` (K, 2, 3) is how the projections of the K matches move with their points.
        """
        noise = of_point @ self.map.point_covariances(matches.point) @ of_point.transpose(0, 2, 1)
        # A match counts only where its point is seen near where it should be: no more of the point's noise is in it.
        limit_px = np.tan(np.radians(self.settings.max_error_deg)) * query.focals_px[matches.camera]
        share = limit_px**2 / np.maximum(np.trace(noise, axis1=1, axis2=2), 1e-12)
        return np.asarray(noise * np.minimum(share, 1)[:, None, None], np.float64)

    def _rejected(self, matches: Matches) -> Correspondences:
        """Return matches that support no pose."""
        return self._correspondences(matches, np.zeros(len(matches), bool), 0, [])

    def _rival_support(self, hypotheses: list[_Hypothesis]) -> float:
        """Return the support of the best pose that is another one, relative to the best pose's."""
        first, *others = hypotheses
        rivals = (len(other.matches) for other in others if _differ(first, other))
        return next(rivals, 0) / max(len(first.matches), 1)

    def _rivals(self, hypotheses: list[_Hypothesis]) -> list[Rival]:
        """Return poses that are other ones than the best and than each other, best supported first."""
        kept = hypotheses[:1]
        for other in sorted(hypotheses[1:], key=lambda hypothesis: -len(hypothesis.matches)):
            if all(_differ(known, other) for known in kept):
                kept.append(other)
        support = max(len(hypotheses[0].matches), 1)
        return [Rival(other.world_from_rig, len(other.matches) / support) for other in kept[1:]]

    def _ransac(self, query: RigQuery, matches: Matches, max_error_deg: float, least_inliers: int = 0) -> Floats | None:
        return query.ransac(matches, self.map.points, max_error_deg, self.settings, self.seed, least_inliers)


def _differ(hypothesis: _Hypothesis, other: _Hypothesis) -> bool:
    """Tell whether two hypotheses are clearly different poses."""
    rotation_deg, distance_m = geometry.pose_error(hypothesis.world_from_rig, other.world_from_rig)
    return bool(rotation_deg > 1.0 or distance_m > 0.1)
