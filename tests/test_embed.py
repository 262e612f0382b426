"""The embed stage: what it writes, that counts balance, what it reuses."""

import json
import shutil
import threading
from pathlib import Path
from unittest.mock import Mock

import cv2
import numpy as np
import pandas as pd
import pytest
import torch
from PIL import Image

from tests.calls import call
from tests.models.test_megaloc import tiny_megaloc
from toolkit import embed
from toolkit.capture import Session, Trajectory, write_session
from toolkit.capture.images import read_image, turned_from_cam
from toolkit.embed import embed_sessions, write_matrix
from toolkit.embedders import load_embeddings
from toolkit.embedders.megaloc import MegaLocEmbedder
from toolkit.errors import ArtifactError, CaptureError, ManifestError, ToolkitError, WeightsError
from toolkit.geometry import invert, qt_from_pose
from toolkit.models.megaloc import MegaLoc
from toolkit.retrieve import retrieve_pairs

HL_RIG = "hl_a/rig"


def write_tiny_capture(root: Path) -> Path:
    """Photographs of three textured walls: ios without a rig and hl with one, each with a map and a query."""
    rng = np.random.default_rng(0)
    walls = []
    for _ in range(3):
        grids = (rng.random((size, 2 * size)) for size in (6, 20, 60))
        layers = [cv2.resize(grid, (640, 320), interpolation=cv2.INTER_CUBIC) for grid in grids]
        walls.append(np.clip(255 * sum(layers) / 3, 0, 255).astype(np.uint8))
    identity = [1.0, 0, 0, 0, 0, 0, 0]
    for device, sensors in {"ios": ["cam"], "hl": ["left", "right"]}.items():
        for split, offset in {"map": 0, "query": 25}.items():
            path = root / "sessions" / f"{device}_{split}"
            images, poses = [], []
            for wall, picture in enumerate(walls):
                for view in range(2 if split == "map" else 1):
                    time = 1000 + 10 * wall + view
                    poses.append(
                        (
                            time,
                            HL_RIG if device == "hl" else f"{device}_a/cam",
                            [1, 0, 0, 0, wall * 10 + view, 0, 0],
                        )
                    )
                    for index, sensor in enumerate(sensors):
                        name = f"{device}_a/images/{sensor}/{time}.png"
                        images.append((time, f"{device}_a/{sensor}", name))
                        x = offset + 40 * view + 60 * index
                        crop = picture[20:260, x : x + 320]
                        (path / "raw_data" / name).parent.mkdir(parents=True, exist_ok=True)
                        cv2.imwrite(str(path / "raw_data" / name), crop)
            times, ids, values = zip(*poses, strict=True)
            trajectory = Trajectory.from_poses(times, ids, np.tile(np.eye(4), (len(ids), 1, 1)))
            trajectory.qt[:] = np.array(values)
            write_session(
                path,
                [(f"{device}_a/{s}", s, "camera", "PINHOLE", 320, 240, 300, 300, 160, 120) for s in sensors],
                [(HL_RIG, f"hl_a/{s}", identity) for s in sensors] if device == "hl" else None,
                trajectory if split == "map" else None,
                images,
                subsessions=[f"{device}_a"],
                keyframes={"pruned_subsampled": pd.DataFrame({"timestamp": times, "device_id": ids})}
                if split == "query"
                else None,
                ground_truth=trajectory if split == "query" else None,
            )
    return root


@pytest.fixture
def tiny(tmp_path: Path) -> Path:
    return write_tiny_capture(tmp_path / "TINY")


def test_files_and_counts(tiny: Path, tmp_path: Path) -> None:
    out = tmp_path / "run" / "embeddings"
    table = embed_sessions(tiny / "sessions", out)
    assert table[["session", "images", "embedded", "unreadable"]].to_numpy().tolist() == [
        ["ios_map", 6, 6, 0],
        ["ios_query", 3, 3, 0],
        ["hl_map", 12, 12, 0],
        ["hl_query", 6, 6, 0],
    ]
    matrix = np.load(out / "hl_map" / "hl_a" / "hl_a.npy")
    manifest = pd.read_csv(out / "hl_map" / "hl_a" / "manifest.csv")
    assert matrix.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(matrix, axis=1), 1, atol=1e-5)
    assert list(manifest.columns) == ["row_index", "device_id", "sensor_id", "timestamp", "abs_path"]
    assert manifest.iloc[1].tolist() == [
        1, HL_RIG, "hl_a/right", 1000, "TINY/sessions/hl_map/raw_data/hl_a/images/right/1000.png",
    ]  # fmt: skip
    assert (tmp_path / "run" / "features").is_dir()
    assert not list(out.rglob("*.partial*")), "nothing temporary is left"


def test_unreadable_images_are_listed(tiny: Path, tmp_path: Path) -> None:
    raw = tiny / "sessions" / "ios_map" / "raw_data" / "ios_a" / "images" / "cam"
    (raw / "1000.png").write_bytes(b"not an image")
    (raw / "1010.png").unlink()
    row = embed_sessions(tiny / "sessions", tmp_path / "e", device="ios").iloc[0]
    assert (row["images"], row["embedded"], row["unreadable"]) == (6, 4, 2)
    folder = tmp_path / "e" / "ios_map" / "ios_a"
    failed = pd.read_csv(folder / "failed.csv")
    assert failed["timestamp"].tolist() == [1000, 1010]
    assert failed["reason"].str.contains("decoded|found").all()
    matrix, table = load_embeddings(folder)
    assert len(matrix) == 4
    assert table["timestamp"].tolist() == [1001, 1011, 1020, 1021]


def test_reuse_and_resume(tiny: Path, tmp_path: Path) -> None:
    out = tmp_path / "e"
    embed_sessions(tiny / "sessions", out)
    before = {path: path.read_bytes() for path in out.rglob("*.npy")}
    assert embed_sessions(tiny / "sessions", out)["skipped"].all()

    # A killed run: one subsession has its matrix but no record of what it was made from.
    (out / "hl_map" / "hl_a" / "hl_a.npy.meta.json").unlink()
    again = embed_sessions(tiny / "sessions", out)
    assert again.loc[~again["skipped"], "session"].tolist() == ["hl_map"]
    assert {path: path.read_bytes() for path in out.rglob("*.npy")} == before

    assert not embed_sessions(tiny / "sessions", out, settings={"normalize": False})["skipped"].any()
    assert not embed_sessions(tiny / "sessions", out, settings={"dtype": "float16"})["skipped"].any()
    assert load_embeddings(out / "ios_map")[0].dtype == np.float32


@pytest.mark.slow
def test_a_changed_query_or_map_image(tiny: Path, tmp_path: Path) -> None:
    out = tmp_path / "e"
    embed_sessions(tiny / "sessions", out)
    for session, stale in {
        "ios_query": ["ios_query"],
        "ios_map": ["ios_map", "ios_query", "hl_map", "hl_query"],
    }.items():
        raw = tiny / "sessions" / session / "raw_data" / "ios_a" / "images" / "cam"
        shutil.copy(raw / "1010.png", raw / "1000.png")
        table = embed_sessions(tiny / "sessions", out)
        assert table.loc[~table["skipped"], "session"].tolist() == stale


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"device": "spot"}, "ios, hl"),
        ({"subsession": "nope"}, "ios_a"),
        ({"dtype": "int8"}, "dtype"),
        ({"batch_size": 0}, "batch_size"),
        ({"compute_device": "tpu"}, "compute_device"),
    ],
)
def test_refused_parameters(tiny: Path, tmp_path: Path, parameters: dict[str, object], message: str) -> None:
    with pytest.raises(ManifestError, match=message):
        call(embed_sessions, tiny / "sessions", tmp_path / "e", **parameters)  # type: ignore[arg-type]


def test_no_map_no_vocabulary(tiny: Path, tmp_path: Path) -> None:
    for device in ("ios", "hl"):
        shutil.rmtree(tiny / "sessions" / f"{device}_map")
    with pytest.raises(ToolkitError, match="_map session"):
        embed_sessions(tiny / "sessions", tmp_path / "e")


@pytest.fixture
def megaloc(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> dict[str, object]:
    """Parameters of the stage that make it use a tiny MegaLoc with random weights."""
    monkeypatch.setattr(MegaLoc, "from_checkpoint", lambda _: tiny_megaloc())
    path = tmp_path / "weights.safetensors"
    path.write_bytes(b"stands for weights")
    options: dict[str, object] = {"model": "megaloc", "checkpoint": str(path), "image_size": 126}
    return options | {"compute_device": "cpu", "dtype_compute": "float32", "batch_size": 4}


def test_a_learned_embedder(tiny: Path, tmp_path: Path, megaloc: dict[str, object]) -> None:
    (tiny / "sessions/hl_map/raw_data/hl_a/images/left/1010.png").write_bytes(b"not an image")
    out = tmp_path / "run" / "e"
    table = call(embed_sessions, tiny / "sessions", out, **megaloc)  # type: ignore[arg-type]
    assert table[["session", "embedded", "unreadable"]].to_numpy().tolist() == [
        ["ios_map", 6, 0], ["ios_query", 3, 0], ["hl_map", 11, 1], ["hl_query", 6, 0],
    ]  # fmt: skip
    assert not (tmp_path / "run" / "features").exists(), "it needs no local features"
    matrix, manifest = load_embeddings(out / "hl_map")
    embedder = MegaLocEmbedder(tiny_megaloc(), device="cpu", dtype_compute="float32", image_size=126)
    for row in (0, 4, 10):
        image = read_image(tiny.parent / manifest["abs_path"][row])
        np.testing.assert_allclose(matrix[row], embedder.embed([image])[0], atol=1e-6)
    assert pd.read_csv(out / "hl_map/hl_a/failed.csv")["timestamp"].tolist() == [1010]
    assert call(embed_sessions, tiny / "sessions", out, **megaloc)["skipped"].all()  # type: ignore[arg-type]
    other = megaloc | {"image_size": 140}
    assert not call(embed_sessions, tiny / "sessions", out, **other)["skipped"].any()  # type: ignore[arg-type]


def test_photographs_are_decoded_as_small_as_the_network_allows(
    tiny: Path, tmp_path: Path, megaloc: dict[str, object]
) -> None:
    """Then the descriptors change by less than those of two types of numbers do, and the record tells them apart."""
    for path in (tiny / "sessions/ios_query/raw_data").rglob("*.*"):
        if path.is_file():
            coarse = np.random.default_rng(0).integers(0, 256, (40, 56, 3), np.uint8)
            Image.fromarray(coarse).resize((784, 560), Image.Resampling.BICUBIC).save(path, format="JPEG", quality=95)
    out = tmp_path / "e"
    call(embed_sessions, tiny / "sessions", out, device="ios", upright=False, **megaloc)  # type: ignore[arg-type]
    matrix, manifest = load_embeddings(out / "ios_query")
    embedder = MegaLocEmbedder(tiny_megaloc(), device="cpu", dtype_compute="float32", image_size=126)
    path = tiny.parent / manifest["abs_path"][0]
    reduced, whole = read_image(path, min_side=embedder.min_side), read_image(path)
    assert (reduced.shape, whole.shape) == ((280, 392, 3), (560, 784, 3))
    np.testing.assert_allclose(matrix[0], embedder.embed([reduced])[0], atol=1e-6)
    # Half the squared distance is 1 - the cosine, without its rounding.
    assert 1e-9 < np.square(matrix[0] - embedder.embed([whole])[0]).sum() / 2 < 1e-4
    record = json.loads((out / "ios_query/ios_a/ios_a.npy.meta.json").read_text())
    assert record["settings"]["embedder"]["least_side"] == 252


def test_the_next_batch_is_made_while_one_is_embedded(
    tiny: Path, tmp_path: Path, megaloc: dict[str, object], monkeypatch: pytest.MonkeyPatch
) -> None:
    """In whatever order threads get to it: embedding a batch waits here until the next one is there."""
    shutil.rmtree(tiny / "sessions" / "ios_query")
    stack, embed = MegaLocEmbedder.stack, MegaLocEmbedder.embed
    stacked, embedded, made = list[int](), list[int](), threading.Condition()

    def stacks(self: MegaLocEmbedder, inputs: list[np.ndarray]) -> torch.Tensor:
        batch = stack(self, inputs)
        with made:
            stacked.append(len(batch))
            made.notify()
        return batch

    def embeds(self: MegaLocEmbedder, batch: torch.Tensor) -> np.ndarray:
        embedded.append(len(batch))
        with made:
            assert len(embedded) == 3 or made.wait_for(lambda: len(stacked) > len(embedded), timeout=20)
        return embed(self, batch)

    monkeypatch.setattr(MegaLocEmbedder, "stack", stacks)
    monkeypatch.setattr(MegaLocEmbedder, "embed", embeds)
    settings = megaloc | {"batch_size": 2}
    table = call(embed_sessions, tiny / "sessions", tmp_path / "e", device="ios", **settings)  # type: ignore[arg-type]
    assert table["embedded"].tolist() == [6]
    assert stacked == embedded == [2, 2, 2]


def test_half_precision_on_disk(tiny: Path, tmp_path: Path, megaloc: dict[str, object]) -> None:
    matrices = []
    for dtype in ("float32", "float16"):
        out = tmp_path / dtype
        call(embed_sessions, tiny / "sessions", out, device="ios", dtype=dtype, **megaloc)  # type: ignore[arg-type]
        matrices.append(np.load(out / "ios_map/ios_a/ios_a.npy"))
    assert [matrix.dtype for matrix in matrices] == [np.float32, np.float16]
    np.testing.assert_allclose(matrices[0], matrices[1], atol=1e-3)


def test_a_killed_run_goes_on_within_a_subsession(
    tiny: Path, tmp_path: Path, megaloc: dict[str, object], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tiny / "sessions/hl_map/raw_data/hl_a/images/left/1000.png").unlink()
    go = {"device": "hl", **megaloc}
    call(embed_sessions, tiny / "sessions", tmp_path / "whole", **go)  # type: ignore[arg-type]
    embed, seen = MegaLocEmbedder.embed, []

    def dies_at_the_third_batch(self: MegaLocEmbedder, inputs: list[np.ndarray]) -> np.ndarray:
        if len(seen) == 2:
            raise KeyboardInterrupt
        seen.append(len(inputs))
        return embed(self, inputs)

    monkeypatch.setattr(MegaLocEmbedder, "embed", dies_at_the_third_batch)
    with pytest.raises(KeyboardInterrupt):
        call(embed_sessions, tiny / "sessions", tmp_path / "e", **go)  # type: ignore[arg-type]
    assert not (tmp_path / "e/hl_map/hl_a/hl_a.npy").exists()

    def counts(self: MegaLocEmbedder, inputs: list[np.ndarray]) -> np.ndarray:
        seen.append(len(inputs))
        return embed(self, inputs)

    monkeypatch.setattr(MegaLocEmbedder, "embed", counts)
    table = call(embed_sessions, tiny / "sessions", tmp_path / "e", **go)  # type: ignore[arg-type]
    assert seen == [3, 4, 4, 4, 2], "12 images of the map, one unreadable, of which 8 were done, and 6 of the query"
    assert table["unreadable"].tolist() == [1, 0]
    for path in (tmp_path / "whole").rglob("*.*"):
        twin = tmp_path / "e" / path.relative_to(tmp_path / "whole")
        assert path.is_dir() or twin.read_bytes() == path.read_bytes(), path
    assert not list((tmp_path / "e").rglob("*.partial*"))


def test_only_images_that_were_added_are_embedded(
    tiny: Path, tmp_path: Path, megaloc: dict[str, object], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tiny / "sessions/hl_map/raw_data/hl_a/images/left/1000.png").unlink()
    go, table = {"device": "hl", **megaloc}, tiny / "sessions/hl_map/images.txt"
    call(embed_sessions, tiny / "sessions", tmp_path / "whole", **go)  # type: ignore[arg-type]
    whole = table.read_text()
    table.write_text("".join(whole.splitlines(keepends=True)[:9]))
    call(embed_sessions, tiny / "sessions", tmp_path / "e", **go)  # type: ignore[arg-type]
    table.write_text(whole)
    embed, seen = MegaLocEmbedder.embed, []

    def counts(self: MegaLocEmbedder, inputs: list[np.ndarray]) -> np.ndarray:
        seen.append(len(inputs))
        return embed(self, inputs)

    monkeypatch.setattr(MegaLocEmbedder, "embed", counts)
    made = call(embed_sessions, tiny / "sessions", tmp_path / "e", **go)  # type: ignore[arg-type]
    assert seen == [4], "8 of 12 images of the map were there, one of them unreadable"
    assert made["embedded"].tolist() == [11, 6]
    for path in (tmp_path / "whole/hl_map").rglob("*.*"):
        assert (tmp_path / "e/hl_map" / path.relative_to(tmp_path / "whole/hl_map")).read_bytes() == path.read_bytes()
    # Not if the first images are others.
    lines = whole.splitlines(keepends=True)
    table.write_text("".join([*lines[:1], *lines[2:9]]))
    call(embed_sessions, tiny / "sessions", tmp_path / "other", **go)  # type: ignore[arg-type]
    table.write_text(whole)
    seen.clear()
    call(embed_sessions, tiny / "sessions", tmp_path / "other", **go)  # type: ignore[arg-type]
    assert sum(seen) == 11


@pytest.mark.parametrize("unreadable", [[], [3], [5], [3, 5], [0, 4]])
def test_a_second_subsession_grows_with_images_that_cannot_be_read(
    tiny: Path, tmp_path: Path, megaloc: dict[str, object], unreadable: list[int]
) -> None:
    """Images 3 to 5 are the second one's, image 5 is added."""
    session, go = tiny / "sessions/ios_map", {"device": "ios", **megaloc}
    lines = (session / "images.txt").read_text().splitlines(keepends=True)
    (session / "proc/subsessions.txt").unlink()  # folders of images tell them
    for at in range(3, 6):
        path = session / "raw_data" / lines[1 + at].rsplit(",", 1)[1].strip()
        moved = Path(str(path).replace("ios_a", "ios_b"))
        moved.parent.mkdir(parents=True, exist_ok=True)
        path.rename(moved)
        head, name = lines[1 + at].rsplit(",", 1)
        lines[1 + at] = f"{head},{name.replace('ios_a', 'ios_b')}"
    for at in unreadable:
        (session / "raw_data" / lines[1 + at].rsplit(",", 1)[1].strip()).write_bytes(b"")
    (session / "images.txt").write_text("".join(lines[:6]))
    call(embed_sessions, tiny / "sessions", tmp_path / "e", **go)  # type: ignore[arg-type]
    (session / "images.txt").write_text("".join(lines))
    call(embed_sessions, tiny / "sessions", tmp_path / "e", **go)  # type: ignore[arg-type]
    call(embed_sessions, tiny / "sessions", tmp_path / "whole", **go)  # type: ignore[arg-type]
    for path in (tmp_path / "whole/ios_map").rglob("*.csv"):
        assert (tmp_path / "e/ios_map" / path.relative_to(tmp_path / "whole/ios_map")).read_bytes() == path.read_bytes()
    for name in ("ios_a", "ios_b"):
        grown, whole = (load_embeddings(tmp_path / run / "ios_map" / name)[0] for run in ("e", "whole"))
        np.testing.assert_allclose(grown, whole, atol=1e-5)


def test_the_vocabulary_stays_while_the_map_grows_to_twice_its_images(
    tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("toolkit.embedders.vlad.MAX_DIM", 2)  # else that of the vectors is the number of images
    shutil.move(tiny / "sessions/hl_map", tmp_path / "hl_map")
    table = tiny / "sessions/ios_map/images.txt"
    lines = table.read_text().splitlines(keepends=True)
    vocabularies, first_vectors = [], []
    for count in (2, 3, 4, 5):
        table.write_text("".join(lines[: 1 + count]))
        embed_sessions(tiny / "sessions", tmp_path / "e", device="ios")
        vocabularies.append((tmp_path / "e/vlad.npz").read_bytes())
        vectors = np.load(tmp_path / "e/ios_map/ios_a/ios_a.npy")
        assert len(vectors) == count
        first_vectors.append(vectors[:2].tobytes())
    assert [vocabulary == vocabularies[0] for vocabulary in vocabularies] == [True, True, True, False]
    assert [vectors == first_vectors[0] for vectors in first_vectors] == [True, True, True, False]
    shutil.move(tmp_path / "hl_map", tiny / "sessions/hl_map")  # another map, which has words of its own
    embed_sessions(tiny / "sessions", tmp_path / "e", device="ios")
    assert (tmp_path / "e/vlad.npz").read_bytes() != vocabularies[-1]


@pytest.mark.parametrize("dtype", ["float32", "float16"])
@pytest.mark.parametrize("batches", [[], [0], [5, 0, 5, 2]])
def test_a_matrix_is_what_numpy_writes(tmp_path: Path, dtype: str, batches: list[int]) -> None:
    vectors = np.random.default_rng(0).random((sum(batches), 3), np.float32)
    np.save(tmp_path / "numpy.npy", vectors.astype(dtype))
    parts = np.split(vectors, np.cumsum(batches)[:-1]) if batches else []
    write_matrix(tmp_path / "ours.npy", parts, len(vectors), 3, dtype)
    assert (tmp_path / "ours.npy").read_bytes() == (tmp_path / "numpy.npy").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["numpy.npy", "ours.npy"]


def test_an_embedder_that_gives_other_vectors_is_refused(
    tiny: Path, tmp_path: Path, megaloc: dict[str, object], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(MegaLocEmbedder, "embed", lambda self, inputs: np.zeros((len(inputs), 3), np.float32))
    with pytest.raises(ValueError, match=r"megaloc gave \(4, 3\)"):
        call(embed_sessions, tiny / "sessions", tmp_path / "e", **megaloc)  # type: ignore[arg-type]


@pytest.mark.usefixtures("no_hub")
def test_no_weights_no_work(tiny: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    for options in ({}, {"checkpoint": str(tmp_path / "none.safetensors")}):
        with pytest.raises(WeightsError, match=r"model\.safetensors(.|\n)*`embed\.model: vlad`"):
            call(embed_sessions, tiny / "sessions", tmp_path / "run" / "e", model="megaloc", **options)  # type: ignore[arg-type]
    assert not (tmp_path / "run").exists()
    table = embed_sessions(tiny / "sessions", tmp_path / "run" / "e", settings={"model": "auto"}, device="ios")
    assert set(table["model"]) == {"vlad"}
    assert "model auto: vlad" in caplog.text


def test_auto_takes_the_learned_one_where_it_can(tiny: Path, tmp_path: Path, megaloc: dict[str, object]) -> None:
    table = call(embed_sessions, tiny / "sessions", tmp_path / "e", **megaloc | {"model": "auto"})  # type: ignore[arg-type]
    assert set(table["model"]) == {"megaloc"}


def roll_camera(capture: Path, sensor: str, k: int) -> None:
    """Mount a camera of the headset differently: its images are stored after k counter-clockwise quarter turns."""
    for split in ("map", "query"):
        session = capture / "sessions" / f"hl_{split}"
        for path in (session / "raw_data" / "hl_a" / "images" / sensor).iterdir():
            cv2.imwrite(str(path), np.rot90(cv2.imread(str(path)), k))
        turned = invert(turned_from_cam(k))
        numbers = ", ".join(map(str, qt_from_pose(turned)))
        lines = (session / "rigs.txt").read_text().splitlines()
        edited = [f"{HL_RIG}, hl_a/{sensor}, {numbers}" if f"hl_a/{sensor}," in line else line for line in lines]
        (session / "rigs.txt").write_text("\n".join(edited) + "\n")


@pytest.mark.parametrize("k", [1, *(pytest.param(k, marks=pytest.mark.slow) for k in (2, 3))])
def test_a_rolled_camera_is_described_as_an_upright_one(
    tiny: Path, tmp_path: Path, megaloc: dict[str, object], k: int
) -> None:
    """The world's up is -y here: the cameras of the walls have the axes of the world."""
    rolled = write_tiny_capture(tmp_path / "ROLLED" / "TINY")
    roll_camera(rolled, "right", k)
    tables, matrices, retrieved = [], {}, {}
    for name, capture, upright in (("as they are", tiny, None), ("turned", rolled, None), ("not", rolled, False)):
        out = tmp_path / name / "e"
        options = megaloc | {"upright": upright, "world_up": [0, -1, 0]}
        tables.append(call(embed_sessions, capture / "sessions", out, **options))  # type: ignore[arg-type]
        matrices[name] = np.load(out / "hl_query/hl_a/hl_a.npy")
        retrieve_pairs(capture / "sessions", out, settings={"topk": 3}, map_device="ios", query_device="hl")
        retrieved[name] = (tmp_path / name / "retrieval/TINY_map_ios_query_hl.jsonl").read_text()
    assert [table.set_index("session").loc["hl_query", "turned"] for table in tables] == [0, 3, 0]
    np.testing.assert_array_equal(matrices["turned"], matrices["as they are"])
    assert np.abs(matrices["not"] - matrices["as they are"]).max() > 1e-3
    lines = {name: [json.loads(line) for line in text.splitlines()] for name, text in retrieved.items()}
    ranked = {name: [query["topk"] for query in queries] for name, queries in lines.items()}
    assert ranked["turned"] == ranked["as they are"]


@pytest.mark.slow
def test_a_subsession_that_is_gone_leaves_no_embeddings(tiny: Path, tmp_path: Path) -> None:
    out = tmp_path / "e"
    embed_sessions(tiny / "sessions", out, device="ios")
    former = out / "ios_map" / "gone"
    shutil.copytree(out / "ios_map" / "ios_a", former)
    (former / "ios_a.npy").rename(former / "gone.npy")
    embed_sessions(tiny / "sessions", out, device="ios")
    assert len(load_embeddings(out / "ios_map")[0]) == 6


@pytest.mark.slow
def test_a_session_that_lost_its_images_leaves_no_embeddings(tiny: Path, tmp_path: Path) -> None:
    out = tmp_path / "e"
    embed_sessions(tiny / "sessions", out, device="ios")
    images = tiny / "sessions" / "ios_query" / "images.txt"
    images.write_text(images.read_text().splitlines(keepends=True)[0])
    assert set(embed_sessions(tiny / "sessions", out, device="ios")["session"]) == {"ios_map"}
    with pytest.raises(ArtifactError, match="ios_query"):
        load_embeddings(out / "ios_query")


@pytest.mark.slow
def test_corrected_intrinsics_are_followed(tiny: Path, tmp_path: Path) -> None:
    sensors = tiny / "sessions" / "ios_map" / "sensors.txt"
    right = sensors.read_text()
    width = str(Session.open(tiny / "sessions" / "ios_map").camera("ios_a/cam").width)
    sensors.write_text(right.replace(f", {width},", f", {int(width) + 2},"))
    wrong = embed_sessions(tiny / "sessions", tmp_path / "e", device="ios")
    assert wrong.iloc[0]["embedded"] < 6
    sensors.write_text(right)
    assert embed_sessions(tiny / "sessions", tmp_path / "e", device="ios").iloc[0]["embedded"] == 6


@pytest.mark.slow
def test_a_torn_matrix_is_made_anew(tiny: Path, tmp_path: Path) -> None:
    embed_sessions(tiny / "sessions", tmp_path / "e", device="ios")
    path = tmp_path / "e" / "ios_map" / "ios_a" / "ios_a.npy"
    whole = path.read_bytes()
    path.write_bytes(whole[:100])
    embed_sessions(tiny / "sessions", tmp_path / "e", device="ios")
    assert path.read_bytes() == whole


def test_a_run_killed_after_the_matrix_was_written_leaves_no_progress_beside_it(
    tiny: Path, tmp_path: Path, megaloc: dict[str, object], monkeypatch: pytest.MonkeyPatch
) -> None:
    go = {"device": "hl", **megaloc}
    with monkeypatch.context() as patch:
        patch.setattr(embed, "remove_items", Mock(side_effect=KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            call(embed_sessions, tiny / "sessions", tmp_path / "e", **go)  # type: ignore[arg-type]
    assert list((tmp_path / "e/hl_map/hl_a").glob(".*"))
    table = call(embed_sessions, tiny / "sessions", tmp_path / "e", **go)  # type: ignore[arg-type]
    assert table["skipped"].tolist() == [True, False]
    assert not list((tmp_path / "e/hl_map/hl_a").glob(".*"))


def test_an_unusable_session_stops_no_other(tmp_path: Path) -> None:
    capture = write_tiny_capture(tmp_path / "TINY")
    (capture / "sessions" / "hl_map" / "images.txt").write_text("a line\n")
    table = embed_sessions(capture / "sessions", tmp_path / "embeddings").set_index("session")
    assert "hl_map/images.txt, line 1" in table["reason"]["hl_map"]
    assert table["images"]["hl_map"] == 0
    others = table.drop("hl_map")
    assert (others["reason"] == "").all()
    assert others["embedded"].gt(0).all()
    (capture / "sessions" / "hl_query" / "images.txt").write_text("a line\n")
    with pytest.raises(CaptureError):
        embed_sessions(capture / "sessions", tmp_path / "embeddings", device="hl")


@pytest.mark.slow
def test_a_session_without_a_readable_image_stops_no_other(tmp_path: Path) -> None:
    capture = write_tiny_capture(tmp_path / "TINY")
    for session in ("hl_map", "ios_query"):
        shutil.rmtree(capture / "sessions" / session / "raw_data")
    table = embed_sessions(capture / "sessions", tmp_path / "embeddings").set_index("session")
    assert table["embedded"].eq(0).to_dict() == {
        "ios_map": False, "ios_query": True, "hl_map": True, "hl_query": False
    }  # fmt: skip
    found = retrieve_pairs(tmp_path / "TINY" / "sessions", tmp_path / "embeddings")
    reasons = found.set_index(["map_device", "query_device"])["reason"]
    assert (reasons["ios"] == "").all()
    assert reasons["hl"].str.contains("hl_map").all()
