"""Every door to a pose gives the same pose: a run, the notebook by hand, one image at a time, and inspection."""

import json
import shutil
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import nbformat
import numpy as np
import pandas as pd
import pytest

from tests.rendered import copy_linked, copy_shared
from tests.unattended import no_kernels, run_cells
from toolkit import notebook, pipeline
from toolkit.capture import Capture
from toolkit.capture.session import IMPORT_RECORD
from toolkit.embed import embed_sessions
from toolkit.embedders import EMBEDDERS
from toolkit.files import SceneFiles, image_name, link_or_copy, map_record_path, read_map_record, read_references
from toolkit.geometry import qt_from_pose
from toolkit.localize import Map, localize_image, localize_pairs
from toolkit.models import da3
from toolkit.notebook import notebook_path
from toolkit.rerank import rerank_pairs
from toolkit.results.pair import PairResults
from toolkit.retrieve import retrieve_pairs
from toolkit.scene.run import InspectedPair, Run


def quiet(*_: object, **__: object) -> None:
    pass


# With made-up weights, small inputs prove as much.
NETWORK = {"name": "da3-small", "checkpoint": "$MADE/da3-small.safetensors", "num_references": 2}
SUPERPOINT = {
    "kinds": ["superpoint"], "checkpoint": "$MADE/superpoint.safetensors",
    "superpoint": {"max_long_side": 320, "max_keypoints": 512},
}  # fmt: skip
METHODS: dict[str, dict[str, Any]] = {
    "pnp": {"method": "pnp", "pnp": {"max_error_deg": 0.4}},
    "nearest": {"method": "nearest"},
    "feed_forward": {"method": "feed_forward", "predictor": "simulated"},
    "hybrid": {"method": "hybrid", "predictor": "simulated"},
    "aliked": {"method": "pnp", "features": {"kinds": ["aliked"]}, "matcher": {"name": "mutual"}},
    "aliked, lightglue": {"method": "pnp", "features": {"kinds": ["aliked"]}},
    "sift and aliked": {"method": "pnp", "features": {"kinds": ["sift", "aliked"]}},
    "sift, aliked where it is not sure": {
        "method": "pnp", "features": {"kinds": ["sift"], "escalation": ["aliked"]}, "pnp": {"ok_probability": 1.0},
    },
    "superpoint": {
        "method": "pnp", "features": SUPERPOINT, "matcher": {"name": "mutual"},
    },
    "superpoint, lightglue": {
        "method": "pnp", "features": SUPERPOINT, "matcher": {"checkpoint": "$MADE/lightglue.safetensors"},
    },
    "a network, feed_forward": {"method": "feed_forward", "predictor": NETWORK},
    "a network, hybrid": {"method": "hybrid", "predictor": NETWORK},
}  # fmt: skip
OF_A_RIG = ("pnp", "hybrid", "aliked", "superpoint", "a network, hybrid")
DOORS = [(name, "ios", ["ios", "spot"] if name in OF_A_RIG else ["ios"]) for name in METHODS]
"""Methods, map device and query devices; one run has all pairs of a method, because kernels take seconds to start."""
IN_OTHERS = (
    "nearest", "feed_forward", "hybrid", "aliked", "aliked, lightglue", "superpoint", "a network, hybrid",
    "sift, aliked where it is not sure",
)  # fmt: skip
"""Methods whose runs have no kernels, because what they compute is in runs that have: "a network, feed_forward" has the
size of images that users have, LightGlue gets the same features, and "sift and aliked" matches with it, too."""


@pytest.fixture
def made_weights(made_once: Callable[[str, Callable[[Path], object]], Path], monkeypatch: pytest.MonkeyPatch) -> None:
    """$MADE is a folder with random weights of SuperPoint, its LightGlue and Depth Anything 3 Small."""
    from safetensors.torch import save_file

    from tests.features import test_lightglue, test_superpoint
    from tests.golden import da3 as golden

    def make(folder: Path) -> None:
        states = {"superpoint": test_superpoint.random_state(), "lightglue": test_lightglue.random_state()}
        states["da3-small"] = golden.state(golden.shapes("da3-small"))
        for name, state in states.items():
            save_file({key: value.clone() for key, value in state.items()}, folder / f"{name}.safetensors")

    monkeypatch.setenv("MADE", str(made_once("weights", make)))


@pytest.fixture(scope="module")
def retrieved(small_run: Path, small_capture: Path, tmp_path_factory: pytest.TempPathFactory) -> SceneFiles:
    """The small run on a capture whose unit the import did not know, embedded and retrieved; do not write to it.

    Without poses: those of other pairs would be of an older map.
    """
    folder = tmp_path_factory.mktemp("doors")
    capture = Path(shutil.copytree(small_capture, folder / small_capture.name))
    for session in capture.glob("sessions/*"):
        (session / IMPORT_RECORD).parent.mkdir(exist_ok=True)
        (session / IMPORT_RECORD).write_text('{"unit": null}')
    files = SceneFiles(copy_linked(small_run, folder / small_run.name), capture.name)
    shutil.rmtree(files.poses_dir)
    manifest = folder / f"{small_run.name}.yaml"
    manifest.write_text(f"captures: ['{capture}']\noutput_root: .\n")
    with no_kernels():
        pipeline.run(manifest, only="embed,retrieve", say=quiet, in_place=True)
    return files


@pytest.fixture
def small_images_of_networks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Networks that predict poses get images of 126 pixels, also in a run without kernels."""
    monkeypatch.setattr(da3, "SIDE", 126)


def localize_by_hand(monkeypatch: pytest.MonkeyPatch, parameters: dict[str, Any]) -> None:
    """Execute the cells of the localize notebook, as in a kernel that no run has started."""
    with monkeypatch.context() as patch:
        variables: dict[str, Any] = {"display": quiet}
        patch.setattr("IPython.display.display", quiet)
        patch.setattr(notebook, "_user_names", lambda: variables)
        run_cells(nbformat.read(notebook_path("localize"), as_version=4), variables, parameters)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "map_device", "query_devices"), DOORS)
def test_every_door_gives_the_same_poses(
    retrieved: SceneFiles, tmp_path: Path, released_weights: None, monkeypatch: pytest.MonkeyPatch,
    request: pytest.FixtureRequest, name: str, map_device: str, query_devices: list[str],
) -> None:  # fmt: skip
    """A run, the notebook by hand, one image at a time and inspection, with a unit that the import did not know."""
    method = METHODS[name]
    if "aliked" in name:
        request.getfixturevalue("learned_weights")
    if "$MADE" in str(method):
        request.getfixturevalue("made_weights")
    if name == "a network, hybrid":
        request.getfixturevalue("small_images_of_networks")
    capture = retrieved.run.parent / retrieved.scene
    files = SceneFiles(copy_linked(retrieved.run, tmp_path / retrieved.run.name), retrieved.scene)
    manifest = tmp_path / f"{files.run.name}.yaml"
    pairs = json.dumps([[map_device, query_device] for query_device in query_devices])
    content = f"captures: ['{capture}']\noutput_root: .\npairs: {pairs}\n"
    manifest.write_text(f"{content}localize: {json.dumps(method)}\n")
    with no_kernels() if name in IN_OTHERS else nullcontext():
        pipeline.run(manifest, only="localize", say=quiet, in_place=True)
    run = Run.open(files.run)
    scene_map = run.map(map_device)
    for query_device in query_devices:
        path = files.poses_txt(map_device, query_device)
        record = map_record_path(files.poses_dir, files.scene, map_device)
        results, unit = PairResults.open(path), read_map_record(record)["unit"]
        written = results.trajectory
        assert len(results) == 2
        assert unit is None
        if "escalation" in str(method):
            assert results.table["first_status"].notna().any(), "features that were asked for second"
        # by hand
        nested = {key: value for key, value in method.items() if isinstance(value, dict)}
        parameters = {key: value for key, value in method.items() if key not in nested} | {"settings": nested}
        parameters |= {"map_device": map_device, "query_device": query_device}
        folders = {key: str(tmp_path / key) for key in ("out_dir", "features_dir", "map_dir")}
        folders |= {"sessions_root": str(capture / "sessions"), "retrieval_dir": str(files.retrieval_dir)}
        localize_by_hand(monkeypatch, parameters | folders)
        assert (tmp_path / "out_dir" / path.name).read_bytes() == path.read_bytes()
        by_run, by_hand = (pd.read_csv(one / f"{path.stem}.csv") for one in (files.poses_dir, tmp_path / "out_dir"))
        pd.testing.assert_frame_equal(*(one.filter(regex="^(?!(first_)?seconds$)") for one in (by_run, by_hand)))
        assert read_map_record(map_record_path(tmp_path / "out_dir", files.scene, map_device))["unit"] == unit
        # one image, or the images of one rig, and inspection
        session = Capture.open(capture)[f"{query_device}_query"]
        assert scene_map.settings.unit == unit
        inspected = InspectedPair(map_device, query_device, files.poses_dir)
        for number, rows in enumerate(session.rows_of_keyframes(results.table)):
            one = results[number]
            if method.get("predictor") == "simulated":  # it predicts images of the capture only
                found = scene_map.locate(scene_map.query_of_session(session, rows))
            else:
                paths = [session.image_path(row) for row in rows.tolist()]
                found = localize_image(scene_map, paths, session.cameras(rows), session.rig_from_cam(rows))
            shown = inspected.look(number)
            assert shown.result.status_text == found.status_text == one.status_text
            assert shown.unit == results.unit
            again = shown.result.what_if().after.result
            if one.world_from_rig is None:
                assert found.world_from_rig is shown.result.world_from_rig is again.world_from_rig is None
                continue
            np.testing.assert_array_equal(shown.result.world_from_rig, one.world_from_rig)
            timestamp, device_id = results.table.loc[number, ["timestamp", "device_id"]]
            (in_file,) = written.qt[(written.timestamps == timestamp) & (written.device_ids == device_id)]
            for other in (found, again):  # as a file has it, to the last digit
                np.testing.assert_array_equal(qt_from_pose(other.world_from_rig), in_file)


# What finds the references


Change = dict[str, dict[str, Any]]
UPRIGHT = {"model": "thumbnail", "upright": True}
SEARCHES: dict[str, Change] = {
    "as by default": {},
    "reranked": {"rerank": {"topn": 6, "topk": 3}},
    "several descriptors": {"embed": {"model": ["thumbnail", "vlad"]}},
    "an index": {"retrieve": {"index": "IVF2,Flat", "index_candidates": 5, "nprobe": 1}},
    "radio": {"retrieve": {"mask": {"radio": True}}},
    "rough poses": {"retrieve": {"mask": {"poses": "rough.txt", "poses_distance": 2.0}}},
    "radio, reranked": {"retrieve": {"mask": {"radio": True}}, "rerank": {"topn": 6, "topk": 3}},
    "another up for the descriptors": {"embed": UPRIGHT | {"world_up": [1.0, 0.0, 0.0]}},
    "another up for the localization": {"embed": UPRIGHT, "localize": {"world_up": [1.0, 0.0, 0.0]}},
}
BY_ALIKED = {"topn": 6, "topk": 3, "features": ["aliked"], "matcher": "mutual", "world_up": [1.0, 0.0, 0.0]}
SEARCHES["another up for the reranking"] = {"rerank": BY_ALIKED}
TAKE_SECONDS = ("several descriptors", "radio, reranked", "another up for the reranking")
SEARCH_ROWS = [pytest.param(name, marks=[pytest.mark.slow] if name in TAKE_SECONDS else []) for name in SEARCHES]
PAIR, LIST = {"map_device": "spot", "query_device": "hl"}, "keyframes_original"


def found_by_stages(capture: Path, embedded: Path, folder: Path, change: Change) -> tuple[SceneFiles, Path]:
    """Embed, retrieve, perhaps rerank, and localize by the nearest image; the run, and the file of its references."""
    sessions, files = capture / "sessions", SceneFiles(folder, capture.name)
    copy_shared(embedded, files.root)
    embed_sessions(
        sessions, files.embeddings, change.get("embed"), device=[*PAIR.values()], features_dir=files.features
    )
    settings = {"topk": change.get("rerank", {}).get("topn", 3)} | change.get("retrieve", {})
    retrieve_pairs(sessions, files.embeddings, files.retrieval_dir, settings, queries=LIST, **PAIR)
    references = files.retrieval_dir
    if "rerank" in change:
        references = files.reranked_dir
        rerank_pairs(sessions, files.retrieval_dir, files.features, references, change["rerank"], **PAIR)
    method = {"method": "nearest"} | change.get("localize", {})
    localize_pairs(sessions, references, files.poses_dir, files.features, files.maps, method, queries=LIST, **PAIR)
    return files, references / files.retrieval("spot", "hl").name


def with_priors(capture: Path, folder: Path) -> Path:
    """Copy a capture; its queries have signals of half of the map, and rough poses at one end of it."""
    copy = folder / capture.name
    shutil.copytree(capture, copy, copy_function=link_or_copy)
    of_map, queries = (Capture.open(copy)[name] for name in ("spot_map", "hl_query"))
    for session in (of_map, queries):
        scans = dict[str, None]()
        for row, (time, sensor) in enumerate(session.images[["timestamp", "sensor_id"]].to_numpy()):
            heard = 2 * row // len(session) if session is of_map else 1
            scans[f"{time}, {sensor.partition('/')[0]}/wifi, 02:00:00:00:00:0{heard}, 2412000, -50\n"] = None
        (session.path / "wifi.txt").write_text("".join(scans))
    place = ", ".join(map(str, of_map.world_from_cam()[-1, :3, 3]))
    poses = (f"{time}, {device}, 1, 0, 0, 0, {place}\n" for time, device in queries.keyframes(LIST).to_numpy())
    (folder / "rough.txt").write_text("".join(poses))
    return copy


@pytest.mark.parametrize("name", SEARCH_ROWS)
def test_an_open_map_finds_for_a_query_what_the_stages_found(
    small_capture: Path, small_embedded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    request: pytest.FixtureRequest, caplog: pytest.LogCaptureFixture, name: str,
) -> None:  # fmt: skip
    """For images of a session: the same references, scores and poses, whatever the run searched with."""
    change = SEARCHES[name]
    if change.get("rerank") == BY_ALIKED:
        request.getfixturevalue("learned_weights")
    monkeypatch.setitem(EMBEDDERS, "thumbnail", "tests.embedders.test_fusion:Thumbnail")
    monkeypatch.chdir(tmp_path)
    has_priors = "mask" in change.get("retrieve", {})
    capture = with_priors(small_capture, tmp_path) if has_priors else small_capture
    files, references = found_by_stages(capture, small_embedded, tmp_path / "run", change)
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")  # the file of rough poses was named relative to the run's folder
    scene_map, session = Map.open(files.run, files.scene, "spot"), Capture.open(capture)["hl_query"]
    lines = {image_name(line["path"]): line["topk"] for line in read_references(references, "path")}
    results, limited = PairResults.open(files.poses_txt("spot", "hl")), False
    assert len(results) == len(results.trajectory.qt) == 3
    for number, rows in enumerate(session.rows_of_keyframes(results.table)):
        query = scene_map.query_of_session(session, rows)
        found = scene_map.retrieve(query)
        for image, (view, of_image) in enumerate(zip(query.views, found, strict=True)):
            assert found.names(image) == [image_name(one["path"]) for one in lines[view.name]]
            np.testing.assert_array_equal(of_image.scores, [one["score"] for one in lines[view.name]])
        result = scene_map.locate(query)
        np.testing.assert_array_equal(qt_from_pose(result.world_from_rig), results.trajectory.qt[number])
        assert result.references == results[number].references
        if has_priors:
            paths = [session.image_path(row) for row in rows.tolist()]
            outside = scene_map.retrieve(scene_map.query(paths, session.cameras(rows), session.rig_from_cam(rows)))
            limited |= any(outside.names(image) != found.names(image) for image in range(len(rows)))
    if not has_priors:
        return
    assert limited, "images from outside a session have no priors"
    assert sum("from outside a session" in one.getMessage() for one in caplog.records) == 1, "said once"
    monkeypatch.chdir(tmp_path)
    other = change | {"retrieve": change["retrieve"] | {"topk": 2}}
    if "rerank" not in change:  # a run with fewer references, and an open map that is asked for fewer
        _, references = found_by_stages(capture, small_embedded, tmp_path / "other", other)
        for line in read_references(references, "path"):
            row = session.row_of_name[image_name(line["path"])]
            (of_query,) = scene_map.retrieve(scene_map.query_of_session(session, np.array([row])), 2)
            np.testing.assert_array_equal(of_query.scores, [one["score"] for one in line["topk"]])
