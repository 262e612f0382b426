"""Submission: what is in the zip file, what is reported, and what is refused."""

import hashlib
import json
import zipfile
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

from toolkit.__main__ import app, main
from toolkit.capture import Trajectory, write_session
from toolkit.errors import ArtifactError, CaptureError, ManifestError, ToolkitError
from toolkit.exchange.export import export_intrinsics
from toolkit.exchange.submission import collect
from toolkit.files import SceneFiles, write_sidecar
from toolkit.geometry import make_pose, pose_from_qt

DEVICES = ("ios", "hl", "spot")
LIST = "keyframes_pruned_subsampled"
TIMES = (100, 200, 300)
RIG_FROM_CAM = make_pose(np.diag([1.0, -1.0, -1.0]), [0.1, 0.2, 0.3])


def device_of(device: str, time: int) -> str:
    return "s/phone" if device == "ios" else f"s/rig_{time}"


def pose_of(scene: str, device: str, time: int) -> np.ndarray:
    """A pose of 7 numbers that has no short decimal form."""
    digest = hashlib.sha256(f"{scene}{device}{time}".encode()).digest()
    qt = np.random.default_rng(list(digest)).normal(size=7)
    qt[:4] /= np.linalg.norm(qt[:4])
    return qt


def make_capture(root: Path, scene: str) -> Path:
    for device in DEVICES:
        for split in ("map", "query"):
            keys = pd.DataFrame({"timestamp": TIMES, "device_id": [device_of(device, time) for time in TIMES]})
            rigs = [(device_of(device, time), "s/phone", np.eye(4)) for time in TIMES] if device != "ios" else None
            write_session(
                root / scene / "sessions" / f"{device}_{split}",
                [("s/phone", "", "camera", "PINHOLE", 4, 4, 4, 4, 2, 2)],
                rigs,
                None,
                [(time, "s/phone", f"s/{time}.jpg") for time in TIMES],
                keyframes={"pruned_subsampled": keys.iloc[::-1]} if split == "query" else None,
            )
    return root / scene


def make_poses(run: Path, scene: str, mapped: str, query: str, times: tuple[int, ...] = TIMES) -> SceneFiles:
    """Write a pair of a run: poses at some times, the others failed, and references for all but time 100."""
    files = SceneFiles(run, scene)
    ids = [device_of(query, time) for time in times]
    qt = np.array([pose_of(scene, query, time) for time in times]).reshape(-1, 7)
    covariances = np.tile(np.eye(6), (len(times), 1, 1)) if len(times) else None
    Trajectory(times, ids, qt, covariances).write(files.poses_txt(mapped, query))
    posed = {time: "low_confidence: camera?" if time == 300 else "ok" for time in times}
    statuses = [posed.get(time, "failed: no match") for time in TIMES]
    pd.DataFrame(
        {"timestamp": TIMES, "device_id": [device_of(query, time) for time in TIMES], "status": statuses}
    ).to_csv(files.poses_csv(mapped, query), index=False)
    lines = []
    for time in TIMES:
        for score in (0.4, 0.9, 0.5):  # three cameras; the second has the best reference
            reference = make_pose(np.eye(3), [score, time, 0])
            row = {"timestamp": str(time), "device_id": device_of(query, time), "sensor_id": "s/phone"}
            image = {"path": "map/1.jpg", "score": score, "Tws": reference.tolist()}
            row |= {"Trs": RIG_FROM_CAM.tolist(), "topk": [image]}
            lines.append(row if time != 100 else row | {"topk": []})
    files.retrieval_dir.mkdir(exist_ok=True, parents=True)
    files.retrieval(mapped, query).write_text("".join(json.dumps(line) + "\n" for line in lines))
    return files


@pytest.fixture
def captures(tmp_path: Path) -> list[Path]:
    return [make_capture(tmp_path / "data", scene) for scene in ("HYDRO", "SUCCULENT")]


@pytest.fixture
def run(tmp_path: Path, captures: list[Path]) -> Path:
    """A run of both scenes and all pairs."""
    for capture in captures:
        for mapped in DEVICES:
            for query in DEVICES:
                make_poses(tmp_path / "run", capture.name, mapped, query)
    rows = [{"scene": c.name, "parameters": {"sessions_root": str(c / "sessions")}} for c in captures]
    (tmp_path / "run" / "run.json").write_text(json.dumps({"stages": rows}))
    return tmp_path / "run"


def poses_in(path: Path, name: str, tmp_path: Path) -> Trajectory:
    with zipfile.ZipFile(path) as archive:
        return Trajectory.read(archive.extract(name, tmp_path / "unzipped"))


def test_the_zip_has_the_names_that_the_combine_script_gives(run: Path) -> None:
    """`lamar/combine_results_crocodl.py` of cvg/crocodl-benchmark calls SUCCULENT `SUCCU`."""
    path = collect([run], "Ours.").write()
    assert path == run / "submission.zip"
    scenes = ("HYDRO", "SUCCU")
    names = [f"{scene}_map_{m}_query_{q}.txt" for scene in scenes for m in DEVICES for q in DEVICES]
    with zipfile.ZipFile(path) as archive:
        assert archive.namelist() == ["description.txt", *names]
        assert archive.read("description.txt") == b"Ours.\n"
        assert archive.testzip() is None


def test_poses_are_those_of_the_run_in_the_order_of_the_list(run: Path, tmp_path: Path) -> None:
    path = collect([run], "Ours.").write()
    poses = poses_in(path, "SUCCU_map_hl_query_spot.txt", tmp_path)
    assert poses.timestamps.tolist() == [300, 200, 100]
    assert poses.device_ids.tolist() == ["s/rig_300", "s/rig_200", "s/rig_100"]
    expected = np.array([pose_of("SUCCULENT", "spot", time) for time in (300, 200, 100)])
    np.testing.assert_allclose(poses.qt, expected, rtol=0, atol=1e-15)
    assert poses.covariances is None  # ours are of a point and direction that the benchmark's are not
    np.testing.assert_allclose(np.linalg.norm(poses.qt[:, :4], axis=1), 1, rtol=0, atol=1e-15)


def test_equal_runs_give_equal_bytes(run: Path, tmp_path: Path) -> None:
    first, second = (collect([run], "Ours.", tmp_path / f"{name}.zip").write() for name in "ab")
    assert first.read_bytes() == second.read_bytes()


def test_what_failed_is_filled_from_the_best_reference_and_said_so(run: Path, tmp_path: Path) -> None:
    make_poses(run, "HYDRO", "ios", "hl", (300,))
    submission = collect([run], "Ours.")
    row = submission.table.set_index("file").loc["HYDRO_map_ios_query_hl.txt"]
    counts = {"asked": 3, "written": 2, "ok": 0, "low_confidence": 1, "filled": 1, "left_out": 1, "not_asked": 0}
    assert row[list(counts)].to_dict() == counts
    assert row["state"] == "1 left out, 1 filled"
    path = submission.write()
    poses = poses_in(path, "HYDRO_map_ios_query_hl.txt", tmp_path)
    assert poses.timestamps.tolist() == [300, 200]
    # The camera with score 0.9 stands where its reference stood.
    world_from_cam = pose_from_qt(poses.qt[1]) @ RIG_FROM_CAM
    np.testing.assert_allclose(world_from_cam, make_pose(np.eye(3), [0.9, 200, 0]), atol=1e-12)
    with zipfile.ZipFile(path) as archive:
        assert b"1 of 54 queries were not localized" in archive.read("description.txt")
    table = pd.read_csv(path.with_suffix(".csv")).query("file == 'HYDRO_map_ios_query_hl.txt'")
    assert table["pose"].tolist() == ["low_confidence", "nearest", "left out"]
    assert table["reason"].tolist()[1:] == ["failed: no match", "failed: no match; no reference was retrieved"]


def test_what_failed_can_be_left_out(run: Path, tmp_path: Path) -> None:
    files = make_poses(run, "HYDRO", "ios", "hl", ())
    path = collect([run], "Ours.", failed="leave-out").write()
    assert len(poses_in(path, "HYDRO_map_ios_query_hl.txt", tmp_path)) == 0
    with zipfile.ZipFile(path) as archive:
        assert archive.read("description.txt") == b"Ours.\n"
    files.retrieval("ios", "hl").unlink()
    left = collect([run], "Ours.").queries.query("file == 'HYDRO_map_ios_query_hl.txt'")
    assert left["reason"].str.contains("no retrieval to fill it from: .*jsonl is missing").all()


def test_poses_of_the_sequence_are_taken_where_asked_for(run: Path, tmp_path: Path) -> None:
    files, times = SceneFiles(run, "HYDRO"), (90, *TIMES)  # a frame that is no query, too
    ids, qt = [device_of("hl", time) for time in times], [pose_of("other", "hl", time) for time in times]
    Trajectory(times, ids, qt).write(files.sequence_txt("ios", "hl"))
    rows = pd.DataFrame({"timestamp": times, "device_id": ids, "status": "low_confidence: drift"})
    rows.to_csv(files.sequence_txt("ios", "hl").with_suffix(".csv"), index=False)
    submission = collect([run], "Ours.", sequence=True)
    assert list(submission.poses) == ["HYDRO_map_ios_query_hl.txt"]
    assert "of the stage `sequence`" in submission.table["state"][0]
    row = submission.table.set_index("file").loc["HYDRO_map_ios_query_hl.txt"]
    assert (row["written"], row["low_confidence"], row["not_asked"]) == (3, 3, 1)
    found = poses_in(submission.write(), "HYDRO_map_ios_query_hl.txt", tmp_path)
    np.testing.assert_allclose(found.qt, qt[:0:-1], atol=1e-15)
    single = files.poses_txt("ios", "hl")
    write_sidecar(files.sequence_txt("ios", "hl"), {}, made_from=[single])
    assert collect([run], "Ours.", sequence=True).poses
    single.write_text(single.read_text() + "# localized again\n")
    with pytest.raises(ArtifactError, match=single.name):
        collect([run], "Ours.", sequence=True)
    single.unlink()  # the localize stage has left the pair out
    with pytest.raises(ArtifactError, match="missing now"):
        collect([run], "Ours.", sequence=True)


def test_missing_pairs_are_reported_and_the_rest_is_written(run: Path) -> None:
    SceneFiles(run, "HYDRO").poses_txt("spot", "ios").unlink()
    submission = collect([run], "Ours.")
    assert submission.missing == ["HYDRO_map_spot_query_ios.txt"]
    assert "17 of 18 pairs" in submission.text()
    assert "Missing: HYDRO_map_spot_query_ios.txt." in submission.text()
    with zipfile.ZipFile(submission.write()) as archive:
        assert len(archive.namelist()) == 18


def test_scenes_may_be_in_several_runs(run: Path, tmp_path: Path, captures: list[Path]) -> None:
    other = tmp_path / "other"
    other.mkdir()
    (run / "SUCCULENT").rename(other / "SUCCULENT")
    submission = collect([run], "Ours.")
    assert len(submission.missing) == 9  # the challenge's second scene is expected, though no run has it
    assert not collect([run, other], "Ours.").missing
    make_poses(other, "HYDRO", "ios", "ios")
    with pytest.raises(ArtifactError, match=r"run/HYDRO/.*_ios\.txt .*other/HYDRO/"):
        collect([run, other])


def test_another_scene_has_the_pairs_of_its_capture(tmp_path: Path) -> None:
    capture = make_capture(tmp_path / "data", "HOME")
    make_poses(tmp_path / "run", "HOME", "ios", "hl")
    submission = collect([tmp_path / "run"], captures=[capture])
    assert len(submission.table) == 9
    assert len(submission.missing) == 8
    with pytest.raises(ManifestError, match=r"HOME: .*--capture PATH/HOME"):
        collect([tmp_path / "run"])
    with pytest.raises(ManifestError, match=r"moved/HOME.*--capture PATH/HOME"):
        collect([tmp_path / "run"], captures=[tmp_path / "moved" / "HOME"])


def test_a_scene_of_lamar_is_like_any_other(tmp_path: Path) -> None:
    """It has the pairs of the sessions that `download` makes, and the zip does not follow LaMAR's combine script."""
    capture = make_capture(tmp_path / "data", "CAB")
    make_poses(tmp_path / "run", "CAB", "ios", "ios")
    table = collect([tmp_path / "run"], captures=[capture], scenes=["CAB"]).table.set_index("file")
    assert table["written"].sum() == table["written"]["CAB_map_ios_query_ios.txt"] == 3


def test_devices_and_links_are_those_of_the_runs_manifest(tmp_path: Path) -> None:
    capture = make_capture(tmp_path / "data", "HOME")
    session = (capture / "sessions" / "hl_query").rename(capture / "sessions" / "q_drone")
    images = session / "images.txt"
    images.write_text(images.read_text().replace("s/100.jpg", "../100.jpg"))
    files = make_poses(tmp_path / "run", "HOME", "ios", "drone")
    record = {"stages": [{"scene": "HOME", "parameters": {"sessions_root": str(capture / "sessions")}}]}
    manifest = {"extra_devices": [{"key": "drone", "sessions": {"query": "q_drone"}}], "allow_outside": True}
    (files.run / "run.json").write_text(json.dumps(record | {"manifest": manifest}))
    table = collect([files.run]).table.set_index("file")
    assert table.loc["HOME_map_ios_query_drone.txt", "written"] == 3
    assert export_intrinsics(files.run, "HOME", "ios", "drone", tmp_path / "queries.txt") == 3


def test_poses_that_nobody_asked_for_are_not_written(run: Path, tmp_path: Path, captures: list[Path]) -> None:
    """As when poses are keyed by a camera where the list asks for its rig."""
    path = captures[0] / "sessions" / "hl_query" / "proc" / f"{LIST}.txt"
    path.write_text("300, s/rig_300\n400, s/rig_400\n")
    row = collect([run], failed="leave-out").table.set_index("file").loc["HYDRO_map_ios_query_hl.txt"]
    assert row[["asked", "written", "left_out", "not_asked"]].tolist() == [2, 1, 1, 2]
    assert row["state"] == "1 left out, 2 not asked"


@pytest.mark.parametrize(
    ("lines", "error", "message"),
    [
        (["100, s/phone, 1, 0, 0, 0, nan, 0, 0"], CaptureError, r"_query_ios\.txt, line 1: .*tx = 'nan'"),
        (["100, s/phone, 1, 0, 0"], CaptureError, r"_query_ios\.txt, line 1: "),
        (["100, s/phone, 1, 1, 0, 0, 0, 0, 0"], ArtifactError, r"line 1: .*100, device 's/phone'"),
        (["# x", *["100, s/phone, 1, 0, 0, 0, 0, 0, 0"] * 2], ArtifactError, r"_query_ios\.txt, line 3: .*100"),
    ],
)
def test_malformed_poses_are_refused_with_file_line_and_key(
    run: Path, lines: list[str], error: type[ToolkitError], message: str
) -> None:
    SceneFiles(run, "HYDRO").poses_txt("ios", "ios").write_text("\n".join(lines))
    with pytest.raises(error, match=message):
        collect([run])
    assert not (run / "submission.zip").exists()


def test_a_key_that_is_listed_twice_is_answered_once(run: Path, captures: list[Path]) -> None:
    path = captures[0] / "sessions" / "ios_query" / "proc" / f"{LIST}.txt"
    once = collect([run]).table
    path.write_text(path.read_text() + path.read_text().splitlines()[0] + "\n")
    pd.testing.assert_frame_equal(collect([run]).table, once)


def test_wrong_values_name_the_known_ones(run: Path, tmp_path: Path) -> None:
    with pytest.raises(ManifestError, match=r"'guess'.* leave-out, nearest"):
        collect([run], failed="guess")
    with pytest.raises(ManifestError, match="nowhere: "):
        collect([tmp_path / "nowhere"])
    with pytest.raises(ManifestError, match="data: "):
        collect([tmp_path / "data"])
    with pytest.raises(CaptureError, match=r"'few'.* pruned_subsampled, all"):
        collect([run], queries="few")
    with pytest.raises(ManifestError, match=r"desc\.txt: "):
        collect([run], str(tmp_path / "desc.txt"))


@pytest.mark.parametrize("text", ["", "timestamp,device_id\n100,s/phone\n", "timestamp,device_id,status\nx,a,ok\n"])
def test_a_damaged_table_of_queries_is_named(run: Path, text: str) -> None:
    path = SceneFiles(run, "HYDRO").poses_csv("ios", "ios")
    path.write_text(text)
    with pytest.raises(ArtifactError, match=r"map_ios_query_ios\.csv: .*Localize this pair again"):
        collect([run])


def test_a_capture_that_is_of_no_scene_is_refused(run: Path, tmp_path: Path) -> None:
    with pytest.raises(ManifestError, match=r"HYDRA: .* HYDRO, SUCC"):
        collect([run], captures=[tmp_path / "HYDRA"])


def test_a_place_that_cannot_be_written_is_one_paragraph(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").touch()
    for out in (tmp_path / "folder", tmp_path / "file" / "submission.zip"):
        monkeypatch.setattr("sys.argv", ["toolkit", "submit", str(run), "--description", "Ours.", "--out", str(out)])
        with pytest.raises(SystemExit) as ended:
            main()
        assert ended.value.code == 1
        (paragraph,) = capsys.readouterr().err.splitlines()
        assert paragraph.startswith("Error: ")
        assert str(out.parent if out.suffix else out) in paragraph


def test_nothing_to_submit_is_an_error(run: Path) -> None:
    for path in run.glob("*/poses/*.txt"):
        path.unlink()
    with pytest.raises(ToolkitError, match="18 pairs"):
        collect([run], "Ours.").write()


def test_the_command_shows_a_table_and_writes_only_when_asked(run: Path, tmp_path: Path) -> None:
    (tmp_path / "desc.txt").write_text("From a file.")
    shown = CliRunner().invoke(app, ["submit", str(run), "--dry-run"])
    assert shown.exit_code == 0, shown.output
    assert "SUCCU_map_spot_query_spot.txt" in shown.output
    assert "18 of 18 pairs, 54 poses for 54 queries" in shown.output
    assert not (run / "submission.zip").exists()
    refused = CliRunner().invoke(app, ["submit", str(run)])
    assert "--description is missing" in str(refused.exception)
    done = CliRunner().invoke(app, ["submit", str(run), "--description", str(tmp_path / "desc.txt")])
    assert f"Submission: {run / 'submission.zip'}" in done.output
    with zipfile.ZipFile(run / "submission.zip") as archive:
        assert archive.read("description.txt") == b"From a file.\n"
