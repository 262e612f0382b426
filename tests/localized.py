"""What the localize stage leaves of a pair, written by hand: poses, the table of queries, and correspondences."""

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from toolkit.capture import Capture, Session, Trajectory
from toolkit.files import pair_name
from toolkit.pose.base import Correspondences, QueryResult, Rival, Status
from toolkit.results.pair import MAPS, PairResults, query_group
from toolkit.store.hdf5 import write_groups


def stored(
    images: Sequence[str] = (),
    references: Sequence[str] = (),
    rejected: Sequence[str] = (),
    correspondences: Correspondences | None = None,
    rivals: Sequence[Rival] = (),
) -> QueryResult:
    """Return what the file of correspondences holds of a query."""
    names = {"images": tuple(images), "references": tuple(references), "rejected": tuple(rejected)}
    return QueryResult(Status.OK, correspondences=correspondences or Correspondences(), rivals=tuple(rivals), **names)


def read_queries(path: Path) -> Callable[[int, str], QueryResult]:
    """Return a function that reads what the file of correspondences holds of a query, by timestamp and device id."""
    stored = PairResults(path, pd.DataFrame()).stored
    return lambda timestamp, device_id: stored({"timestamp": timestamp, "device_id": device_id, "status": "failed"})


def write_queries(path: Path, queries: Mapping[tuple[int, str], QueryResult], maps: Sequence[str] = ()) -> None:
    """Write the correspondences of a pair."""
    groups = ((query_group(*key), query.arrays()) for key, query in queries.items())
    write_groups(path, groups, {MAPS: json.dumps(list(maps))})


def instants(session: Session) -> pd.DataFrame:
    """Return what a session's devices photographed when: columns timestamp and device_id."""
    keys = pd.DataFrame({"timestamp": session.images["timestamp"], "device_id": session.device_ids.astype(str)})
    return keys.drop_duplicates().sort_values("timestamp", kind="stable").reset_index(drop=True)


def write_pair(
    capture: Capture,
    folder: Path,
    map_device: str,
    query_device: str,
    queries: Sequence[QueryResult],
    maps: Sequence[str] = (),
    **columns: Sequence[object],
) -> Path:
    """Write poses (the true ones, off by the column `off_m`), table and correspondences of the first queries."""
    session, stem = capture[f"{query_device}_query"], folder / pair_name(capture.name, map_device, query_device)
    keys = instants(session)[: len(queries)].reset_index(drop=True)
    table = keys.assign(**{"status": "ok", "method": "pnp", "num_inliers": 10, "off_m": 0.0, **columns})
    poses = session.trajectory if session.ground_truth is None else session.ground_truth
    posed = ~table["status"].str.startswith("failed").to_numpy(bool)
    world_from_rig = poses.lookup(keys["timestamp"], keys["device_id"]) if poses is not None else np.eye(4)[None]
    world_from_rig = np.broadcast_to(world_from_rig, (len(keys), 4, 4)).copy()
    world_from_rig[:, 0, 3] += table["off_m"]
    times, devices = keys["timestamp"].to_numpy()[posed], keys["device_id"].to_numpy(str)[posed]
    Trajectory.from_poses(times, devices, world_from_rig[posed]).write(f"{stem}.txt")
    pd.DataFrame(table).to_csv(f"{stem}.csv", index=False)
    keys_of = zip(keys["timestamp"].tolist(), keys["device_id"].astype(str).tolist(), strict=True)
    write_queries(Path(f"{stem}.h5"), dict(zip(keys_of, queries, strict=True)), maps)
    return stem


def some_correspondences(
    cameras: Sequence[int], inliers: Sequence[bool], references: int = 2, point_index: int | None = None
) -> Correspondences:
    """Return correspondences of given images, each seen by the references whose number divides it."""
    count, rng = len(cameras), np.random.default_rng(0)
    views = np.array([(k, r) for k in range(count) for r in range(references) if k % (r + 1) == 0], int).reshape(-1, 2)
    return Correspondences(
        camera=np.array(cameras, np.int64),
        pixels=np.round(rng.uniform(20, 100, (count, 2))),
        points=rng.normal(size=(count, 3)),
        point_index=np.arange(count) if point_index is None else np.full(count, point_index),
        agrees=np.array(inliers, bool),
        found_by=np.array(["sift/descriptors" if point_index is None else "sift/lifted"] * count, np.str_),
        view_of=views[:, 0],
        view_reference=views[:, 1],
        view_pixels=np.round(rng.uniform(20, 100, (len(views), 2))),
    )
