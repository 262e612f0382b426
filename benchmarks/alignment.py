"""Where the query stands, from a simulated predictor: ours beside the published recipe.

    python benchmarks/alignment.py [--trials 1000] [--seed 0] [--noise-m 0.03] [--noise-deg 1]

The predictor is simulated: true cameras with noise of the stated size on every one, references and query, under a
random similarity of the world. References stand about a point with the stated spread, the root of their mean squared
distance to it; the query stands 3 m from it. Noise is the root mean square of the length of the error: `by axis`
means that much along each of the three axes instead, sqrt(3) times more.

The published recipe, as it is implemented here: of 5 references the 4 whose centers Umeyama's similarity (1991) fits
with the least error; that similarity is applied to the query. It has no rule to refuse a pose.

Prints, for each case, the median error of the query's place, the share of scales reported unknown, the share of
trials in which exactly the wrong references were left out, the share of poses called `ok` and, of these, the share
within (5 deg, 0.5 m); of the recipe the median error, the share of all its poses within these, and the median error
that it reports. `ms` is the median wall time of one `align_to_map`.
"""

import argparse
import time
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from toolkit import geometry
from toolkit.alignment.similarity import align_to_map, is_trustworthy, query_pose

Floats = NDArray[np.float64]
QUERY_M = 3.0


@dataclass(frozen=True)
class Case:
    """What is simulated."""

    name: str
    spread_m: float
    references: int = 8
    wrong: int = 0
    kind: str = "random"
    """Wrong references: `random` orientation, and place 3 m off (root mean square); only their `place`, by 1 to 2 m;
    or only their `orientation`, by 10 to 180 deg."""
    depth_ratios: int = 0
    depth_noise: float = 0.05
    wrong_depth: float = 0.0
    """Share of depth ratios that are wrong, by a factor between 1.5 and 4, all to one side."""


@dataclass(frozen=True)
class Trial:
    """One simulated prediction."""

    model_from_cams: Floats
    world_from_cams: Floats
    model_from_query: Floats
    world_from_query: Floats
    wrong: NDArray[np.bool_]
    depth_ratios: Floats | None
    scale: float


CASES = [
    Case("(a) spread 3 m", 3.0),
    Case("(b) spread 0.1 m, 200 depth ratios of 5 %", 0.1, depth_ratios=200),
    Case("(b') the same, 35 % of the ratios wrong", 0.1, depth_ratios=200, wrong_depth=0.35),
    Case("(c) spread 3 m, 3 of 8 wrong", 3.0, wrong=3),
    Case("(c') only their place, by 1 to 2 m", 3.0, wrong=3, kind="place"),
    Case("(c'') only their orientation, 10 deg or more", 3.0, wrong=3, kind="orientation"),
    Case("(d) spread 0.01 m", 0.01),
    Case("spread 0.03 m", 0.03),
    Case("spread 0.1 m", 0.1),
    Case("spread 0.3 m", 0.3),
    Case("spread 1 m", 1.0),
    Case("spread 1 m, 3 of 8 wrong", 1.0, wrong=3),
    Case("2 references, spread 1 m", 1.0, references=2),
    Case("3 references, 1 wrong, spread 2 m", 2.0, references=3, wrong=1),
    Case("5 references, 2 wrong, spread 1 m", 1.0, references=5, wrong=2),
    Case("20 references, 8 wrong, spread 1 m", 1.0, references=20, wrong=8),
    Case("1 reference, 200 depth ratios", 0.0, references=1, depth_ratios=200),
]


def simulate(case: Case, rng: np.random.Generator, noise_m: float, noise_deg: float) -> Trial:
    """Draw one trial; noise as lengths (root mean square)."""

    def rotations(count: int) -> Floats:
        return np.asarray(Rotation.random(count, rng=rng).as_matrix())

    def small(count: int, size: float) -> Floats:
        return rng.normal(0, size / np.sqrt(3), (count, 3))

    count = case.references
    direction = rng.normal(size=3)
    centers = small(count, case.spread_m)
    query = QUERY_M * direction / np.linalg.norm(direction)
    world = geometry.make_pose(rotations(count + 1), np.vstack([centers, query]) + rng.uniform(-50, 50, 3))
    predicted = world.copy()
    wrong = np.zeros(count, bool)
    wrong[rng.permutation(count)[: case.wrong]] = True
    off = np.flatnonzero(wrong)
    if case.kind == "random":
        predicted[off, :3, :3] = rotations(len(off))
        predicted[off, :3, 3] += small(len(off), 3.0)
    elif case.kind == "place":
        way = rng.normal(size=(len(off), 3))
        way *= rng.uniform(1, 2, (len(off), 1)) / np.linalg.norm(way, axis=1, keepdims=True)
        predicted[off, :3, 3] += way
    else:
        axis = rng.normal(size=(len(off), 3))
        axis *= np.radians(rng.uniform(10, 180, (len(off), 1))) / np.linalg.norm(axis, axis=1, keepdims=True)
        predicted[off, :3, :3] = Rotation.from_rotvec(axis).as_matrix() @ predicted[off, :3, :3]
    turns = Rotation.from_rotvec(small(count + 1, np.radians(noise_deg))).as_matrix()
    predicted[:, :3, :3] = turns @ predicted[:, :3, :3]
    predicted[:, :3, 3] += small(count + 1, noise_m)
    scale = float(np.exp(rng.uniform(-3, 3)))
    turn, shift = rotations(1)[0], rng.normal(0, 5, 3)
    model = geometry.make_pose(turn.T @ predicted[:, :3, :3], (predicted[:, :3, 3] @ turn) / scale + shift)
    ratios = None
    if case.depth_ratios:
        ratios = scale * (1 + case.depth_noise * rng.normal(size=case.depth_ratios))
        bad = rng.permutation(case.depth_ratios)[: int(case.wrong_depth * case.depth_ratios)]
        ratios[bad] *= rng.uniform(1.5, 4.0, len(bad))
    return Trial(model[:-1], world[:-1], model[-1], world[-1], wrong, ratios, scale)


def umeyama(source: Floats, target: Floats) -> tuple[float, Floats, Floats]:
    """Return scale, rotation and translation of the similarity with the least squared error (Umeyama 1991)."""
    mean_source, mean_target = source.mean(axis=0), target.mean(axis=0)
    x, y = source - mean_source, target - mean_target
    U, values, Vt = np.linalg.svd(y.T @ x / len(x))
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(Vt))])
    R = (U * signs) @ Vt
    scale = float(values @ signs / np.mean((x**2).sum(axis=1)))
    return scale, R, mean_target - scale * R @ mean_source


def published(trial: Trial) -> tuple[Floats, float] | None:
    """Return world_from_query by the published recipe and the error it reports; None with fewer than 3 references."""
    source, target = trial.model_from_cams[:5, :3, 3], trial.world_from_cams[:5, :3, 3]
    if len(source) < 3:
        return None
    best: tuple[float, Floats] | None = None
    for chosen in combinations(range(len(source)), min(4, len(source))):
        index = list(chosen)
        scale, R, t = umeyama(source[index], target[index])
        error = float(np.sqrt(np.mean(((scale * source[index] @ R.T + t - target[index]) ** 2).sum(axis=1))))
        if best is None or error < best[0]:
            center = scale * R @ trial.model_from_query[:3, 3] + t
            best = error, geometry.make_pose(R @ trial.model_from_query[:3, :3], center)
    assert best is not None
    return best[1], best[0]


def run(case: Case, trials: int, seed: int, noise_m: float, noise_deg: float) -> dict[str, NDArray]:
    """Return what is printed, an array (trials,) each."""
    rng = np.random.default_rng(seed)
    names = ("error_m", "error_deg", "ok", "unknown", "found", "seconds", "theirs_m", "theirs_deg", "theirs_rmse")
    rows: dict[str, NDArray] = {name: np.full(trials, np.nan) for name in names}
    for row in range(trials):
        trial = simulate(case, rng, noise_m, noise_deg)
        start = time.perf_counter()
        alignment = align_to_map(trial.model_from_cams, trial.world_from_cams, depth_ratios=trial.depth_ratios)
        rows["seconds"][row] = time.perf_counter() - start
        pose, covariance = query_pose(alignment, trial.model_from_query)
        rows["error_deg"][row], rows["error_m"][row] = geometry.pose_error(pose, trial.world_from_query)
        rows["ok"][row] = is_trustworthy(alignment, covariance)
        rows["unknown"][row] = not alignment.scale_known
        rows["found"][row] = np.array_equal(alignment.consistent, ~trial.wrong)
        if theirs := published(trial):
            rows["theirs_deg"][row], rows["theirs_m"][row] = geometry.pose_error(theirs[0], trial.world_from_query)
            rows["theirs_rmse"][row] = theirs[1]
    return rows


def within(degrees: NDArray, meters: NDArray) -> str:
    """Return the share within (5 deg, 0.5 m), per cent."""
    return f"{100 * np.mean((degrees <= 5) & (meters <= 0.5)):5.1f}" if len(degrees) else "    -"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=1000, help="a case")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--noise-m", type=float, default=0.03)
    parser.add_argument("--noise-deg", type=float, default=1.0)
    parser.add_argument("--by-axis", action="store_true", help="the noise is that of each axis")
    options = parser.parse_args()
    factor = np.sqrt(3) if options.by_axis else 1.0
    noise = f"noise {options.noise_m} m and {options.noise_deg} deg {'by axis' if options.by_axis else 'in all'}"
    print(f"simulated predictor, {options.trials} trials a case, seed {options.seed}: {noise}, query {QUERY_M} m away")
    print(f"{'':46s}|                 ours                      |   published recipe")
    print(f"{'case':46s}| median m  unknown  found    ok  ok within  | median m  within  rmse m |   ms")
    everything = []
    for index, case in enumerate(CASES):
        rows = run(case, options.trials, options.seed + index, options.noise_m * factor, options.noise_deg * factor)
        everything.append(rows)
        ok = rows["ok"] > 0
        print(
            f"{case.name:46s}| {np.median(rows['error_m']):8.3f} {100 * rows['unknown'].mean():7.1f}% "
            f"{100 * rows['found'].mean():5.1f}% {100 * ok.mean():5.1f}% "
            f"{within(rows['error_deg'][ok], rows['error_m'][ok]):>8s} % | "
            f"{np.median(rows['theirs_m']):8.3f}  {within(rows['theirs_deg'], rows['theirs_m'])}% "
            f"{np.median(rows['theirs_rmse']):7.3f} | {1e3 * np.median(rows['seconds']):4.1f}",
            flush=True,
        )
    joined = {name: np.concatenate([rows[name] for rows in everything]) for name in everything[0]}
    ok, answered = joined["ok"] > 0, np.isfinite(joined["theirs_m"])
    ours = within(joined["error_deg"][ok], joined["error_m"][ok])
    theirs = within(joined["theirs_deg"][answered], joined["theirs_m"][answered])
    print(f"within (5 deg, 0.5 m), all cases: of the {100 * ok.mean():.1f} % that are called ok {ours} %, the furthest")
    print(f"{joined['error_m'][ok].max():.2f} m; published recipe {theirs} %, {np.nanmax(joined['theirs_m']):.3g} m")


if __name__ == "__main__":
    main()
