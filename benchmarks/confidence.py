"""How probable is it that a pose is right? Fits the weights of `toolkit/localizers/confidence.py`.

    python benchmarks/confidence.py [--seeds 0 1 2] [--rooms 3] [--frames 6] [--rows ROWS.csv] [--out FILE.md]
        [--run CAPTURE RUN]... [--held-out SCENE]...

For each seed a capture is rendered with a sparse map, and with the same doors, windows, shelves, cabinets and crates in
all rooms. Its queries are localized as they are, and darkened, blurred and half hidden; with references that see the
same, with one such among wrong ones, and with none (the place is not found: every pose is wrong). `--run` adds the
queries of a finished run of a capture with ground truth. Each row says what the localizer knows of a pose, and whether
it is wrong: beyond 5 degrees or 0.5 m.

A logistic regression is fitted, with a ridge of 1 on standardized terms and the sign of each weight given, and tried on
what it was not fitted on: on each scene (seed or run) by the weights of the others, and on the scenes held out by the
weights of all. The tables tell how many poses each stated probability has, and how many of them are right; and of those
that are called `ok` (99 % or more) how many are wrong, with the upper end of the one-sided 95 % interval (Clopper,
Pearson 1934). Rows are kept in --rows after each map, and a further call adds seeds.
"""

import argparse
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pandas as pd
from common import add_out, check_out, limit_cores, markdown_table, write_out
from numpy.typing import NDArray

if TYPE_CHECKING:
    from toolkit.capture import Session
    from toolkit.localizers.pnp import PnpLocalizer

WRONG = (5.0, 0.5)  # degrees, meters
CONFIDENCE = 0.95
OK = 0.99
SIGNS = (0, 1, 1, 1, -1, -1, -1, 1)
"""Of the weights: more inliers never make a pose less probable, whatever some hundred rows say."""
BINS = (0.0, 0.1, 0.5, 0.9, 0.99, 1.0)
DEGRADATIONS = ("none", "dark", "blurred", "hidden", "dark, hidden")
REFERENCES = ("right", "one right", "wrong")
DEVICES = ("ios", "hl", "spot")

Image = NDArray[np.uint8]


def degrade(image: Image, how: str, rng: np.random.Generator) -> Image:
    """Return a gray image (H, W) as a worse camera, or one in the way of others, would have taken it."""
    height, width = image.shape
    if "hidden" in how:
        kept = np.zeros(image.shape, np.uint8)
        size = rng.uniform(0.15, 0.5) * np.array([width, height])
        x, y = (rng.uniform(0, 1, 2) * (np.array([width, height]) - size)).astype(int)
        kept[y : y + int(size[1]), x : x + int(size[0])] = 1
        clutter = cv2.resize(rng.integers(0, 255, (height // 8, width // 8), np.uint8), (width, height))
        image = np.where(kept, image, clutter).astype(np.uint8)
    if "blurred" in how:
        image = np.asarray(cv2.GaussianBlur(image, (0, 0), rng.uniform(1.5, 5)), np.uint8)
    if "dark" in how:
        noisy = image * rng.uniform(0.05, 0.2) + rng.normal(0, rng.uniform(1, 4), image.shape)
        image = np.clip(noisy, 0, 255).astype(np.uint8)
    return image


def choose_references(
    world_from_cam: NDArray[np.float64], world_from_maps: NDArray[np.float64], how: str, rng: np.random.Generator
) -> list[int]:
    """Return map images for a query camera: `right` ones look the same way near by, `wrong` ones stand rooms away."""
    apart = np.linalg.norm(world_from_maps[:, :3, 3] - world_from_cam[:3, 3], axis=1)
    facing = world_from_maps[:, :3, 2] @ world_from_cam[:3, 2]
    near = np.argsort(apart - 4 * facing, kind="stable")
    right = near[apart[near] < 12][: 3 if how == "right" else 1]
    far = np.flatnonzero(apart >= 12)
    wrong = rng.permutation(far)[:5]
    return {"right": right, "one right": np.concatenate([right, wrong[:4]]), "wrong": wrong}[how].tolist()


def localize_session(
    session: "Session", localizer: "PnpLocalizer", seed: int, workers: int
) -> Iterator[list[dict[str, Any]]]:
    """Yield for each query of a session a row by degradation and choice of references."""
    from toolkit.capture.images import prefetch, read_image
    from toolkit.features.sift import SiftExtractor
    from toolkit.geometry import pose_error
    from toolkit.localizers.base import Query, References, View
    from toolkit.localizers.confidence import EVIDENCE

    extractor = SiftExtractor()
    keyframes = session.keyframes("keyframes_original")
    assert session.ground_truth is not None
    truth = session.ground_truth.lookup(keyframes["timestamp"].to_numpy(np.int64), keyframes["device_id"])
    rows_of_queries = session.rows_of_keyframes(keyframes)

    def localize(index: int) -> list[dict[str, Any]]:
        rows = rows_of_queries[index]
        images = [read_image(session.image_path(int(row)), gray=True) for row in rows]
        cameras = [session.camera(session.images["sensor_id"].iloc[row]) for row in rows]
        views = [
            View(session.image_name(int(row)), image, camera, in_map=False)
            for row, image, camera in zip(rows, images, cameras, strict=True)
        ]
        rig_from_cams = session.rig_from_cam(rows)
        found_rows = []
        for turn, how in enumerate(DEGRADATIONS):
            rng = np.random.default_rng([seed, index, turn])
            features = extractor.extract([degrade(image, how, rng) for image in images])
            query = Query(views, rig_from_cams, [[of_image] for of_image in features])
            for chosen in REFERENCES:
                world_from_cams = truth[index] @ rig_from_cams
                poses = localizer.map.world_from_cams
                references = [
                    References.of(choose_references(pose, poses, chosen, rng)) for pose in world_from_cams
                ]
                found = localizer.localize(query, references)
                row = {"scene": f"seed {seed}", "seed": seed, "session": session.id}
                row |= {"query": index, "images": how, "references": chosen}
                row |= {"status": found.status, "posed": found.world_from_rig is not None, "wrong": False}
                row |= {"rotation_error_deg": float("nan"), "translation_error_m": float("nan")}
                if found.world_from_rig is not None:
                    rotation_deg, distance_m = pose_error(found.world_from_rig, truth[index])
                    row["wrong"] = bool(rotation_deg > WRONG[0] or distance_m > WRONG[1])
                    row |= {"rotation_error_deg": float(rotation_deg), "translation_error_m": float(distance_m)}
                found_rows.append(row | {name: getattr(found, name) for name in EVIDENCE})
        return found_rows

    return prefetch(localize, range(len(rows_of_queries)), workers)


def measure(
    folder: Path, seed: int, rooms: int, frames: int, workers: int, done: set[str]
) -> Iterator[list[dict[str, Any]]]:
    """Render a capture and yield the rows of each map, but of those of the devices that are done."""
    from toolkit.capture import Capture
    from toolkit.features.stores import extract_session
    from toolkit.localizers.mapping import build_map
    from toolkit.localizers.matches import MappedFeatures
    from toolkit.localizers.pnp import PnpLocalizer
    from toolkit.synthetic import render_capture

    scene = folder / f"SEED{seed}"
    capture = Capture.open(render_capture(scene, rooms, frames, seed, progress=False, look_alikes=True))
    for device in [device for device in capture.devices if device not in done]:
        session = capture[f"{device}_map"]
        store = extract_session(session, folder / f"features{seed}", workers=workers)
        local_map = build_map(session, store, folder / f"{device}{seed}.npz", workers=workers)
        localizer = PnpLocalizer([MappedFeatures(local_map, store)])
        yield [
            row | {"map": device}
            for asked in capture.devices
            for rows in localize_session(capture[f"{asked}_query"], localizer, seed, workers)
            for row in rows
        ]


def rows_of_run(capture_path: Path, run: Path) -> pd.DataFrame:
    """Return a row for each query of all pairs of a finished run."""
    from toolkit.capture import Capture, Trajectory
    from toolkit.capture.tables import POSES_UNIT
    from toolkit.evaluate import pose_errors
    from toolkit.files import SceneFiles

    capture = Capture.open(capture_path)
    tables = []
    for path in sorted(SceneFiles(run, capture.name).poses_dir.glob("*.csv")):
        truth = capture[f"{path.stem.rpartition('_query_')[2]}_query"].ground_truth
        assert truth is not None, f"{capture_path} has no ground truth"
        table = pd.read_csv(path, dtype={"device_id": str}).rename(columns=POSES_UNIT)
        rotation_deg, distance_m = pose_errors(Trajectory.read(path.with_suffix(".txt")), truth, table)
        wrong = (rotation_deg > WRONG[0]) | (distance_m > WRONG[1])
        tables.append(table.assign(scene=capture.name, posed=np.isfinite(distance_m), wrong=wrong))
    return pd.concat(tables, ignore_index=True)


def fit(rows: pd.DataFrame, ridge: float = 1.0) -> NDArray[np.float64]:
    """Return the weights of `terms` that tell right poses from wrong ones best."""
    from scipy.optimize import minimize

    from toolkit.localizers.confidence import EVIDENCE, terms

    rows = rows[rows["posed"]]
    x = terms({name: rows[name].to_numpy(np.float64) for name in EVIDENCE})
    known = np.isfinite(x).all(axis=1)
    x, right = x[known], ~rows["wrong"].to_numpy(bool)[known]
    mean, spread = x.mean(axis=0), np.maximum(x.std(axis=0), 1e-9)
    mean[0], spread[0] = 0.0, 1.0
    z, sign = (x - mean) / spread, np.where(right, 1.0, -1.0)

    def loss(weights: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        margin = sign * (z @ weights)
        penalty = np.concatenate([[0.0], weights[1:]])
        slope = -sign / (1 + np.exp(np.clip(margin, -500, 500)))
        return float(np.logaddexp(0, -margin).sum() + ridge / 2 * penalty @ penalty), z.T @ slope + ridge * penalty

    bounds = [(None, None) if s == 0 else (0, None) if s > 0 else (None, 0) for s in SIGNS]
    scaled = minimize(loss, np.zeros(x.shape[1]), jac=True, method="L-BFGS-B", bounds=bounds).x / spread
    scaled[0] -= scaled[1:] @ mean[1:]
    return np.asarray(scaled, np.float64)


def stated(rows: pd.DataFrame, weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the probability of each row, 0 where there is no pose or no deviation."""
    from toolkit.localizers.confidence import EVIDENCE, probability_right

    evidence = {name: rows[name].to_numpy(np.float64) for name in EVIDENCE}
    return np.where(rows["posed"], probability_right(evidence, weights), 0.0)


def judge(rows: pd.DataFrame, probability: NDArray[np.float64]) -> dict[str, float]:
    """Return what is called `ok`, and how wrong it is."""
    from scipy.stats import beta

    from toolkit.localizers.pnp import MAX_RIVAL_SUPPORT

    accepted = (probability >= OK) & (rows["rival_support"] <= MAX_RIVAL_SUPPORT)
    wrong, count = int((accepted & rows["wrong"]).sum()), int(accepted.sum())
    right = int((rows["posed"] & ~rows["wrong"]).sum())
    upper = float(beta.ppf(CONFIDENCE, wrong + 1, count - wrong)) if count > wrong else 1.0
    return {"accepted": count, "wrong": wrong, "upper": upper, "right": right, "found": (count - wrong) / max(right, 1)}


def markdown(rows: pd.DataFrame, held_out: list[str]) -> str:
    """Return the weights, and how they hold on scenes that they were not fitted on."""
    from toolkit.localizers.confidence import WEIGHTS

    learned, other = rows[~rows["scene"].isin(held_out)], rows[rows["scene"].isin(held_out)]
    weights = fit(learned)
    probability = pd.Series(0.0, rows.index)
    for scene, part in learned.groupby("scene"):
        rest = learned[learned["scene"] != scene]
        probability[part.index] = stated(part, fit(rest) if len(rest) else weights)
    probability[other.index] = stated(other, weights)
    text = [f"{len(rows)} queries, weights fitted on {len(learned)}:", ""]
    text += [markdown_table(["term", "weight"], [[n, f"{w:.4f}"] for n, w in zip(WEIGHTS, weights, strict=True)]), ""]
    table = []
    for scene, part in [*rows.groupby("scene"), ("all", rows)]:
        judged = judge(part, probability[part.index].to_numpy())
        name = f"{scene} (held out)" if scene in held_out else str(scene)
        table.append([name, f"{len(part)}", f"{part['posed'].sum()}", f"{(part['posed'] & part['wrong']).sum()}",
                      f"{judged['accepted']}", f"{judged['wrong']}", f"{100 * judged['upper']:.2f} %",
                      f"{100 * judged['found']:.1f} %"])  # fmt: skip
    header = ["scene", "queries", "posed", "wrong", "ok", "ok and wrong", "at most", "right ones called ok"]
    text += [markdown_table(header, table), ""]
    posed = rows[rows["posed"]]
    bins = pd.cut(probability[posed.index], BINS, include_lowest=True)
    table = []
    for interval, part in posed.groupby(bins, observed=True):
        shares = (probability[part.index].mean(), (~part["wrong"]).mean())
        table.append([str(interval), f"{len(part)}", *(f"{100 * share:.1f} %" for share in shares)])
    text += [markdown_table(["stated", "poses", "on average", "right"], table)]
    return "\n".join(text) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", type=Path, nargs=2, action="append", default=[], help="a capture and a run of it")
    parser.add_argument("--held-out", action="append", default=[], help="scene that nothing is fitted on")
    parser.add_argument("--seeds", type=int, nargs="*", default=[0, 1, 2], help="captures to render (default: 0 1 2)")
    parser.add_argument("--rooms", type=int, default=3, help="rooms of each (default: %(default)s)")
    parser.add_argument("--frames", type=int, default=6, help="map frames a room and device (default: %(default)s)")
    parser.add_argument("--threads", type=int, default=2, help="cores (default: %(default)s)")
    parser.add_argument("--rows", type=Path, help="CSV that rows are added to; maps in it are not made again")
    add_out(parser)
    options = parser.parse_args()
    check_out(parser, options.out)
    limit_cores(options.threads)
    kept = options.rows is not None and options.rows.is_file()
    rows = pd.read_csv(options.rows) if kept else pd.DataFrame()
    made = {"rooms": options.rooms, "frames": options.frames}
    if kept and (not made.keys() <= set(rows) or (rows[list(made)] != list(made.values())).to_numpy().any()):
        parser.error(f"--rows {options.rows}: its rows are of other --rooms or --frames; name another file.")
    for seed in options.seeds:
        done = set(rows.loc[rows["seed"] == seed, "map"]) if len(rows) else set()
        if len(done) == len(DEVICES):
            continue
        with tempfile.TemporaryDirectory() as folder:
            for part in measure(Path(folder), seed, options.rooms, options.frames, options.threads, done):
                rows = pd.concat([rows, pd.DataFrame(part).assign(**made)], ignore_index=True)
                if options.rows is not None:
                    rows.to_csv(options.rows, index=False)
    rows = pd.concat([rows, *(rows_of_run(*run) for run in options.run)], ignore_index=True)
    text = markdown(rows, options.held_out)
    print(text)
    write_out(options.out, text, {"rows": rows.to_dict("records")})


if __name__ == "__main__":
    main()
