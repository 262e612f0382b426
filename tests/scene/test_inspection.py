"""One query of a run under the glass: it shows what was stored, and localizes again as the run did."""

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.displayed import picture_of
from tests.localized import some_correspondences, stored, write_pair
from tests.rendered import localized_by_pnp
from toolkit.capture import Capture
from toolkit.errors import ArtifactError, ManifestError
from toolkit.figures.answers import Comparison, reason_in_words
from toolkit.figures.query_images import shown_name
from toolkit.files import SceneFiles, map_record_path
from toolkit.geometry import invert
from toolkit.manifest import LocalizeSettings
from toolkit.pose.base import CAMERA, QueryResult, Rival, Status
from toolkit.scene.run import (
    WORST,
    Choice,
    InspectedPair,
    Run,
    WorstQueries,
    choose,
    find_query,
)


@pytest.fixture(scope="module")
def files(
    small_capture: Path, small_features: Path, made_once: Callable[[str, Callable[[Path], object]], Path]
) -> SceneFiles:
    """A run that has localized the robot's rig in the phone's map by PnP; do not write to it."""

    run = made_once("inspected", lambda folder: localized_by_pnp(folder, small_capture, small_features, "spot"))
    return SceneFiles(run, small_capture.name)


@pytest.fixture(scope="module")
def pair(files: SceneFiles) -> InspectedPair:
    return InspectedPair("ios", "spot", files.poses_dir)


def written(
    capture: Path, folder: Path, queries: list[QueryResult], device: str = "ios", **columns: object
) -> InspectedPair:
    """A pair written by hand, its attributes like those of a run."""
    import h5py

    from toolkit.results.pair import RETRIEVAL, SESSIONS_ROOT, SETTINGS

    poses = folder / capture.name / "poses"
    stem = write_pair(Capture.open(capture), poses, "ios", device, queries, **columns)  # type: ignore[arg-type]
    with h5py.File(f"{stem}.h5", "a") as file:
        file.attrs[SETTINGS] = LocalizeSettings(world_up=[0.0, 0.0, 1.0]).model_dump_json()
        file.attrs[SESSIONS_ROOT] = str(capture / "sessions")
        file.attrs[RETRIEVAL] = str(folder / capture.name / "retrieval")
    return InspectedPair("ios", device, poses)


def text_of(figure: object) -> str:
    return "\n".join(text.get_text() for text in figure.findobj(lambda artist: hasattr(artist, "get_text")))  # type: ignore[attr-defined]


def panel(figure: object, title: str) -> object:
    return next(axis for axis in figure.axes if axis.get_title().startswith(title))  # type: ignore[attr-defined]


def test_it_shows_what_the_stage_stored(files: SceneFiles, pair: InspectedPair) -> None:
    one = pair.look(1)
    row = pd.read_csv(files.poses_csv("ios", "spot")).iloc[1]
    stored = pair.localized.results[1]
    assert one.result.status_text == row["status"]
    assert one.numbers["num_inliers"] == row["num_inliers"]
    assert one.matches["agree"].sum() == stored.correspondences.agrees.sum() > 0
    assert one.matches.to_numpy().sum() == len(stored.correspondences)
    off = invert(one.result.world_from_rig) @ one.true_pose
    assert one.error[1] == pytest.approx(np.linalg.norm(off[:3, 3])), "of the rig"
    assert one.references["name"][one.references["used"]].tolist() == list(stored.references)
    ranked = one.references.dropna(subset="rank")
    assert ranked["rank"].min() == 1
    assert ranked.sort_values("rank")["score"].notna().all()
    shown = text_of(one.figure)
    for kind, counts in one.matches.iterrows():
        assert counts["agree"] == 0 or f"{str(kind).replace('/', ', ')}: {counts['agree']} agree" in shown
    assert one.result.status_text in shown
    assert f"\n{one.name.partition('/raw_data/')[2]}\n" in shown
    assert f"{row['num_inliers']}" in shown
    assert one.texts["true position error [m]"].strip("0.")
    assert picture_of(one).width > 800


@pytest.mark.slow
def test_unchanged_settings_give_the_same_pose_and_others_are_shown_beside(pair: InspectedPair) -> None:
    one = pair.look(0)
    same = one.result.what_if()
    assert same.after.result.world_from_rig is not None
    np.testing.assert_allclose(same.after.result.world_from_rig, one.result.world_from_rig, atol=1e-12)
    np.testing.assert_allclose(same.after.result.covariance, one.result.covariance, rtol=1e-9)
    assert same.after.result.status_text == one.result.status_text
    assert len(same.after.result.correspondences) == len(one.result.correspondences)
    assert (same.after.result.rivals, one.result.rivals) == ((), ())
    strict = one.result.what_if({"localize.pnp.min_inliers": 5000})
    assert strict.after.result.reason.startswith("too few inliers")
    assert "at least 5000 are required" in strict.after.reason
    assert strict.before.result is one.result
    assert strict.table.loc["status"].tolist() == [one.result.status_text, strict.after.result.status_text]
    assert picture_of(strict).width > 800
    nearest = one.result.what_if({"localize": {"method": "nearest"}})
    assert nearest.after.result.found_by == "nearest"
    first = one.references[one.references["rank"] == 1]  # one of each camera of the rig
    assert list(nearest.after.result.references) == [first["name"][first["score"].idxmax()]]
    alone = text_of(nearest.after.figure)
    assert "true position error" in alone
    assert not any(text in alone for text in ("inliers", "descriptor matches", "image covered")), "it has none"
    for key, value, named in (
        ("localize.pnp.min_inlier", 5, "^localize: unknown key 'pnp.min_inlier'. Did you mean 'min_inliers'"),
        ("localize.unit", None, "--set localize.unit"),
        ("embed.models", "vlad", "embed.*retrieve.topk"),
        ("retrieve.topk", 0, "topk"),
    ):
        with pytest.raises(ManifestError, match=named):
            one.result.what_if({key: value})


def test_the_worst_is_the_worst(small_capture: Path, tmp_path: Path) -> None:
    off = [0.0, 0.3, 0.02]
    pair = written(small_capture, tmp_path, [stored()] * 3, off_m=off)
    assert pair.look("worst").number == 1
    assert pair.look(1).error[1] == pytest.approx(0.3)
    worst = WorstQueries(pair._h5.parent)
    assert [worst.look(rank).number for rank in range(3)] == [1, 2, 0]
    assert worst.names[0] == f"ios in the map of ios: {shown_name(pair.names[1])}"
    with pytest.raises(ArtifactError, match="to 2"):
        worst.look(3)
    assert WorstQueries(tmp_path).names == []
    for asked in (0, WORST):  # as the notebook asks of a folder with poses of another tool, which have no matches
        assert choose(WorstQueries(tmp_path), asked).shown is None


def test_a_session_that_broke_after_a_run_costs_only_its_own_pairs(small_capture: Path, tmp_path: Path) -> None:
    capture = tmp_path / "capture" / small_capture.name
    shutil.copytree(small_capture, capture)
    written(capture, tmp_path, [stored()] * 2)
    pair = written(capture, tmp_path, [stored()], device="hl")
    (capture / "sessions" / "hl_query" / "images.txt").write_text("a line\n")
    worst = WorstQueries(pair._h5.parent)
    assert [name.partition(":")[0] for name in worst.names] == ["ios in the map of ios"] * 2


def test_a_run_whose_pairs_all_fail_to_open_says_why(
    small_capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It said "found 0, expected a number from 0 to -1"."""
    import h5py

    poses = written(small_capture, tmp_path, [stored()])._h5.parent
    written(small_capture, tmp_path, [stored()], device="hl")
    (tmp_path / "run.json").write_text("{}")
    for path in poses.glob("*.h5"):
        with h5py.File(path, "a") as file:
            file.attrs["settings"] = json.dumps({"removed": 1})
    for query in ("worst", "0.jpg"):
        with pytest.raises(ArtifactError, match=r"_query_hl\.h5: another version.*Run its stage again"):
            Run.open(tmp_path).result(query)
    assert WorstQueries(poses).names == []
    choose(WorstQueries(poses), "worst")
    assert "Run its stage again" in capsys.readouterr().out
    for path in poses.glob("*.h5"):
        path.unlink()
    with pytest.raises(ArtifactError, match="no localized query"):
        Run.open(tmp_path).result()


def test_a_failed_query_says_why_and_is_drawn(small_capture: Path, tmp_path: Path) -> None:
    status = ["failed: too few inliers (4 within 0.45 deg)", "failed: no references"]
    counts = {"num_inliers": [4, 0], "num_matches": [9, 0]}
    pair = written(small_capture, tmp_path, [stored()] * 2, status=status, **counts)
    one = pair.look(0)
    assert one.result.world_from_rig is None
    assert one.error is None
    assert all(count in one.reason for count in ("4 within 0.45 deg", "9 matches", "at least 12"))
    assert "no pose" in text_of(one.figure)
    assert picture_of(one).width > 800
    assert "no references" in pair.look(1).reason
    assert "no reference" in text_of(pair.look(1).figure)


def test_rivals_are_drawn_where_they_are(small_capture: Path, tmp_path: Path) -> None:
    session = Capture.open(small_capture)["ios_query"]
    pose = session.world_from_cam([0], ground_truth=True)[0].copy()
    pose[:3, 3] += [0.5, 0.0, 0.0]
    found = some_correspondences([0] * 6, [True, False, True, True, False, True])
    query = stored([session.image_name(0)], [], [], found, (Rival(pose, 0.93),))
    one = written(small_capture, tmp_path, [query]).look(0)
    drawn = {each.get_label(): each.get_offsets() for each in panel(one.figure, "from above").collections}
    np.testing.assert_allclose(drawn["rival, 93% of the support"], [pose[:2, 3]], atol=1e-9)
    assert one.matches.loc["sift/descriptors"].tolist() == [4, 2]


def test_the_ellipse_is_of_the_camera_not_of_the_rig(pair: InspectedPair) -> None:
    one = pair.look(0)
    camera = [view.name for view in one.views].index(one.details.cameras[0].name)
    rng = np.random.default_rng(0)
    moves = rng.multivariate_normal(np.zeros(6), one.result.covariance, 20_000)
    at = one.rig_from_cams[camera][:3, 3]
    places = at + moves[:, 3:] + np.cross(moves[:, :3], at)
    expected = np.cov((places @ one.result.world_from_rig[:3, :3].T).T)
    np.testing.assert_allclose(one.details.position_covariance, expected, atol=0.05 * np.abs(expected).max())


def test_both_answers_are_drawn_at_the_same_camera_of_a_rig(pair: InspectedPair) -> None:
    one = pair.look(0)
    other = next(image.name for image in one.details.cameras if image.name != one.details.cameras[0].name)
    found = some_correspondences([one.result.images.index(other)] * 6, [True] * 6)
    swapped = replace(one, result=replace(one.result, correspondences=found))
    assert swapped.details.cameras[0].name == other
    first, second = panel(Comparison(one, swapped, {}).figure, "the pose, enlarged").patches
    np.testing.assert_allclose(second.get_center(), first.get_center(), atol=1e-9)


def test_a_figure_has_one_number_called_inliers(pair: InspectedPair) -> None:
    for number in range(len(pair)):
        one = pair.look(number)
        assert len(set(re.findall(r"(\d+) inliers|inliers[^\d\n]*(\d+)", text_of(one.figure)))) <= 1
        assert [label for label in one.texts if "inliers" in label] == ["inliers among them"]


def test_lengths_of_an_unknown_unit_are_not_meters(small_capture: Path, tmp_path: Path) -> None:
    off = [0.0, 0.3, 0.02]
    pair = written(small_capture, tmp_path, [stored()] * 3, off_m=off, position_std_m=[0.01, 0.2, 0.03])
    poses = pair._h5.parent
    map_record_path(poses, small_capture.name, "ios").write_text(json.dumps({"unit": None, "depth": 50.0, "text": ""}))
    pair = InspectedPair("ios", "ios", poses)
    one = pair.look("worst")
    assert one.error[1] == pytest.approx(0.06)
    spread = np.diag([0.0, 0.0, 0.0, 0.2**2, 0.0, 0.0])
    one = replace(one, result=replace(one.result, covariance=spread))
    assert one.numbers["position_std_L"] == pytest.approx(0.04)
    assert "position_std_m" not in one.numbers
    text = text_of(one.figure)
    assert "std. dev. of position [L]" in text
    assert "[m]" not in text


def test_what_is_not_known_is_not_shown(files: SceneFiles, small_capture: Path, tmp_path: Path) -> None:
    capture = Path(shutil.copytree(small_capture, tmp_path / small_capture.name))
    for truth in (capture / "sessions" / "spot_query").rglob("*trajector*"):
        truth.unlink()
    one = InspectedPair("ios", "spot", files.poses_dir, sessions_root=capture / "sessions").look(0)
    assert one.true_pose is None
    assert one.error is None
    assert "true" not in text_of(one.figure)


def test_names_and_numbers_that_are_none_are_refused(files: SceneFiles, pair: InspectedPair, tmp_path: Path) -> None:
    name = pair.localized.query_session.image_name(int(pair.localized.rows[2][-1]))
    for same in (name, name.partition("raw_data/")[2], f"SMALL/sessions/{name}"):
        assert pair.look(same).number == 2
    alike = {"x/b.jpg": 0, "y/b.jpg": 1, "y/ab.jpg": 2}
    for ask, named in (
        (lambda: pair.look(name.replace("raw_data", "raw_dat")), f"The nearest of its .* images is '{name}'"),
        (lambda: pair.look(len(pair)), f"expected a number from 0 to {len(pair) - 1}"),
        (lambda: pair.look(1.5), "expected a number or the name of an image"),
        (lambda: find_query("b.jpg", alike, 3), "2 have an image name that ends in"),
        (lambda: InspectedPair("ios", "spt", files.poses_dir), "no correspondences .*'spt'.*Did you mean .*spot"),
        (lambda: InspectedPair("ios", "spot", tmp_path), "no correspondences"),
    ):
        with pytest.raises(ArtifactError, match=named):
            ask()


def test_an_estimate_in_doubt_says_why() -> None:
    numbers = {"num_inliers": 20, "num_matches": 80, "inlier_ratio": 0.25, "coverage": 0.2, "p_correct": 0.7}
    unsure = QueryResult(Status.LOW_CONFIDENCE)
    words = reason_in_words(unsure, numbers | {"rival_support": 0.93}, LocalizeSettings())
    assert all(share in words for share in ("70%", "99%", "93%")), "its probability, the limit, and the rival"
    contradicted = replace(unsure, reason=CAMERA, remark="the focal length is 500 px")
    camera = reason_in_words(contradicted, numbers, LocalizeSettings())
    assert camera.endswith("The focal length is 500 px.")


def test_a_predicted_pose_says_how_many_references_agree() -> None:
    named = {"references": ("a", "b"), "rejected": ("c",), "found_by": "feed_forward:simulated/feed_forward"}
    predicted = QueryResult(Status.OK, **named)  # type: ignore[arg-type]
    assert reason_in_words(predicted, {}, LocalizeSettings()) == "2 of 3 references agree on the pose."


def test_a_list_chooses_what_is_shown(pair: InspectedPair, monkeypatch: pytest.MonkeyPatch) -> None:
    import IPython.display
    import ipywidgets

    from toolkit.runs.kernel import TEXT_BARS

    class Handle:
        def update(self, shown: object, **more: object) -> None:
            outputs.append(shown)

    outputs: list[object] = []

    def display(shown: object, **more: object) -> Handle:
        outputs.append(shown)
        return Handle()

    monkeypatch.setattr(IPython.display, "display", display)
    monkeypatch.delenv(TEXT_BARS, raising=False)
    choice = choose(pair, 1)
    listed, first = outputs
    assert isinstance(listed, ipywidgets.Dropdown)
    assert listed.options[2][0] == f"2: {shown_name(pair.names[2])}"
    assert (first.number, listed.value) == (1, 1)  # type: ignore[attr-defined]
    listed.value = 2
    assert outputs[-1] is choice.shown
    assert choice.shown.number == 2
    monkeypatch.setenv(TEXT_BARS, "1")
    outputs.clear()
    choose(pair, pair.names[0])
    with pytest.raises(ArtifactError, match=r"^inspect: found 99, expected"):
        choose(pair, 99)
    assert [type(shown).__name__ for shown in outputs] == ["Answer"]


def test_asking_in_a_notebook_does_not_end_it(capsys: pytest.CaptureFixture[str], pair: InspectedPair) -> None:
    Choice(pair.look(0)).attempt(lambda query: query.result.what_if({"localize.unit": None}))
    assert "unit" in capsys.readouterr().out
    Choice(None).attempt(lambda query: pytest.fail("there is none"))
