"""What retrieval found for one query: the stored scores, the similarities they are of, and true overlap."""

import shutil
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from tests.displayed import picture_of
from tests.rendered import copy_shared
from toolkit.capture import Capture
from toolkit.errors import ArtifactError
from toolkit.figures.retrieval import RetrievedPair
from toolkit.results.metrics import MIN_OVERLAP, is_posed
from toolkit.retrieve import retrieve_pairs


@pytest.fixture(scope="module")
def pair(small_capture: Path, small_embedded: Path, tmp_path_factory: pytest.TempPathFactory) -> RetrievedPair:
    folder, sessions = tmp_path_factory.mktemp("retrieved") / "SMALL", small_capture / "sessions"
    copy_shared(small_embedded, folder)
    pair = {"map_device": "hl", "query_device": "ios", "queries": "all"}
    retrieve_pairs(sessions, folder / "embeddings", folder / "retrieval", {"topk": 4}, **pair)
    (jsonl,) = (folder / "retrieval").glob("*.jsonl")
    return RetrievedPair(sessions, jsonl, folder / "embeddings")


def test_similarities_are_those_of_the_search(pair: RetrievedPair) -> None:
    one = pair.look(1)
    assert len(one.images) == len(pair.map_session) == len(one.similarity)
    names = [pair.map_session.image_name(int(row)) for row in one.images]
    similarity = dict(zip(names, one.similarity, strict=True))
    for hit in one.references.itertuples():
        assert similarity[hit.name] == pytest.approx(hit.score, abs=1e-5)
    best = [names[k] for k in np.argsort(-one.similarity, kind="stable")[:4]]
    assert best == one.references["name"].tolist()
    tracks = [name.rpartition("/")[0] for name in names]  # a folder a camera: each in one piece, in order of time
    assert len(set(tracks)) == 1 + sum(a != b for a, b in pairwise(tracks))
    times = pair.map_session.images["timestamp"].to_numpy()[one.images]
    assert all(a < b for (a, x), (b, y) in pairwise(zip(times, tracks, strict=True)) if x == y)


def test_green_is_what_looks_the_same_way(pair: RetrievedPair) -> None:
    session = pair.session
    true = session.world_from_cam([0], ground_truth=True)[0]
    one = pair.look(pair.names.index(session.image_name(0)))
    assert one.is_known
    directions = pair.map_session.world_from_cam(one.images)[:, :3, 2] @ true[:3, 2]
    assert (one.overlap[directions < -0.8] < MIN_OVERLAP).all()
    assert one.overlap[np.argmax(directions)] > 0.3
    frames = [axis for axis in one.figure.axes if axis.get_title().startswith(tuple("1234"))]
    for axis, hit in zip(frames, one.references.itertuples(), strict=True):
        assert axis.get_title().startswith(f"{hit.rank}: {hit.score:.2f}, overlap {hit.overlap:.0%}")
        color = axis.spines["top"].get_edgecolor()
        assert (color[1] > color[0]) == (hit.overlap >= MIN_OVERLAP)
    assert picture_of(one).width > 800


def test_without_true_poses_overlap_is_not_known(pair: RetrievedPair, small_capture: Path, tmp_path: Path) -> None:
    capture = Path(shutil.copytree(small_capture, tmp_path / small_capture.name))
    for truth in (capture / "sessions" / "ios_query").rglob("*trajector*"):
        truth.unlink()
    blind = RetrievedPair.__new__(RetrievedPair)
    blind.__dict__ |= pair.__dict__ | {"session": Capture.open(capture)["ios_query"]}
    assert not is_posed(blind.session.world_from_cam(ground_truth=True)).any()
    one = blind.look(0)
    assert one.references["overlap"].isna().all()
    assert not one.is_known
    shown = "\n".join(axis.get_title() for axis in one.figure.axes) + one.figure.get_suptitle()
    assert "overlap" not in shown
    assert "green" not in shown
    assert "overlaps with the query" not in one.figure.axes[-2].get_legend_handles_labels()[1]


def test_an_unknown_query_is_refused_with_the_nearest(pair: RetrievedPair) -> None:
    name = pair.names[2]
    assert pair.look(name.rpartition("/")[2]).number == 2
    for unknown, named in ((name[:-1], f"is '{name}'"), (-1, "from 0 to")):
        with pytest.raises(ArtifactError, match=named):
            pair.look(unknown)
