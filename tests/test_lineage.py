"""Artifacts that belong together: what is older than what it was made from is made again, or withheld and named."""

import io
import json
import logging
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tests.rendered import copy_linked
from tests.unattended import no_kernels
from toolkit import notebook, pipeline
from toolkit.errors import COMMAND, ArtifactError, ManifestError
from toolkit.evaluate import evaluate_scene
from toolkit.exchange.export import export_colmap, export_matches, export_pairs, export_poses, geo_table
from toolkit.exchange.submission import collect
from toolkit.figures.retrieval import RetrievedPair
from toolkit.files import (
    SceneFiles,
    changed_sources,
    file_fingerprint,
    fingerprint,
    older_files,
    read_json,
    read_sidecar,
    require_current,
    sidecar_path,
    why_older,
    write_sidecar,
)
from toolkit.report.comparison import compare_runs
from toolkit.report.page import write_report
from toolkit.scene.map import Map
from toolkit.scene.run import InspectedPair, Run
from toolkit.store.items import Items
from toolkit.visualize import visualize_scene


@pytest.fixture
def made(tmp_path: Path) -> tuple[Path, Path, Path]:
    """Poses, made from references, and an evaluation, made from both."""
    names = "retrieval/a.jsonl", "poses/a.txt", "evaluation/e.csv"
    references, poses, evaluation = (tmp_path / name for name in names)
    for path, sources in ((references, []), (poses, [references]), (evaluation, [poses, references])):
        path.parent.mkdir()
        path.write_text(path.name)
        write_sidecar(path, {}, made_from=sources)
    return references, poses, evaluation


def test_what_nothing_has_changed_is_current(made: tuple[Path, Path, Path], tmp_path: Path) -> None:
    references, poses, evaluation = made
    assert [changed_sources(path) for path in made] == [[], [], []]
    references.touch()  # the content counts, not the time
    write_sidecar(references, {"made": "again, the same"})
    assert not why_older(poses, "localize")
    require_current(evaluation, "evaluate")
    shutil.copytree(tmp_path, tmp_path.parent / f"{tmp_path.name}-moved")
    moved = tmp_path.parent / f"{tmp_path.name}-moved" / "poses" / "a.txt"
    (moved.parents[1] / "retrieval" / "a.jsonl").write_text("other")
    assert changed_sources(moved) == [moved.parents[1] / "retrieval" / "a.jsonl"]
    assert not changed_sources(poses), "a moved run refers to its own files"


def test_what_is_older_is_named_with_what_to_do(made: tuple[Path, Path, Path]) -> None:
    references, poses, evaluation = made
    references.write_text("other references")
    write_sidecar(references, {})
    assert changed_sources(poses) == [references]
    assert why_older(poses, "localize") == "a.txt is of an older retrieval/a.jsonl: run the localize stage again."
    with pytest.raises(ArtifactError):
        require_current(evaluation, "evaluate")
    assert not why_older(evaluation, "evaluate", (".txt",)), "of these sources, none has changed"
    assert set(older_files(evaluation.parent, "evaluate")) == {"e.csv"}


def test_the_time_that_queries_took_is_no_change(tmp_path: Path) -> None:
    table, evaluation = tmp_path / "poses.csv", tmp_path / "recall.csv"
    table.write_text("status,seconds,focal_px\nok,0.5,\n")
    evaluation.write_text("made")
    write_sidecar(evaluation, {}, made_from=[table])
    table.write_text("status,seconds,focal_px\nok,0.7,\n")
    assert not changed_sources(evaluation)
    table.write_text("status,seconds,focal_px\nlow_confidence,0.5,\n")
    assert changed_sources(evaluation) == [table]


def test_a_missing_source_is_told_from_a_changed_one(made: tuple[Path, Path, Path]) -> None:
    references, poses, evaluation = made
    references.unlink()
    assert "which is missing now" in why_older(poses, "localize")
    assert not why_older(poses, "localize", missing=False)
    assert not older_files(poses.parent, "localize"), "poses outlive their references"
    assert older_files(evaluation.parent, "evaluate")


def test_files_of_the_capture_count_where_they_are(made: tuple[Path, Path, Path], tmp_path: Path) -> None:
    poses, cameras = made[1], tmp_path / "capture" / "ios_query" / "sensors.txt"
    cameras.parent.mkdir(parents=True)
    cameras.write_text("cameras")
    write_sidecar(poses, {}, made_from=[made[0]], captured=[cameras])
    moved = tmp_path.parent / f"{tmp_path.name}-moved"
    shutil.copytree(tmp_path / "poses", moved / "elsewhere" / "poses")
    assert not changed_sources(poses)
    cameras.write_text("other cameras")
    assert "is of an older ios_query/sensors.txt" in why_older(poses, "localize")
    assert changed_sources(moved / "elsewhere" / "poses" / poses.name)[-1:] == [cameras], "a run moves alone"
    assert not why_older(poses, "localize", ["/ios_map/sensors.txt"])
    cameras.unlink()
    assert not changed_sources(poses)


def test_the_folder_of_the_images_stands_for_the_listed_images_and_their_masks(tmp_path: Path) -> None:
    session, poses, images = tmp_path / "capture" / "ios_query", tmp_path / "a.txt", tmp_path / "photographs"
    images.mkdir()
    session.mkdir(parents=True)
    (session / "raw_data").symlink_to(images)
    (session / "images.txt").write_text("# timestamp, sensor_id, image_path\n1, cam, a, b.jpg\n2, cam, gone.jpg\n")
    (images / "a, b.jpg").write_text("image")
    poses.write_text("poses")
    write_sidecar(poses, {}, captured=[session / "raw_data"])
    (images / "thumbnail.jpg").write_text("not listed")
    assert not changed_sources(poses)
    (images / "a, b.jpg").write_text("another image")
    assert why_older(poses, "localize") == "a.txt is of an older ios_query/raw_data: run the localize stage again."
    write_sidecar(poses, {}, captured=[session / "raw_data"])
    (session / "masks").mkdir()
    (session / "masks" / "a, b.jpg.png").write_text("mask")
    assert changed_sources(poses)
    write_sidecar(poses, {}, captured=[session / "raw_data"])
    with open(session / "images.txt", "a") as listed:
        listed.write("3, cut short\n")
    assert changed_sources(poses), "a damaged list is no error here"
    (images / "a, b.jpg").unlink()
    assert not changed_sources(poses), "results are read where their images are not"


def test_a_file_of_another_tool_has_no_sources(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("a")
    assert not changed_sources(tmp_path / "a.txt")
    (tmp_path / "a.txt.meta.json").write_text(json.dumps({"made_from": ["no", "mapping"]}))
    assert not changed_sources(tmp_path / "a.txt")


# Every pair of artifacts that a reader combines: the one made older, the reader, and what it then says.


def quiet(*_: object, **__: object) -> None:
    pass


def evaluated(files: SceneFiles, capture: Path) -> str:
    evaluation = evaluate_scene(capture / "sessions", files.poses_dir, files.retrieval_dir, None, map_dir=files.maps)
    states = [*evaluation.retrieval["state"], *evaluation.overlap["state"]]
    return "\n".join([*evaluation.messages, *map(str, states)])


def visualized(files: SceneFiles, capture: Path) -> str:
    chosen = {"samples": 0, "recordings": False, "session_recordings": False}
    folders = files.poses_dir, files.maps, files.run / "pictures"
    table = visualize_scene(capture / "sessions", *folders, chosen, map_device="ios")
    return "\n".join(table["reason"])


def reported(files: SceneFiles, capture: Path) -> str:
    return write_report(files.run).read_text()


def compared(files: SceneFiles, capture: Path) -> str:
    return str(compare_runs([files.run, files.run]))


def inspected_again(files: SceneFiles, capture: Path) -> str:
    return str(InspectedPair("ios", "hl", files.poses_dir).look().result.what_if())


def looked_at(files: SceneFiles, capture: Path) -> str:
    told = io.StringIO()
    logging.getLogger("toolkit").addHandler(handler := logging.StreamHandler(told))
    try:
        InspectedPair("ios", "hl", files.poses_dir).look()
    finally:
        logging.getLogger("toolkit").removeHandler(handler)
    return told.getvalue()


def inspected(files: SceneFiles, capture: Path) -> str:
    return "" if InspectedPair("ios", "hl", files.poses_dir).look().retrieved else "run the localize stage again"


def opened(files: SceneFiles, capture: Path) -> str:
    return str(Map.open(files.run, files.scene, "ios"))


def retrieved(files: SceneFiles, capture: Path) -> str:
    return str(RetrievedPair(capture / "sessions", files.retrieval("ios", "hl"), files.embeddings))


def submitted(files: SceneFiles, capture: Path) -> str:
    poses = files.poses_txt("ios", "hl")
    lines = poses.read_text().splitlines(keepends=True)
    poses.unlink()  # a link to the finished run
    poses.write_text("".join(lines[:-1]))  # a query without a pose
    return collect([files.run], "Ours.", captures=[capture]).text()


def exported_map(files: SceneFiles, capture: Path) -> str:
    return str(export_colmap(files.run, files.scene, "ios", files.run / "model", capture))


def exported_pairs(files: SceneFiles, capture: Path) -> str:
    return str(export_pairs(files.run, files.scene, "ios", "hl", files.run / "pairs.txt"))


def exported_poses(files: SceneFiles, capture: Path) -> str:
    return str(export_poses(files.run, files.scene, "ios", "hl", files.run / "hloc.txt", capture))


def exported_matches(files: SceneFiles, capture: Path) -> str:
    return str(export_matches(files.run, files.scene, "ios_map", "ios_map", files.run / "hloc.h5", capture=capture))


def exported_geo(files: SceneFiles, capture: Path) -> str:
    return str(geo_table(files.run, capture))


def linked_report(files: SceneFiles, capture: Path) -> str:
    return str(Run.open(files.run).report())


POSES, TABLE, REFERENCES, MAP, VECTORS = "poses txt", "poses csv", "references", "map", "vectors"
FEATURES, RECORD = "features", "run.json"
CAMERAS, MAP_POSES, TRUTH = "cameras of queries", "poses of the map", "ground truth"
IMAGES, MAP_IMAGES = "images of queries", "images of the map"
CAPTURED = {
    IMAGES: "/hl_query/raw_data",
    MAP_IMAGES: "/ios_map/raw_data",
    CAMERAS: "/hl_query/sensors.txt",
    MAP_POSES: "/ios_map/trajectories.txt",
    TRUTH: "/hl_query/proc/alignment_trajectories.txt",
}
READERS = [
    (POSES, reported, "Not shown: recall.csv is of an older poses/"),
    (TABLE, reported, "Not shown: recall.csv is of an older poses/"),
    (POSES, reported, "pictures and recordings."),
    (REFERENCES, reported, "Not shown: recall.csv is of an older"),
    (VECTORS, reported, "run the retrieve stage again"),
    (POSES, compared, "run the evaluate stage again"),
    (REFERENCES, evaluated, "Retrieval is not judged."),
    (MAP, evaluated, "run the localize stage again"),
    (MAP, visualized, "run the localize stage again"),
    (REFERENCES, inspected, "run the localize stage again"),
    (REFERENCES, inspected_again, "run the localize stage again"),
    (MAP, inspected_again, "run the localize stage again"),
    (REFERENCES, opened, "run the localize stage again"),
    (MAP, opened, "run the localize stage again"),
    (VECTORS, retrieved, "run the retrieve stage again"),
    (REFERENCES, submitted, "run the localize stage again"),
    (MAP, exported_map, "run the localize stage again"),
    (VECTORS, exported_pairs, "run the retrieve stage again"),
    (REFERENCES, exported_poses, "run the localize stage again"),
    (MAP, exported_poses, "run the localize stage again"),
    (REFERENCES, exported_geo, "run the localize stage again"),
    (MAP, exported_geo, "run the localize stage again"),
    (FEATURES, opened, "of other images or features: run the localize stage again"),
    (FEATURES, inspected_again, "of other images or features: run the localize stage again"),
    (FEATURES, exported_map, "of other images or features: run the localize stage again"),
    (FEATURES, exported_matches, "of other images or features: run the localize stage again"),
    (TABLE, linked_report, "is of an older poses/"),
    (CAMERAS, reported, "is of an older hl_query/sensors.txt: run the localize stage again"),
    (CAMERAS, visualized, "run the localize stage again"),
    (CAMERAS, looked_at, "is of an older hl_query/sensors.txt: run the localize stage again"),
    (CAMERAS, inspected_again, "run the localize stage again"),
    (CAMERAS, exported_poses, "run the localize stage again"),
    (CAMERAS, exported_geo, "run the localize stage again"),
    (CAMERAS, submitted, "run the localize stage again"),
    (IMAGES, reported, "is of an older hl_query/raw_data: run the localize stage again"),
    (IMAGES, visualized, "run the localize stage again"),
    (IMAGES, looked_at, "is of an older hl_query/raw_data: run the localize stage again"),
    (IMAGES, inspected_again, "run the localize stage again"),
    (IMAGES, exported_poses, "run the localize stage again"),
    (IMAGES, exported_geo, "run the localize stage again"),
    (IMAGES, submitted, "run the localize stage again"),
    (MAP_IMAGES, opened, "is of an older ios_map/raw_data: run the localize stage again"),
    (CAMERAS, opened, "Map("),  # it has none of the queries' cameras
    (MAP_POSES, opened, "is of an older ios_map/trajectories.txt: run the localize stage again"),
    (TRUTH, reported, "Not shown: recall.csv is of an older proc/alignment_trajectories.txt"),
    (TRUTH, compared, "run the evaluate stage again"),
    (TRUTH, linked_report, "its recall.csv is of an older proc/alignment_trajectories.txt"),
    (RECORD, linked_report, f"Write it again: {COMMAND} report"),
]


def change(files: SceneFiles, what: str) -> None:
    """Replace an artifact by an equally good one of other content, as its stage does."""
    poses, references = files.poses_txt("ios", "hl"), files.retrieval("ios", "hl")
    if what == VECTORS:
        path = next(files.embeddings.glob("ios_map/*/*.npy"))
        vectors = np.load(path)
        path.unlink()  # a link to the finished run
        np.save(path, -vectors)
        write_sidecar(path, read_sidecar(path) or {"embedder": "other"})
        return
    if what == FEATURES:
        with Items(next((files.features / "ios_map").glob("sift-*"))) as items:
            first = next(iter(items))
            items.add(first, "another picture", items[first])
        return
    if what in CAPTURED:
        artifact, source = {TRUTH: files.evaluation / "recall.csv"}.get(what, poses), CAPTURED[what]
        record = read_json(path := sidecar_path(artifact))
        (name,) = (name for name in record["made_from"] if name.endswith(source))
        record["made_from"][name] = "as it was then"
        path.unlink()
        path.write_text(json.dumps(record | {"sources": fingerprint(record["made_from"])}))
        return
    if what == RECORD:
        record = files.run / "run.json"
        text = record.read_text()
        record.unlink()
        record.write_text(text.replace('"status": "done"', '"status": "running"'))
        return
    table = poses.with_suffix(".csv")
    path = {POSES: poses, TABLE: table, REFERENCES: references, MAP: files.maps / "ios_map.npz"}[what]
    content = path.read_bytes()
    if what == MAP:
        with np.load(path) as stored:
            arrays = dict(stored)
        path.unlink()
        np.savez_compressed(path, **arrays)
    else:
        lines = content.decode().splitlines(keepends=True)
        path.unlink()
        path.write_text("".join([*lines[:-2], *lines[:-3:-1]]))  # the last two in another order
    artifact = poses if what == TABLE else path
    others = [table, poses.with_suffix(".h5")] if artifact == poses else []
    write_sidecar(artifact, {"made": "again"}, others)


@pytest.fixture
def linked(small_run: Path, tmp_path: Path) -> SceneFiles:
    """The small run, by hard links."""
    return SceneFiles(copy_linked(small_run, tmp_path / small_run.name), "SMALL")


@pytest.mark.slow
@pytest.mark.parametrize(("what", "read", "said"), READERS, ids=[f"{r.__name__}-{what}" for what, r, _ in READERS])
def test_no_reader_combines_an_artifact_with_an_older_one(
    linked: SceneFiles, small_capture: Path, released_weights: None, what: str,
    read: Callable[[SceneFiles, Path], str], said: str,
) -> None:  # fmt: skip
    change(linked, what)
    try:
        text = read(linked, small_capture)
    except ArtifactError as error:
        text = str(error)
    assert said in text


@pytest.mark.slow
def test_a_copied_run_is_looked_at_with_its_own_references(linked: SceneFiles, released_weights: None) -> None:
    copied = SceneFiles(copy_linked(linked.run, linked.run.with_name("copied")), linked.scene)
    pair = InspectedPair("ios", "hl", copied.poses_dir)
    assert pair.retrieval.resolve() == copied.retrieval("ios", "hl").resolve(), "the record names that of the first run"


@pytest.mark.slow
def test_what_only_left_out_says_older_and_the_next_run_mends_it(linked: SceneFiles, small_capture: Path) -> None:
    manifest = linked.run.parent / f"{linked.run.name}.yaml"
    manifest.write_text(f"captures: ['{small_capture}']\noutput_root: .\n")
    common = ["visualize.samples=1", "visualize.recordings=false", "visualize.session_recordings=false"]
    nearest = [*common, "localize.method=nearest"]
    with no_kernels():
        pipeline.run(manifest, only="localize", overrides=nearest, say=quiet, in_place=True)
    rows = {row["stage"]: row for row in json.loads((linked.run / "run.json").read_text())["stages"]}
    assert {stage: row["status"] for stage, row in rows.items()} == {
        **dict.fromkeys(("explore", "embed", "retrieve"), "reused"), "localize": "done",
        **dict.fromkeys(("evaluate", "visualize"), "older"),
    }  # fmt: skip
    assert "run the evaluate stage again" in rows["evaluate"]["reason"]
    page = (linked.run / "report.html").read_text()
    assert "mean recall" not in page
    with no_kernels():
        pipeline.run(manifest, overrides=nearest, say=quiet, in_place=True)
    rows = {row["stage"]: row["status"] for row in json.loads((linked.run / "run.json").read_text())["stages"]}
    assert (rows["evaluate"], rows["visualize"]) == ("done", "done")
    assert "mean recall" in (linked.run / "report.html").read_text()


@pytest.mark.slow
@pytest.mark.parametrize("stage", ["embed", "localize"])
def test_a_forced_stage_warns_of_nothing_and_makes_the_same(
    linked: SceneFiles, small_capture: Path, stage: str
) -> None:
    manifest = linked.run.parent / f"{linked.run.name}.yaml"
    manifest.write_text(f"captures: ['{small_capture}']\noutput_root: .\n")
    (linked.run / "run.log").unlink()
    made = [*linked.embeddings.rglob("*.npy"), *linked.poses_dir.glob("*.txt")]
    before = {path: path.read_bytes() for path in made}
    assert len(before) >= 6 + 9
    pipeline.run(manifest, only=stage, force=True, say=quiet)
    warnings = [line for line in (linked.run / "run.log").read_text().splitlines() if " WARNING " in line]
    assert not [line for line in warnings if "auto is SIFT alone" not in line]  # true here, as tests hide the weights
    assert {path: path.read_bytes() for path in made} == before


@pytest.mark.slow
def test_a_run_with_other_settings_leaves_the_finished_one_as_it_is(linked: SceneFiles, small_capture: Path) -> None:
    manifest = linked.run.parent / f"{linked.run.name}.yaml"
    manifest.write_text(f"captures: ['{small_capture}']\noutput_root: .\n")
    before = {path: file_fingerprint(path) for path in linked.run.rglob("*") if path.is_file()}
    with no_kernels():
        run = pipeline.run(manifest, only="localize", overrides=["localize.method=nearest"], say=quiet)
    assert run.name == f"{linked.run.name}-method-nearest"
    assert {path: file_fingerprint(path) for path in linked.run.rglob("*") if path.is_file()} == before
    taken = SceneFiles(run, "SMALL")
    assert taken.retrieval("ios", "hl").samefile(linked.retrieval("ios", "hl"))
    assert "nearest" in taken.poses_csv("ios", "hl").read_text()


@pytest.mark.parametrize(
    ("stage", "name", "folder"),
    [("embed", "out_dir", "C/embeddings"), ("embed", "out_dir", "."), ("", "out_dir", "."),
     ("localize", "features_dir", "C/features"), ("localize", "map_dir", "C/map"),
     ("rerank", "features_dir", "C/features"), ("sequence", "out_dir", "C/poses")],
)  # fmt: skip
def test_what_a_notebook_by_hand_writes_does_not_go_into_a_run(
    tmp_path: Path, small_capture: Path, stage: str, name: str, folder: str
) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "run.json").write_text("{}")
    sessions, place = str(small_capture / "sessions"), str(tmp_path / "run" / folder)
    with pytest.raises(ManifestError, match=rf"{name}: .*changes only by its manifest"):
        notebook.start(stage, sessions_root=sessions, **{name: place}) if stage else notebook.own_folder(place, "own")
    assert not (tmp_path / "run" / "C").exists()
