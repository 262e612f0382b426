"""How probable is it that a pose is right? Fits the weights of `toolkit/pose/pnp.py`.

    python benchmarks/confidence.py FOLDER CAPTURE... [--rendered 0 1] [--alike 0 1] [--rows ROWS.csv] [--out FILE.md]
        [--held-out SCENE]...

Each capture with ground truth is copied to FOLDER in several ways (`WAYS`): query images darkened, blurred, put into
fog or half hidden, poses of the map moved and turned at random, focal lengths of the map too long. Captures are also
rendered: rooms with the same doors, windows, shelves and crates (--rendered), and two rooms that are copies of each
other (--alike). Each copy goes through the stages as users run them, with SIFT alone or with the defaults (`WAYS`); a
further call makes only what is missing. Each row says what the localizer knows of a pose, and whether it is wrong:
beyond 5 degrees or 0.5 m.

A logistic regression is fitted to the poses that no other check refuses, with a ridge of 1 on standardized terms and
the sign of each weight given. Each scene (a recording's hour of a capture, in all ways) is judged by weights fitted on
the others, scenes held out by the weights of all others. The tables tell how many poses each stated probability has,
and how many of them are right; and of those that are called `ok` (99 % or more) how many are wrong, with the upper end
of the one-sided 95 % interval (Clopper, Pearson 1934), by scene and by way.
"""

import argparse
import shutil
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple
from unittest.mock import patch

import cv2
import numpy as np
import pandas as pd
from common import add_out, check_out, limit_cores, markdown_table, write_out
from numpy.typing import NDArray

if TYPE_CHECKING:
    from toolkit.synthetic.render import Quad, Scene
    from toolkit.synthetic.textures import Material

WRONG = (5.0, 0.5)  # degrees, meters
CONFIDENCE = 0.95
OK = 0.99
SIGNS = {"log_inliers": 1, "inlier_ratio": 1, "coverage": 1, "rival_support": -1, "log_position_std": -1,
         "log_rotation_std": -1, "log_agreement": 1}  # fmt: skip
"""Of the weights: more inliers never make a pose less probable, whatever some hundred rows say."""
SLOPES = np.arange(1.0, 20.0, 0.1)  # tried for `RIVAL_SLOPE`
BINS = (0.0, 0.1, 0.5, 0.9, 0.99, 1.0)
DEGRADATIONS = ("none", "dark", "blurred", "fog", "hidden", "dark, hidden")
SOLD_OFTEN = ("books", "crate", "door", "drawers", "window")  # materials of which there are few models
MODELS = 2  # textures per such material and size in whole meters

Image = NDArray[np.uint8]


class Way(NamedTuple):
    """How a capture is made hard."""

    degraded: bool = False
    """Whether query images are degraded, each in a way drawn from `DEGRADATIONS`."""
    max_rotation_deg: float = 0.0
    max_shift: float = 0.0
    """Standard deviations of the noise of the map's poses are drawn up to these, degrees and meters."""
    max_focal: float = 0.0
    """The focal lengths of the map are too long by a share drawn up to this."""
    defaults: bool = False
    """Whether unsure queries are localized again with learned features."""


WAYS = {
    "as it is": Way(),
    "degraded": Way(degraded=True),
    "map poses": Way(degraded=True, max_rotation_deg=2.0, max_shift=0.03),
    "map focal length": Way(degraded=True, max_focal=0.15),
    "degraded, defaults": Way(degraded=True, defaults=True),
}


def degrade(image: Image, how: str, rng: np.random.Generator) -> Image:
    """Return an image (H, W, 3) as a worse camera, in worse weather, or behind something, would have taken it."""
    height, width = image.shape[:2]
    if "hidden" in how:
        kept = np.zeros((height, width, 1), np.uint8)
        size = rng.uniform(0.15, 0.5) * np.array([width, height])
        x, y = (rng.uniform(0, 1, 2) * (np.array([width, height]) - size)).astype(int)
        kept[y : y + int(size[1]), x : x + int(size[0])] = 1
        clutter = cv2.resize(rng.integers(0, 255, (height // 8, width // 8, 3), np.uint8), (width, height))
        image = np.where(kept, image, clutter).astype(np.uint8)
    if "blurred" in how:
        image = np.asarray(cv2.GaussianBlur(image, (0, 0), rng.uniform(1.5, 5)), np.uint8)
    if "fog" in how:
        image = np.clip(rng.uniform(0.1, 0.3) * image + 150 + rng.normal(0, 3, image.shape), 0, 255).astype(np.uint8)
    if "dark" in how:
        noisy = image * rng.uniform(0.05, 0.2) + rng.normal(0, rng.uniform(1, 4), image.shape)
        image = np.clip(noisy, 0, 255).astype(np.uint8)
    return image


def harden(capture: Path, copy: Path, way: Way, seed: int) -> None:
    """Write a copy of a capture, made hard."""
    from scipy.spatial.transform import Rotation

    from toolkit.capture import Capture, Trajectory

    partial = copy.with_name(f"{copy.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    shutil.copytree(capture, partial)
    rng = np.random.default_rng(seed)
    opened = Capture.open(partial)
    for session in (opened[name] for name in opened.session_ids):
        if session.id.endswith("_query"):
            for row in range(len(session.images) if way.degraded else 0):
                path = session.image_path(row)
                image = cv2.imread(str(path))
                assert image is not None, path
                cv2.imwrite(str(path), degrade(image.astype(np.uint8), str(rng.choice(DEGRADATIONS)), rng))
            continue
        rotation_deg, shift = rng.uniform(0, way.max_rotation_deg), rng.uniform(0, way.max_shift)
        if way.max_rotation_deg:
            path = session.path / "trajectories.txt"
            given = Trajectory.read(path)
            poses = given.world_from_device
            turns = Rotation.from_rotvec(rng.normal(0, rotation_deg, (len(poses), 3)), degrees=True)
            poses[:, :3, :3] = poses[:, :3, :3] @ turns.as_matrix()
            poses[:, :3, 3] += rng.normal(0, shift, (len(poses), 3))
            Trajectory.from_poses(given.timestamps, given.arrow_ids, poses).write(path)
        if way.max_focal:
            factor = 1 + rng.uniform(0, way.max_focal)
            path = session.path / "sensors.txt"
            path.write_text("".join(_longer(line, factor) for line in path.read_text().splitlines(keepends=True)))
    partial.rename(copy)


def _longer(line: str, factor: float) -> str:
    """Return a line of sensors.txt, a camera's focal lengths times a factor."""
    from toolkit.capture.images import camera_text, parse_camera

    if line.startswith("#") or line.split(",")[2].strip() != "camera":
        return line
    sensor_id, name, kind, params = line.split(",", 3)
    camera = parse_camera(kind.strip(), params)
    scale = np.ones(len(camera.params))
    scale[camera.focal_length_idxs()] = factor
    camera.params = scale * camera.params
    return f"{sensor_id},{name},{kind}, {camera_text(camera)}\n"


def localize(capture: Path, run: Path, defaults: bool) -> None:
    """Localize the queries of a capture in all of its maps."""
    from toolkit.embed import embed_sessions
    from toolkit.files import SceneFiles
    from toolkit.localize import localize_pairs
    from toolkit.retrieve import retrieve_pairs

    files = SceneFiles(run, capture.name)
    embed_sessions(capture / "sessions", files.embeddings, features_dir=files.features)
    retrieve_pairs(capture / "sessions", files.embeddings, files.retrieval_dir)
    settings = {} if defaults else {"features": ["sift"]}
    localize_pairs(capture / "sessions", files.retrieval_dir, files.poses_dir, files.features, files.maps, settings)


def rows_of_run(capture_path: Path, run: Path) -> pd.DataFrame:
    """Return a row for each query of all pairs of a finished run."""
    from toolkit.capture import Capture, Trajectory
    from toolkit.evaluate import pose_errors
    from toolkit.files import SceneFiles, read_map_record
    from toolkit.manifest import PnpSettings
    from toolkit.pose.pnp import clarity_of_support

    capture = Capture.open(capture_path)
    tables = []
    for path in sorted(SceneFiles(run, capture.name).poses_dir.glob("*.csv")):
        of_map, query_device = path.stem.rsplit("_query_", 1)
        noise_deg = read_map_record(path.with_name(f"{of_map}.json"))["direction_noise_deg"]
        clarity = clarity_of_support(noise_deg, PnpSettings().max_error_deg)
        truth = capture[f"{query_device}_query"].ground_truth
        assert truth is not None, f"{capture_path} has no ground truth"
        table = pd.read_csv(path, dtype={"device_id": str}).rename(columns={"position_std_m": "position_std"})
        rotation_deg, distance_m = pose_errors(Trajectory.read(path.with_suffix(".txt")), truth, table)
        wrong = (rotation_deg > WRONG[0]) | (distance_m > WRONG[1])
        refused = table["status"].str.startswith("low_confidence: ")
        made = {"pair": path.stem, "posed": np.isfinite(distance_m), "wrong": wrong, "refused": refused}
        made |= {"ok": table["status"] == "ok", "clarity": clarity}
        tables.append(table.assign(**made, rotation_error_deg=rotation_deg, translation_error_m=distance_m))
    return pd.concat(tables, ignore_index=True)


def fit(rows: pd.DataFrame, ridge: float = 1.0) -> NDArray[np.float64]:
    """Return the weights of `terms` that tell right poses from wrong ones best."""
    from scipy.optimize import minimize

    from toolkit.pose.pnp import EVIDENCE, WEIGHTS, terms

    rows = rows[rows["posed"] & ~rows["refused"]]
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

    limits = {0: (None, None), 1: (0, None), -1: (None, 0)}
    bounds = [limits[SIGNS.get(name, 0)] for name in WEIGHTS]
    scaled = minimize(loss, np.zeros(x.shape[1]), jac=True, method="L-BFGS-B", bounds=bounds).x / spread
    scaled[0] -= scaled[1:] @ mean[1:]
    return np.asarray(scaled, np.float64)


def stated(rows: pd.DataFrame, weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the probability of each row, bounded as in the localizer; 0 where there is no pose or no deviation."""
    from toolkit.pose.pnp import EVIDENCE, bounded_by_deviation, bounded_by_rivals, probability_right

    evidence = {name: rows[name].to_numpy(np.float64) for name in EVIDENCE}
    alone = np.where(rows["posed"], probability_right(evidence, weights), 0.0)
    rivals = [[rival] if rival > 0 else [] for rival in rows["rival_support"]]
    bounded = map(bounded_by_rivals, alone, rivals, rows["clarity"])
    return np.array(list(map(bounded_by_deviation, bounded, rows["position_std"], rows["rotation_std_deg"])))


def judge(rows: pd.DataFrame, probability: NDArray[np.float64]) -> dict[str, float]:
    """Return what is called `ok`, and how wrong it is."""
    from scipy.stats import beta

    from toolkit.pose.pnp import MAX_RIVAL_SUPPORT

    accepted = (probability >= OK) & ~rows["refused"] & (rows["rival_support"] <= MAX_RIVAL_SUPPORT)
    wrong, count = int((accepted & rows["wrong"]).sum()), int(accepted.sum())
    right = int((rows["posed"] & ~rows["wrong"]).sum())
    upper = float(beta.ppf(CONFIDENCE, wrong + 1, count - wrong)) if count > wrong else 1.0
    return {"accepted": count, "wrong": wrong, "upper": upper, "right": right, "found": (count - wrong) / max(right, 1)}


def rival_slopes(rows: pd.DataFrame) -> tuple[float, float]:
    """Return the most probable `RIVAL_SLOPE`, and the largest with which at most 1 % of all `ok` poses are wrong."""
    from toolkit.pose import pnp

    support = np.clip(rows["rival_support"].to_numpy(np.float64), 0.05, 1)
    rival = rows["posed"] & ~rows["refused"] & (rows["rival_support"] > 0)
    with patch.object(pnp, "RIVAL_SLOPE", np.inf):  # all else that bounds the probability
        unequal = rows.assign(rival_support=rows["rival_support"].clip(upper=0.999))
        most = stated(unequal, np.array(list(pnp.WEIGHTS.values())))
    loss, holds = [], []
    for slope in SLOPES:
        with patch.object(pnp, "RIVAL_SLOPE", slope):
            odds = pnp.odds_of_rivals(support, rows["clarity"].to_numpy(np.float64))
        judged = judge(rows, np.minimum(most, 1 / (1 + odds)))
        loss.append(np.log1p(np.where(rows["wrong"], 1 / odds, odds))[rival].sum())
        holds.append(judged["wrong"] <= (1 - OK) * judged["accepted"])
    return float(SLOPES[np.argmin(loss)]), max(SLOPES[holds].tolist(), default=float("nan"))


def markdown(rows: pd.DataFrame, held_out: list[str]) -> str:
    """Return the weights, and how they hold on scenes that they were not fitted on."""
    from toolkit.pose.pnp import WEIGHTS

    learned, other = rows[~rows["scene"].isin(held_out)], rows[rows["scene"].isin(held_out)]
    weights = fit(learned)
    probability = pd.Series(0.0, rows.index)
    for scene, part in learned.groupby("scene"):
        rest = learned[learned["scene"] != scene]
        probability[part.index] = stated(part, fit(rest) if len(rest) else weights)
    probability[other.index] = stated(other, weights)
    text = [f"{len(rows)} queries, weights fitted on {len(learned)}:", ""]
    text += [markdown_table(["term", "weight"], [[n, f"{w:.4f}"] for n, w in zip(WEIGHTS, weights, strict=True)]), ""]
    for name, part in (("fitted on", learned), ("held out", other)):
        if (part["rival_support"] > 0).any():
            likely, largest = rival_slopes(part)
            told = f"{likely:.1f} is most probable; up to {largest:.1f}, at most 1 % of `ok` poses are wrong."
            text += [f"`RIVAL_SLOPE` by scenes {name}: {told}", ""]
    for column in ("scene", "way", "escalated"):
        table = []
        for group, part in [*rows.groupby(column), ("all", rows)]:
            judged = judge(part, probability[part.index].to_numpy())
            name = f"{group} (held out)" if group in held_out else str(group)
            table.append([name, f"{len(part)}", f"{part['posed'].sum()}", f"{(part['posed'] & part['wrong']).sum()}",
                          f"{judged['accepted']}", f"{judged['wrong']}", f"{100 * judged['upper']:.2f} %",
                          f"{100 * judged['found']:.1f} %", f"{part['ok'].sum()}",
                          f"{(part['ok'] & part['wrong']).sum()}"])  # fmt: skip
        header = [column, "queries", "posed", "wrong", "ok", "ok and wrong", "at most", "right ones called ok",
                  "`ok` today", "`ok` today and wrong"]  # fmt: skip
        text += [markdown_table(header, table), ""]
    posed = rows[rows["posed"] & ~rows["refused"]]
    bins = pd.cut(probability[posed.index], BINS, include_lowest=True)
    table = []
    for interval, part in posed.groupby(bins, observed=True):
        shares = (probability[part.index].mean(), (~part["wrong"]).mean())
        table.append([str(interval), f"{len(part)}", *(f"{100 * share:.1f} %" for share in shares)])
    text += [markdown_table(["stated", "poses", "on average", "right"], table)]
    return "\n".join(text) + "\n"


def room_of_few_models(seed: int, index: int, look: int | None = None) -> "Scene":
    """Return a room with doors, windows, shelves, cabinets and crates in few models, as in all rooms of the seed."""
    from toolkit.synthetic.render import build_room, named_rng
    from toolkit.synthetic.textures import Image, Rng

    def draw(quad: "Quad", material: "Material", name: str, rng: Rng, h: int, w: int, ppm: float) -> Image:
        # Draw the texture for whole meters and crop it, so that objects of different widths share their left part.
        full_h, full_w = (round(np.ceil(side) * ppm) + 32 for side in (quad.height, quad.width))
        return material(named_rng(seed, "model", name, int(rng.integers(MODELS))), full_h, full_w, ppm)[:h, :w]

    room = build_room(seed, index, look)
    for quad in room.quads:
        name = getattr(quad.material, "func", quad.material).__name__
        if name in SOLD_OFTEN:
            quad.material = partial(draw, quad, quad.material, name)
    return room


def make_rows(folder: Path, captures: list[Path], rendered: list[int], alike: list[int]) -> pd.DataFrame:
    """Return the rows of all captures in all ways; make what is not there."""
    from toolkit.synthetic import capture as rendering

    captures = list(captures)
    for name, seeds in (("ROOMS", rendered), ("ALIKE", alike)):
        for seed in seeds:
            capture = folder / "rendered" / f"{name}{seed}"
            if not capture.exists() and name == "ALIKE":
                rendering.render_capture(capture, 2, 6, seed, progress=False, alike=True)
            elif not capture.exists():
                with patch.object(rendering, "build_room", room_of_few_models):
                    rendering.render_capture(capture, 3, 6, seed, progress=False)
            captures.append(capture)
    tables = []
    for name, way in WAYS.items():
        for seed, capture in enumerate(captures):
            copy = folder / name / capture.name
            if not copy.exists():
                copy.parent.mkdir(exist_ok=True)
                harden(capture, copy, way, seed)
            run = folder / "runs" / name
            localize(copy, run, way.defaults)
            rows = rows_of_run(copy, run)
            hour = rows["device_id"].str.extract(r"\d{4}-\d\d-\d\d[-_](\d\d)", expand=False)
            scene = capture.name.removesuffix("_HARD")
            rows["scene"] = scene if len(hour.unique()) > 3 else (scene + " " + hour.fillna("")).str.strip()
            tables.append(rows.assign(capture=capture.name, way=name, escalated=rows["agreement"] > 0))
            wrong = (rows["posed"] & rows["wrong"]).sum()
            print(f"{capture.name}, {name}: {len(rows)} queries, {wrong} wrong poses", flush=True)
    return pd.concat(tables, ignore_index=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="for hard captures and their runs")
    parser.add_argument("captures", type=Path, nargs="*", help="captures with ground truth")
    parser.add_argument("--rendered", type=int, nargs="*", default=[], help="seeds of rooms to render")
    parser.add_argument("--alike", type=int, nargs="*", default=[], help="seeds of pairs of equal rooms to render")
    parser.add_argument("--held-out", action="append", default=[], help="scene that nothing is fitted on")
    parser.add_argument("--threads", type=int, default=2, help="cores (default: %(default)s)")
    parser.add_argument("--rows", type=Path, help="write the rows to this CSV")
    add_out(parser)
    options = parser.parse_args()
    check_out(parser, options.out)
    limit_cores(options.threads)
    rows = make_rows(options.folder, options.captures, options.rendered, options.alike)
    if options.rows is not None:
        rows.to_csv(options.rows, index=False)
    text = markdown(rows, options.held_out)
    print(text)
    write_out(options.out, text, {"rows": rows.to_dict("records")})


if __name__ == "__main__":
    main()
