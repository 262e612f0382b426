"""The references that an open map finds for an image are those of the stages, in their order."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.unattended import no_kernels
from toolkit import pipeline
from toolkit.capture import Capture
from toolkit.embedders import open_descriptors
from toolkit.files import SceneFiles, image_name, read_references
from toolkit.geometry import Floats, Ints
from toolkit.pose.base import Query, View
from toolkit.scene.map import ReferenceSearch
from toolkit.threads import fixed_sums

DEVICES = ("ios", "hl", "spot")


@pytest.fixture(scope="module")
def searched(small_capture: Path, tmp_path_factory: pytest.TempPathFactory) -> SceneFiles:
    """References of all queries in the ios map, retrieved and reranked by the stages."""
    folder = tmp_path_factory.mktemp("searched")
    manifest = folder / "run.yaml"
    pairs = [["ios", device] for device in DEVICES]
    content = f"captures: ['{small_capture}']\noutput_root: .\npairs: {pairs}\nrerank: {{topn: 8, topk: 5}}\n"
    manifest.write_text(content)
    with no_kernels():
        run = pipeline.run(manifest, "embed,retrieve,rerank", say=lambda *_, **__: None)
    return SceneFiles(run, small_capture.name)


@pytest.mark.parametrize("device", DEVICES)
def test_an_open_map_searches_as_the_retrieve_stage(searched: SceneFiles, small_capture: Path, device: str) -> None:
    capture = Capture.open(small_capture)
    search = ReferenceSearch(searched, capture, "ios", reranked=False)
    vectors, table = open_descriptors(searched.embeddings, f"{device}_query", normalize=False)
    described = dict(zip(map(image_name, table["abs_path"]), vectors[:], strict=True))
    lines = read_references(searched.retrieval("ios", device), "path")
    assert len(lines) >= 2
    for line in lines:
        vector = described[image_name(str(line["path"]))]
        ((rows, scores),) = search.find(Query([], np.zeros((0, 4, 4)), descriptors=[vector[None]]))
        assert_references(search, line, rows, scores)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("reranked", [False, True])
def test_an_open_map_finds_what_the_stages_found(
    searched: SceneFiles, small_capture: Path, device: str, reranked: bool
) -> None:
    """From the pixels of an image: its features and descriptors are computed again, and the scores are equal."""
    capture = Capture.open(small_capture)
    session, search = capture[f"{device}_query"], ReferenceSearch(searched, capture, "ios", reranked)
    folder = searched.reranked_dir if reranked else searched.retrieval_dir
    lines = read_references(folder / searched.retrieval("ios", device).name, "path")
    for line in lines:
        row = session.row_of_name[image_name(str(line["path"]))]
        view = View(session.image_name(row), session.image_path(row), session.cameras([row])[0], in_map=False)
        query = Query([view], np.eye(4)[None])
        with fixed_sums:  # as in the verbs of `Map`
            ((rows, scores),) = search.find(replace(query, descriptors=search.describe(query, ())))
        assert_references(search, line, rows, scores)


def assert_references(search: ReferenceSearch, line: dict[str, Any], rows: Ints, scores: Floats) -> None:
    """The order, the images and the scores of a query image are those in its line of a stage's file."""
    assert [search.session.image_name(int(row)) for row in rows] == [image_name(one["path"]) for one in line["topk"]]
    np.testing.assert_array_equal(scores, [one["score"] for one in line["topk"]])
