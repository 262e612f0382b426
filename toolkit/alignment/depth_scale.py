"""Scale from depth ratios: metric depth of map points over the depth that a network predicts for them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from toolkit.alignment.robust import AlignmentError, Bools, noise_variance
from toolkit.geometry import Floats, Ints

DepthSamples = ArrayLike | Sequence[ArrayLike]

OUTLIER_SHARE = 0.2  # expected share of wrong samples
DEPTH_NOISE = 0.1  # expected relative noise of one depth ratio


@dataclass(frozen=True)
class ScaleEstimate:
    """A scale and its relative standard deviation."""

    value: float
    std: float
    conflict: bool = False


def combined_scale(
    along: float, square_c: float, noise_in_model: float, depth: ScaleEstimate | None
) -> ScaleEstimate | None:
    """Combine the scale from baselines with that from depth ratios; return None if there is neither.

    1 / scale is linear in the noisy centers of the model, so the two values of 1 / scale are averaged by inverse
    variance. If they differ by more than three standard deviations, the variance is widened (Birge 1932).

    Args:
        along: sum of the products of baselines in the map and in the model.
        square_c: sum of squared baselines in the map.
        noise_in_model: noise of a predicted center per axis, in units of the model.
        depth: scale from depth ratios, if any.
    """
    values, variances = np.zeros(0), np.zeros(0)
    if square_c > 0:
        values, variances = np.array([along / square_c]), np.array([noise_in_model**2 / square_c])
    if depth is not None:
        values, variances = np.append(values, 1 / depth.value), np.append(variances, (depth.std / depth.value) ** 2)
    information = 1 / np.maximum(variances, 1e-300)
    value = float(information @ values / information.sum()) if len(values) else 0.0
    if value <= 0:
        return None
    variance, conflict = 1 / information.sum(), False
    if len(values) == 2:
        squared = (values[0] - values[1]) ** 2 / np.maximum(variances, 1e-300).sum()
        conflict = bool(squared > 3.0**2)
        variance *= squared if conflict else 1.0
    return ScaleEstimate(1 / value, float(np.sqrt(variance)) / value, conflict)


@dataclass(frozen=True)
class DepthRatios:
    """Valid depth ratios of map points."""

    log: Floats
    """(R,) logarithms."""
    reference: Ints
    """(R,) the reference that each belongs to, -1 if unknown."""
    notes: list[str]
    """Descriptions of what was left out."""

    @classmethod
    def of(cls, ratios: DepthSamples | None, count: int) -> DepthRatios:
        """Check the `depth_ratios` of `align_to_map` for `count` references. Raise AlignmentError for a wrong shape."""
        reference = np.zeros(0, np.int64)
        if ratios is None:
            return cls(np.zeros(0), reference, [])
        if isinstance(ratios, list | tuple) and any(np.ndim(part) > 0 for part in ratios):
            if len(ratios) != count:
                raise AlignmentError(
                    f"depth_ratios has {len(ratios)} arrays: expected one array, or {count}, one per reference."
                )
            parts = [np.asarray(part, np.float64).ravel() for part in ratios]
            values, reference = np.concatenate(parts), np.repeat(np.arange(count), [len(part) for part in parts])
        else:
            values = np.asarray(ratios, np.float64)
            if values.ndim != 1:
                raise AlignmentError(
                    f"depth_ratios has shape {values.shape}: expected (R,), or a list of {count} arrays."
                )
            reference = np.full(len(values), -1)
        with np.errstate(invalid="ignore"):
            kept = np.isfinite(values) & (values > 0)
        left_out = f"{(~kept).sum()} of {len(kept)} depth ratios left out: not finite and positive"
        return cls(np.log(values[kept]), reference[kept], [] if kept.all() else [left_out])

    @property
    def grouped(self) -> bool:
        """Whether the reference of each ratio is known."""
        return len(self.reference) > 0 and bool(self.reference[0] >= 0)

    def estimate(self, consistent: Bools | None) -> ScaleEstimate | None:
        """Return the scale from the samples of some references, (M,) bool, or of all; None without samples.

        Expectation maximization fits a mixture of noise around one value and uniformly distributed wrong samples. It
        starts from the middle of the shortest interval that contains half of the samples (Rousseeuw 1984). The error
        that the samples of one reference share is estimated by moments (DerSimonian and Laird 1986).
        """
        kept = consistent[self.reference] if self.grouped and consistent is not None else np.ones(len(self.log), bool)
        log, reference = self.log[kept], self.reference[kept]
        if not len(log):
            return None
        ordered = np.sort(log)
        half = (len(log) + 1) // 2 + (len(log) > 2)
        widths = ordered[half - 1 :] - ordered[: len(log) - half + 1]
        start = int(np.argmin(widths))
        center = (ordered[start] + ordered[start + half - 1]) / 2
        noise, wrong = max(widths[start], 1e-3), OUTLIER_SHARE
        room = np.log(max(ordered[-1] - ordered[0], 1.0) + 1.0)
        for _ in range(15):
            right = np.log1p(-wrong) - np.log(noise * np.sqrt(2 * np.pi)) - ((log - center) / noise) ** 2 / 2
            share = 1 / (1 + np.exp(np.clip(np.log(wrong) - room - right, -700, 700)))
            center = float(share @ log / share.sum())
            squares, free = share @ (log - center) ** 2, max(share.sum() - 1, 0.0)
            noise = float(np.sqrt(noise_variance(squares, free, DEPTH_NOISE)))
            before, wrong = wrong, float(np.clip(1 - share.mean(), 0.01, 0.6))
            if abs(wrong - before) < 1e-4:
                break
        variance = noise**2 / share.sum()
        if self.grouped:
            center, variance = _between(log, share, reference, noise, center, variance)
        return ScaleEstimate(float(np.exp(center)), float(np.sqrt(variance)))


def _between(
    log: Floats, share: Floats, reference: Ints, noise: float, center: float, variance: float
) -> tuple[float, float]:
    """Return the mean over the references' means, and its variance, which includes that between references."""
    _, index = np.unique(reference, return_inverse=True)
    total = np.bincount(index, share)
    held = total > 0.5  # excludes references whose samples are all wrong
    if held.sum() < 2:
        return center, variance
    means = np.bincount(index, share * log)[held] / total[held]
    information = total[held] / noise**2
    excess = information @ (means - information @ means / information.sum()) ** 2 - (len(means) - 1)
    between = max(excess / (information.sum() - (information**2).sum() / information.sum()), 0.0)
    information = 1 / (1 / information + between)
    return float(information @ means / information.sum()), float(1 / information.sum())
