"""Recall by the steps of the sequence stage, and recordings from above."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.sequences.drifting import drive, small_motion
from tests.test_sequence import drive_through, localized, place
from toolkit import geometry
from toolkit.capture import Capture, Session, Trajectory
from toolkit.errors import ArtifactError
from toolkit.evaluate import evaluate_scene
from toolkit.figures.evaluation import SequencePair, draw_sequence, draw_steps, warn_of_older
from toolkit.files import pair_name, why_older, write_sidecar
from toolkit.sequence import sequence_pairs

pytest.importorskip("gtsam")

__all__ = ["place"]  # a fixture

LIMITS = [(1.0, 0.1), (5.0, 0.5)]


def at(*x: float) -> np.ndarray:
    return np.stack([geometry.make_pose(np.eye(3), [each, 0.0, 0.0]) for each in x])


@pytest.fixture
def pair(tmp_path: Path) -> SequencePair:
    """Four queries at the origin: by single poses 0.05, 2 and 0.3 m off, and none; by voting all 0.3 m off; at last
    2, 0.05 and 0.05 m, and none."""
    stem = tmp_path / pair_name("A", "ios", "hl")
    ids = ["a", "b", "c", "d"]
    Trajectory.from_poses(np.arange(3), ids[:3], at(0.05, 2, 0.3)).write(f"{stem}.txt")
    Trajectory.from_poses(np.arange(3), ids[:3], at(2, 0.05, 0.05)).write(f"{stem}_sequence.txt")
    rows = [f"voted,{number},{name},1,0,0,0,0.3,0,0" for number, name in enumerate(ids)]
    Path(f"{stem}_sequence_steps.csv").write_text("\n".join(["step,timestamp,device_id,qw,qx,qy,qz,tx,ty,tz", *rows]))
    found = SequencePair.find(tmp_path, "A", "ios", "hl")
    assert found is not None
    assert SequencePair.find(tmp_path, "A", "hl", "ios") is None
    return found


KEYS = pd.DataFrame({"timestamp": range(4), "device_id": ["a", "b", "c", "d"]})


def test_recall_after_each_step(pair: SequencePair) -> None:
    truth = Trajectory.from_poses(np.arange(4), ["a", "b", "c", "d"], at(0, 0, 0, 0))
    table = pd.DataFrame(pair.recalls(KEYS, truth, LIMITS, "m", 1.0)).set_index("step")
    assert table.index.tolist() == ["single", "voted", "sequence"]
    assert table["recall@(1deg,0.1m)"].tolist() == [0.25, 0, 0.5]
    assert table["recall@(5deg,0.5m)"].tolist() == [0.5, 1, 0.5]
    assert table[["rescued", "broken"]].to_numpy().tolist() == [[0, 0], [2, 0], [1, 1]]
    np.testing.assert_allclose(table["median_translation_m"], [1.15, 0.3, 1.025])
    halved = pd.DataFrame(pair.recalls(KEYS, truth, LIMITS, "L", 10.0)).set_index("step")
    assert halved["recall@(1deg,0.1L)"].tolist() == [0.5, 1, 0.5], "0.1 of a unit that is 10 long"


def test_which_queries_were_rescued_and_broken(pair: SequencePair) -> None:
    changes = pair.changes(KEYS, at(0, 0, 0, 0), LIMITS[-1], 1.0)
    assert changes[["device_id", "change"]].to_numpy().tolist() == [["a", "broken"], ["b", "rescued"]]
    np.testing.assert_allclose(changes[["single_translation_error_m", "translation_error_m"]], [[0.05, 2], [2, 0.05]])


def test_results_from_other_single_poses_or_damaged_ones_are_not_used(
    pair: SequencePair, caplog: pytest.LogCaptureFixture
) -> None:
    single, sequence, steps = (Path(f"{pair.stem}{end}") for end in (".txt", "_sequence.txt", "_sequence_steps.csv"))
    write_sidecar(sequence, {}, [steps], made_from=[single])
    found = SequencePair.find(pair.stem.parent, "A", "ios", "hl")
    assert found is not None
    steps.write_text(steps.read_text().rpartition("\n")[0])
    with pytest.raises(ArtifactError, match=r"_sequence_steps\.csv is damaged"):
        found.steps  # noqa: B018
    other = sequence.with_name(sequence.name.replace("query_hl", "query_spot"))
    other.write_text(sequence.read_text())
    write_sidecar(other, {}, made_from=[single])
    warn_of_older(single.parent)
    assert not caplog.text
    Trajectory.from_poses(np.arange(1), ["a"], at(7)).write(single)
    assert SequencePair.find(pair.stem.parent, "A", "ios", "hl") is None
    warn_of_older(single.parent)
    assert caplog.messages == [f"Sequences of 2 pairs are not used: {why_older(sequence, 'sequence')}"]


def sequence_of(place: Path, folder: Path, **settings: object) -> None:
    settings = {"relocalize": False} | settings
    sequence_pairs(place / "sessions", folder / "poses", settings, map_device="ios", query_device="ios")


def lose_a_query(place: Path, folder: Path) -> None:
    """Let the first query that is asked have no pose of its own, but the frame after it have one."""
    truth = Session(place / "sessions/ios_query").ground_truth
    assert truth is not None
    localized(folder, place, truth, np.array([1, 2]))
    table = folder / "poses" / f"{pair_name(place.name, 'ios', 'ios')}.csv"
    lost = {"timestamp": truth.timestamps[:1], "device_id": truth.device_ids[:1], "status": "failed: too dark"}
    pd.concat([pd.read_csv(table), pd.DataFrame(lost)]).to_csv(table, index=False)


def test_online_poses_know_the_past_alone(place: Path, tmp_path: Path) -> None:
    stem = tmp_path / "poses" / pair_name(place.name, "ios", "ios")

    def steps() -> pd.DataFrame:
        sequence_of(place, tmp_path)
        return pd.read_csv(f"{stem}_sequence_steps.csv").set_index(["step", "timestamp"])

    before, single = steps(), Trajectory.read(f"{stem}.txt")
    names = ["voted", "graph", "again", "online 10 s", "online 20 s", "online"]
    assert list(dict.fromkeys(before.index.get_level_values(0))) == names
    last, poses = int(np.argmax(single.timestamps)), single.world_from_device.copy()
    poses[last, :3, 3] += 0.05
    Trajectory.from_poses(single.timestamps, single.device_ids, poses, single.covariances).write(f"{stem}.txt")
    after = steps()
    for step in ("online 10 s", "online"):
        same = (before.loc[step] == after.loc[step]).all(axis=1)
        assert same[same.index < single.timestamps[last]].all()
        assert not same[single.timestamps[last]]
    assert not (before.loc["graph"] == after.loc["graph"]).all(axis=None)


@pytest.mark.slow
def test_drift_and_a_loss_that_later_queries_tell_change_no_online_pose(place: Path, tmp_path: Path) -> None:
    stem = tmp_path / "poses" / pair_name(place.name, "ios", "ios")
    drive_through(tmp_path, place, drive(np.random.default_rng(0), frames=24))
    single = Trajectory.read(f"{stem}.txt")
    middle = single.timestamps[len(single) // 2]

    def steps(poses: np.ndarray) -> pd.DataFrame:
        Trajectory.from_poses(single.timestamps, single.device_ids, poses, single.covariances).write(f"{stem}.txt")
        sequence_of(place, tmp_path)
        return pd.read_csv(f"{stem}_sequence_steps.csv").set_index(["step", "timestamp"])

    poses, rng = single.world_from_device, np.random.default_rng(1)
    late = np.flatnonzero(single.timestamps >= middle)
    drifted = poses.copy()
    drifted[late] = np.stack([poses[row] @ small_motion(rng, 0.02, 0.5) for row in late])
    elsewhere = poses.copy()
    elsewhere[late, :3, 3] += [30.0, 0.0, 0.0]
    before = steps(poses)
    for changed in (drifted, elsewhere):
        after = steps(changed)
        for step in ("online 10 s", "online"):
            early = before.loc[step].query("timestamp < @middle")
            assert len(early) > 5
            pd.testing.assert_frame_equal(early, after.loc[step].loc[early.index])


@pytest.mark.slow
def test_tables_and_figures_of_a_run(place: Path, tmp_path: Path) -> None:
    sessions, poses, out = place / "sessions", tmp_path / "poses", tmp_path / "evaluation"
    evaluate_scene(sessions, poses, None, out)
    assert not (out / "sequence.csv").exists()
    lose_a_query(place, tmp_path)
    sequence_of(place, tmp_path)
    evaluation = evaluate_scene(sessions, poses, None, out)
    table = pd.read_csv(out / "sequence.csv")
    assert table["step"].tolist()[0] == "single"
    assert table["step"].tolist()[-1] == "sequence"
    assert set(table["map_device"]) == set(table["query_device"]) == {"ios"}
    recall = evaluation.recall.set_index(["map_device", "query_device"]).loc[("ios", "ios")]
    assert table["recall@(5deg,0.5m)"].iloc[0] == recall["recall@(5deg,0.5m)"], "that of single queries"
    assert table["recall@(5deg,0.5m)"].iloc[-1] == 1
    rescued = pd.read_csv(out / "changes.csv")
    assert len(rescued) == table["rescued"].iloc[-1] > 0
    assert (out / "sequence.png").is_file()
    for path in poses.glob("*_sequence*"):
        path.unlink()
    evaluate_scene(sessions, poses, None, out)
    assert not any((out / name).exists() for name in ("sequence.csv", "changes.csv", "sequence.png"))


def test_recordings_from_above(place: Path, tmp_path: Path) -> None:
    lose_a_query(place, tmp_path)
    sequence_of(place, tmp_path)
    pair = SequencePair.find(tmp_path / "poses", place.name, "ios", "ios")
    assert pair is not None
    session = Session(place / "sessions/ios_query")
    truth = session.ground_truth
    assert truth is not None
    ways = {"laid": pair.odometry_tracks(session), "frames": pair.tracks()}
    for ends in ways.values():
        way = np.concatenate(ends)
        assert len(way) == len(truth)
        offsets = np.linalg.norm(way[:, None] - truth.world_from_device[None, :, :3, 3], axis=2).min(axis=1)
        assert offsets.max() < 0.2
    figure = draw_sequence(Capture.open(place), pair, "ios", "ios")
    texts = [text.get_text() for legend in figure.legends for text in legend.get_texts()]
    assert "odometry, rigidly placed" in texts
    assert any(text.startswith("rescued: ") for text in texts)
    steps = pd.DataFrame(pair.recalls(session.keyframes(), truth, LIMITS, "m", 1.0))
    figure = draw_steps(steps.assign(map_device="ios", query_device="ios"))
    assert [axis.get_title() for axis in figure.axes] == ["recall @ 1°, 0.1\xa0m", "recall @ 5°, 0.5\xa0m"]
