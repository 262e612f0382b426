"""The visualize stage: recordings and still pictures of a scene, from the files of earlier stages."""

import re
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from tqdm.auto import tqdm

from toolkit.capture import Capture
from toolkit.errors import ArtifactError, DamagedError
from toolkit.figures.evaluation import SequencePair, draw_sequence, warn_of_older
from toolkit.figures.query_images import draw_localization, draw_worst, off_by
from toolkit.figures.style import rendered, save_figure, save_picture
from toolkit.figures.top_view import draw_scene
from toolkit.files import RAW_DATA, pair_name, require_current, sidecar_path, write_sidecar
from toolkit.geometry import Floats
from toolkit.manifest import VisualizeSettings
from toolkit.pose.base import short_status
from toolkit.results.localized import LocalizedPair, support_of, sure_points
from toolkit.results.metrics import is_posed, named_as_meters, worst_first, worst_of_each
from toolkit.runs.pairs import PairRows, left_out
from toolkit.viewer.queries import record_localizations
from toolkit.viewer.sessions import record_session, session_tracks

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WORST = 10
"""Queries on the sheet of the worst queries of all pairs."""
MAX_FRAMES = 1000
"""Images of a session's recording, at most, unless the setting `every` is given."""


def visualize_scene(
    sessions_root: str | Path,
    poses_dir: str | Path,
    map_dir: str | Path,
    out_dir: str | Path,
    settings: VisualizeSettings | Mapping[str, Any] | None = None,
    *,
    map_device: str = "all",
    query_device: str = "all",
    queries: str = "keyframes_pruned_subsampled",
    pairs: Sequence[Sequence[str]] | None = None,
) -> pd.DataFrame:
    """Draw every pair of a scene, and record every pair and session for the rerun viewer.

    Writes `<pair>.png`, the map from above; `<pair>_sequence.png`, the query recordings, if there are poses of
    sequences; `localization_<pair>_<k>.png`, a query beside its references; `worst_<scene>.png`, the worst queries of
    all pairs; `<pair>.rrd`, the queries of a pair in their map; and `<scene>_<session>.rrd`, the recording of a
    session.

    Args:
        sessions_root: folder `sessions` of the capture.
        poses_dir: folder of the poses: `<pair>.txt`, `<pair>.csv`, and `<pair>.h5` with the correspondences.
        map_dir: folder of the triangulated maps; a device without one is drawn without points.
        out_dir: output folder.
        settings: see `VisualizeSettings`; a dict holds the settings that differ from the defaults. A query session
            without ground truth shows its cameras at their estimated poses.
        map_device: `all` or one device key; likewise `query_device`.
        queries: keyframe list of the queries, which the setting `keyframes_only` shows.
        pairs: only these [map device, query device]; None: all.

    Returns:
        One row per pair: map_device, query_device, queries, localized, seconds, still, recording, reason. A pair
        that cannot be drawn has zeros and the `reason`.

    Raises:
        ArtifactError: there are no poses of the pairs.
    """
    settings = VisualizeSettings.of(settings)
    capture, out = Capture.from_sessions_root(sessions_root), Path(out_dir)
    chosen = [
        (m, q)
        for m, q in product(capture.devices_with("map", map_device), capture.devices_with("query", query_device))
        if (pairs is None or [m, q] in map(list, pairs))
        and (_poses(capture, poses_dir, m, q).is_file() or left_out(poses_dir, pair_name(capture.name, m, q)))
    ]
    if not chosen:
        raise ArtifactError(f"{poses_dir}: no poses of {capture.name} for the chosen devices. Localize them first.")
    table, worst, sources = PairRows(capture.name, out, Path(poses_dir)), [], list[Path]()
    sheet = out / f"worst_{capture.name}.png"
    for path in (sheet, sidecar_path(sheet)):
        path.unlink(missing_ok=True)
    warn_of_older(poses_dir)
    for m, q in tqdm(chosen, desc="visualize", unit="pair"):
        name = pair_name(capture.name, m, q)
        _remove_images(out, name)  # those of an earlier run would look like results of this one
        with table.row(m, q) as row:
            table.check_upstream()
            of_pair = _poses(capture, poses_dir, m, q)
            require_current(of_pair, "localize", (".npz", ".txt", RAW_DATA), missing=False)
            pair = LocalizedPair.open(capture, m, q, poses_dir, map_dir)
            sequences = SequencePair.find(poses_dir, capture.name, m, q)
            try:
                worst.append(_draw_pair(capture, pair, sequences, out, settings))
            except DamagedError as error:
                raise ArtifactError(str(error)) from None  # the localize stage can make the file again, this one cannot
            row |= {
                "queries": len(pair.results.table),
                "localized": int(is_posed(pair.results.poses).sum()),
                "still": str(out / f"{pair.name}.png"),
                "recording": str(out / f"{pair.name}.rrd") if settings.recordings else "",
            }
            made_from = [of_pair, of_pair.with_suffix(".csv"), *([] if sequences is None else [sequences.path])]
            sources += made_from
            write_sidecar(out / f"{name}.png", settings.model_dump(), _images(out, name)[1:], made_from=made_from)
        if row["reason"]:
            _remove_images(out, name)
    frame = table.frame()
    present = [(row["map_device"], row["query_device"]) for row in table.rows if not row["reason"]]
    _draw_worst(sheet, capture.name, pd.concat(worst, ignore_index=True))
    write_sidecar(sheet, settings.model_dump(), made_from=sources)
    for device, split in dict.fromkeys((*((m, "map") for m, _ in present), *((q, "query") for _, q in present))):
        recording, poses = out / f"{capture.name}_{device}_{split}.rrd", None
        recording.unlink(missing_ok=True)
        if not settings.session_recordings:
            continue
        session = capture[f"{device}_{split}"]
        listed = settings.keyframes_only and split == "query"
        images = sum(map(len, session.rows_of_keyframes(session.keyframes(queries)))) if listed else len(session.images)
        if split == "query" and session.ground_truth is None:
            # Without ground truth, poses in the device's own map are the most accurate ones.
            localized_in = [m for m, q in present if q == device]
            poses = _poses(capture, poses_dir, device if device in localized_in else localized_in[0], device)
        record_session(
            *(capture.path, split, device),
            keyframes_only=listed,
            every=settings.every or 1 + images // MAX_FRAMES,
            vis_retrieve_queries=poses is not None,
            queries_pose=poses,
            out=recording,
            map_dir=map_dir,
            queries=queries,
            world_up=settings.world_up,
            progress=False,
        )
    return frame


def sample_pictures(out_dir: str | Path, name: str) -> list[Path]:
    """Return the pictures of single queries of the pair `name`, `localization_<name>_<k>.png`, in order of k."""
    pattern = re.compile(rf"localization_{re.escape(name)}_(\d+)\.png")
    found = {
        int(match[1]): path for path in Path(out_dir).glob("localization_*") if (match := pattern.fullmatch(path.name))
    }
    return [found[k] for k in sorted(found)]


def _remove_images(out: Path, name: str) -> None:
    for path in (*_images(out, name), sidecar_path(out / f"{name}.png")):
        path.unlink(missing_ok=True)


def _images(out: Path, name: str) -> list[Path]:
    """Return the existing figures and the recording of a pair, `<name>.png` first."""
    paths = [*(out / f"{name}{end}" for end in (".png", "_sequence.png", ".rrd")), *sample_pictures(out, name)]
    return [path for path in paths if path.exists()]


def _draw_pair(
    capture: Capture, pair: LocalizedPair, sequences: SequencePair | None, out: Path, settings: VisualizeSettings
) -> pd.DataFrame:
    """Draw and record a pair; return its worst queries as rows of `Localizations.errors` with their details."""
    m, q = pair.map_session.device, pair.query_session.device
    shown, cloud, map_poses = pair.localizations, sure_points(pair.local_map), pair.map_session.world_from_cam()
    details_of = lru_cache(2 * WORST)(pair.details)  # the worst queries are needed for the sheet and the recording
    order, tracks = worst_first(shown.errors).tolist(), dict[str, list[Floats]]()
    if sequences is not None:
        tracks = {"odometry": sequences.odometry_tracks(pair.query_session), "frames": sequences.tracks()}

    def figures() -> "Iterator[tuple[Figure, Path]]":
        yield draw_scene(
            *(*cloud, map_poses, shown.estimated, shown.true),
            up=settings.world_up,
            title=f"{q} queries in the {m} map, seen from above",
            map_tracks=session_tracks(pair.map_session),
            query_tracks=session_tracks(pair.query_session),
            unit=shown.unit,
        ), out / f"{pair.name}.png"  # fmt: skip
        chosen = np.unique(np.linspace(0, len(order) - 1, min(settings.samples, len(order))).round().astype(int))
        for number, k in enumerate((order[rank] for rank in chosen), start=1):
            title = f"{q} query in the {m} map: {short_status(shown.errors['status_text'].iloc[k])}"
            yield draw_localization(details_of(k), title, shown.unit), out / f"localization_{pair.name}_{number}.png"
        if sequences is not None:
            sequence = draw_sequence(capture, sequences, m, q, settings.world_up, shown.unit)
            yield sequence, out / f"{pair.name}_sequence.png"

    with ThreadPoolExecutor(1) as encoder:  # encodes pictures while others are drawn and recorded
        saved = [encoder.submit(save_picture, rendered(one), path, one.get_suptitle()) for one, path in figures()]
        if settings.recordings:
            details = ((k, details_of(k)) for k in sorted(order[: settings.matched_queries]))
            where = (out / f"{pair.name}.rrd", pair.name, map_poses, *cloud)
            record_localizations(*where, shown, details, up=settings.world_up, tracks=tracks)
        for picture in saved:
            picture.result()
    worst = order[:WORST]
    more = {"unit": shown.unit[0], "pair": f"{q} in the {m} map", "details": [details_of(k) for k in worst]}
    return shown.errors.iloc[worst].assign(**more)


def _poses(capture: Capture, poses_dir: str | Path, map_device: str, query_device: str) -> Path:
    return Path(poses_dir) / f"{pair_name(capture.name, map_device, query_device)}.txt"


def _draw_worst(path: Path, scene: str, candidates: pd.DataFrame) -> None:
    """Draw the worst queries of all pairs; `candidates` are the rows of `_draw_pair`."""
    shown = []
    for _, row in named_as_meters(candidates.iloc[worst_of_each(candidates, WORST)]).iterrows():
        reason = [short_status(row["status_text"])]
        if row["details"].has_matches and pd.notna(row.get("num_matches")):
            reason.append(f"{row['num_matches']:.0f} matches")
        reason += filter(None, [support_of(row)])
        errors = row["rotation_error_deg"], row["translation_error_m"]
        off = f"{off_by(*errors, row['unit'])}; " if np.isfinite(errors[1]) else ""
        shown.append((f"{row['pair']}: {off}{', '.join(reason)}", row["details"]))
    title = f"{scene}: the {len(shown)} worst queries, each in the map in which it went worst"
    save_figure(draw_worst(shown, title), path, title)
