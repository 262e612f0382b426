"""Which limits should decide that a pose is `ok`? Fitted on rendered captures where some queries go wrong.

    python benchmarks/confidence.py [--seeds 0 1 2] [--rooms 3] [--frames 6] [--rows ROWS.csv] [--out FILE.md]

For each seed a capture is rendered with a sparse map, and with the same doors, windows, shelves, cabinets and crates in
all rooms. Its queries are localized as they are, and darkened, blurred and half hidden; with references that see the
same, with one such among wrong ones, and with none (the place is not found: every pose is wrong). Each row says what
the localizer knows (inliers, support of the best rival, standard deviation of the position), and whether the pose was
wrong: beyond 5 degrees or 0.5 m. Limits are then compared by

    accepted  share of the queries whose pose they call ok,
    wrong     share of those that are wrong, with the upper end of its one-sided 95 % interval (Clopper, Pearson 1934).

The rule: of the limits whose upper end is at most 0.5 %, those that accept most; of equals, the strictest. It takes 598
accepted poses without a wrong one to show 0.5 %. Rows are kept in --rows after each map, and a further call adds seeds.
"""

import argparse
import itertools
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
LARGEST_SHARE_WRONG = 0.005
CONFIDENCE = 0.95
INLIERS = (12, 15, 20, 25, 30, 40, 50, 60)
RIVAL_SUPPORT = (0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
POSITION_STD_M = (0.02, 0.05, 0.1, 0.2, 0.5)
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
    from toolkit.features.features import SiftExtractor
    from toolkit.geometry import pose_error
    from toolkit.localizers.base import Query, References, View

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
                row = {"seed": seed, "session": session.id, "query": index, "images": how, "references": chosen}
                row |= {"status": found.status, "posed": found.world_from_rig is not None, "wrong": False}
                row |= {"rotation_error_deg": float("nan"), "translation_error_m": float("nan")}
                if found.world_from_rig is not None:
                    rotation_deg, distance_m = pose_error(found.world_from_rig, truth[index])
                    row["wrong"] = bool(rotation_deg > WRONG[0] or distance_m > WRONG[1])
                    row |= {"rotation_error_deg": float(rotation_deg), "translation_error_m": float(distance_m)}
                row |= {"inliers": found.num_inliers, "rival_support": found.rival_support}
                found_rows.append(row | {"position_std_m": found.position_std_m})
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


def judge(rows: pd.DataFrame, limits: tuple[float, float, float]) -> dict[str, float]:
    """Return what limits (least inliers, largest support of a rival, largest deviation) accept, and how wrong it is."""
    from scipy.stats import beta

    accepted = rows["posed"] & (rows["inliers"] >= limits[0]) & (rows["rival_support"] <= limits[1])
    accepted &= rows["position_std_m"] <= limits[2]  # False for NaN
    count, wrong = int(accepted.sum()), int((accepted & rows["wrong"]).sum())
    upper = float(beta.ppf(CONFIDENCE, wrong + 1, count - wrong)) if count > wrong else 1.0
    return {"accepted": count, "share": count / max(len(rows), 1), "wrong": wrong, "upper": upper}


def fit(rows: pd.DataFrame) -> tuple[float, float, float] | None:
    """Return the limits that the rule chooses; None where there are too few rows to show any."""
    allowed = []
    for limits in itertools.product(INLIERS, RIVAL_SUPPORT, POSITION_STD_M):
        judged = judge(rows, limits)
        if judged["upper"] <= LARGEST_SHARE_WRONG:
            allowed.append((judged["accepted"], limits[0], -limits[1], -limits[2], limits))
    return max(allowed)[-1] if allowed else None


def markdown(rows: pd.DataFrame) -> str:
    """Return what went wrong, what the present limits and others make of it, and what the rule chooses."""
    from toolkit.localizers.pnp import PnpSettings

    settings = PnpSettings()
    present = (float(settings.ok_inliers), settings.ok_rival_support, settings.ok_position_std_m)
    groups = rows.groupby(["images", "references"], sort=False)
    table = [
        [str(images), str(chosen), f"{len(part)}", f"{part['posed'].sum()}", f"{part['wrong'].sum()}",
         f"{(part['status'] == 'ok').sum()}", f"{((part['status'] == 'ok') & part['wrong']).sum()}"]
        for (images, chosen), part in groups
    ]  # fmt: skip
    header = ["images", "references", "queries", "posed", "wrong", "ok", "ok and wrong"]
    text = [f"{len(rows)} queries, seeds {', '.join(map(str, sorted(rows['seed'].unique())))}:", ""]
    text += [markdown_table(header, table), ""]
    varied = [present]
    for axis, values in enumerate((INLIERS, RIVAL_SUPPORT, POSITION_STD_M)):
        varied += [(*present[:axis], value, *present[axis + 1 :]) for value in values if value != present[axis]]
    certain = rows[(rows["status"] == "ok") & ~rows["wrong"]]
    ratio = certain["translation_error_m"] / certain["position_std_m"]
    low, middle, high = ratio.quantile([0.25, 0.5, 0.9])
    text += [
        f"Position errors of right ok poses, in stated standard deviations: quartile {low:.2f}, median {middle:.2f}, "
        f"90 % below {high:.2f} (were they Gaussian and round: 0.64, 0.89, 1.44).",
        "",
    ]
    chosen = fit(rows)
    marked = [("present", present), *(("", limits) for limits in varied[1:])]
    marked += [("by the rule", chosen)] if chosen else []
    table = []
    for name, limits in marked:
        judged = judge(rows, limits)
        cells = [name, f"{limits[0]:g}", f"{limits[1]:g}", f"{limits[2]:g}", f"{100 * judged['share']:.1f} %"]
        table.append([*cells, f"{judged['wrong']:.0f} of {judged['accepted']:.0f}", f"{100 * judged['upper']:.2f} %"])
    text += [markdown_table(["limits", "inliers", "rival", "std m", "accepted", "wrong", "at most"], table)]
    if chosen is None:
        text += ["", f"No limits are shown to be wrong at most {100 * LARGEST_SHARE_WRONG:g} %: too few rows."]
    return "\n".join(text) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
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
    text = markdown(rows)
    print(text)
    write_out(options.out, text, {"rows": rows.to_dict("records")})


if __name__ == "__main__":
    main()
