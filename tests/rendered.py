"""A rendered capture, localized by a predictor that knows the truth and blurs it."""

import json
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from tests.calls import call
from tests.queries import likeness, session_query
from toolkit.capture import Capture, Session
from toolkit.files import SceneFiles, link_or_copy
from toolkit.localize import localize_pairs
from toolkit.manifest import PredictorSettings
from toolkit.mapping.local_map import LocalMap
from toolkit.pose.base import QueryInput
from toolkit.prediction.feed_forward import FeedForwardLocalizer
from toolkit.prediction.network import SimulatedPredictor
from toolkit.runs.folder import LOG

Floats = NDArray[np.float64]
LIST = "keyframes_original"
LOW = {"rotation_noise_deg": 0.2, "position_noise_m": 0.01, "depth_noise": 0.02}


class World:
    """A rendered capture with a triangulated phone map, and its queries."""

    def __init__(self, capture: Path, files: SceneFiles) -> None:
        self.files = files
        self.capture = Capture.open(capture)
        self.sessions = [self.capture[name] for name in self.capture.session_ids]
        self.map_session = self.capture["ios_map"]
        self.map = LocalMap.load(files.maps / "ios_map.npz")

    def predictor(self, depth: bool = True, **noise: float) -> SimulatedPredictor:
        return SimulatedPredictor(self.sessions, self.files.maps if depth else None, **noise)  # type: ignore[arg-type]

    def localizer(self, predictor: object, **settings: int) -> FeedForwardLocalizer:
        return FeedForwardLocalizer(self.map, self.map_session, predictor, PredictorSettings(**settings))  # type: ignore[arg-type]

    def queries(self, device: str, count: int = 10) -> tuple[list[QueryInput], Floats]:
        """Return the queries of a device with the map images that stand and look most alike, and their true poses."""
        session = self.capture[f"{device}_query"]
        keyframes = session.keyframes(LIST)
        queries = [session_query(session, rows, self.map, count) for rows in session.rows_of_keyframes(keyframes)]
        return queries, session.ground_truth.lookup(keyframes["timestamp"], keyframes["device_id"])


def copy_shared(folder: Path, to: Path) -> Path:
    """Copy a folder that other tests may be using at this moment, without the locks that come and go."""
    return Path(shutil.copytree(folder, to, ignore=shutil.ignore_patterns("*.lock")))


def copy_linked(run: Path, to: Path) -> Path:
    """Copy a run by hard links, so that nothing done there is done here; a log grows in place, so it is a copy."""
    shutil.copytree(run, to, copy_function=link_or_copy)
    (to / LOG).unlink(missing_ok=True)
    if (run / LOG).exists():
        shutil.copy(run / LOG, to / LOG)
    return to


def run_stage(
    capture: Path, files: SceneFiles, predictor: Mapping[str, object] | None = None, **more: object
) -> pd.DataFrame:
    """Localize; `predictor` holds what differs from a simulation with the default settings."""
    settings = {"method": "feed_forward", "predictor": {"name": "simulated"} | dict(predictor or {})}
    options = {"map_device": "ios", "queries": LIST, "workers": 1} | settings | more
    folders = (files.retrieval_dir, files.poses_dir, files.features, files.maps)
    return call(localize_pairs, capture / "sessions", *folders, **options)  # type: ignore[arg-type]


def prepared(folder: Path, capture: Path, features: Path, devices: Sequence[str]) -> SceneFiles:
    """Return the files of a run with features, and with references of these devices' queries in the phone's map."""
    files, sessions = SceneFiles(folder, capture.name), Capture.open(capture)
    copy_shared(features, files.features)
    for device in devices:
        write_retrieval(files.retrieval("ios", device), sessions["ios_map"], sessions[f"{device}_query"])
    return files


def localized_by_pnp(folder: Path, capture: Path, features: Path, device: str) -> None:
    """Localize a device in the phone's map, with default settings."""
    files = prepared(folder, capture, features, [device])
    folders = (files.retrieval_dir, files.poses_dir, files.features, files.maps)
    devices = {"map_device": "ios", "query_device": device}
    localize_pairs(capture / "sessions", *folders, queries=LIST, workers=1, **devices)


def write_retrieval(path: Path, mapped: Session, session: Session) -> None:
    """Write what the retrieve stage would: for each query image the map images that stand and look most alike."""
    lines = []
    for row, pose in enumerate(session.world_from_cam(ground_truth=True)):
        score = likeness(mapped.world_from_cam(), pose)
        topk = [
            {"path": f"SMALL/sessions/{mapped.image_name(int(k))}", "score": float(score[k])}
            for k in np.argsort(-score, kind="stable")[:10]
        ]
        image = session.images.iloc[row]
        lines.append({"timestamp": str(image["timestamp"]), "sensor_id": image["sensor_id"], "topk": topk})
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
