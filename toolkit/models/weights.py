"""Weights of the networks: find the official file, fetch it, read it, and refuse any other."""

import hashlib
import json
import os
import pickle
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from toolkit.errors import WeightsError
from toolkit.models.hub import failure_reason

if TYPE_CHECKING:
    from torch import Tensor, nn

_HUB = "https://huggingface.co"
_PICKLES = (".pt", ".pth", ".bin", ".ckpt")
# Names under which training scripts keep the weights beside the optimizer and the like.
_ENCLOSING = ("model", "state_dict", "model_state_dict", "teacher")


@dataclass(frozen=True)
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
    """Name of a tensor in the file that is in no other of these; empty: not known."""

    def __str__(self) -> str:
        return f"`{self.filename}` of {_HUB}/{self.repo_id} (license: {self.license})"


MEGALOC = WeightsSource(
    model="MegaLoc",
    repo_id="gberton/MegaLoc",
    filename="model.safetensors",
    license="MIT",
    alternative="set `embed.model: vlad`, which needs none",
)
VGGT_1B = WeightsSource(
    model="VGGT-1B",
    repo_id="facebook/VGGT-1B",
    filename="model.pt",
    license="non-commercial, as the code's README says of the original checkpoint",
    alternative="set `localize.method: pnp`, which needs none",
    setting="localize.predictor.checkpoint",
)
VGGT_1B_COMMERCIAL = WeightsSource(
    model="VGGT-1B-Commercial",
    repo_id="facebook/VGGT-1B-Commercial",
    filename="model.pt",
    license="VGGT License of July 29, 2025: commercial use allowed, not military; access by form",
    alternative="set `localize.method: pnp`, which needs none",
    setting="localize.predictor.checkpoint",
)
VGGT = (VGGT_1B, VGGT_1B_COMMERCIAL)
"""Of one architecture: what is on the machine is taken."""
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


def find_weights(source: WeightsSource, checkpoint: str | Path | None = None) -> Path | None:
    """Return the file with the weights if it is on this machine, else None. Asks no network.

    Args:
        source: the model.
        checkpoint: the file to use, or the folder that holds it under its official name; `~` and `$VARIABLES`
            are expanded. When None, the hub's cache is searched.

    Raises:
        WeightsError: `checkpoint` is given and is not there. The cache is then not searched.
    """
    import huggingface_hub

    if checkpoint is not None:
        given = Path(os.path.expandvars(checkpoint)).expanduser()
        path = given / source.filename if given.is_dir() else given
        if not path.is_file():
            raise WeightsError(
                f"{source.model}: found no weights file {path}; expected {source}. Correct `{source.setting}`, or "
                f"leave it out to use the hub's cache. Or {source.alternative}."
            )
        return path
    cached = huggingface_hub.try_to_load_from_cache(source.repo_id, source.filename)
    # An empty file is what a full disk leaves of a download.
    return Path(cached) if isinstance(cached, str) and Path(cached).stat().st_size else None


def resolve_weights(source: WeightsSource, checkpoint: str | Path | None = None) -> Path:
    """Return the file with the weights; download it into the hub's cache if it is not on this machine.

    A download shows its progress and is checked against the SHA-256 that the hub gives. The environment variables
    of the hub's library are in force: HF_HOME, HF_ENDPOINT, HF_HUB_OFFLINE, HF_TOKEN and others.

    Args:
        source, checkpoint: as for `find_weights`.

    Raises:
        WeightsError: `checkpoint` is given and is not there; or the download failed, for which reason, and
            which file to put where instead. No part of a failed download is taken for weights later.
    """
    import huggingface_hub

    found = find_weights(source, checkpoint)
    if found is not None:
        return found
    try:
        # Asked for first on its own: the library repeats this request for minutes when it downloads.
        metadata = huggingface_hub.get_hf_file_metadata(huggingface_hub.hf_hub_url(source.repo_id, source.filename))
        path = Path(huggingface_hub.hf_hub_download(source.repo_id, source.filename, tqdm_class=_progress_bar()))
    except Exception as error:  # of the library, of the HTTP client, which differs with its version, and of the disk
        raise _not_downloaded(source, failure_reason(error)) from error
    expected = metadata.etag or ""
    if re.fullmatch("[0-9a-f]{64}", expected):  # files under version control have a shorter one, of git
        with open(path, "rb") as stream:
            found_sum = hashlib.file_digest(stream, "sha256").hexdigest()
        if found_sum != expected:
            _remove(path)
            raise _not_downloaded(
                source, f"wrong checksum, found SHA-256 {found_sum}, expected {expected}; the file was deleted"
            )
    return path


def find_any(sources: Sequence[WeightsSource], checkpoint: str | Path | None = None) -> Path | None:
    """Return the first file that is on this machine of weights that will all do, else None; see `find_weights`."""
    if checkpoint is not None:
        return find_weights(sources[0], checkpoint)
    return next((path for source in sources if (path := find_weights(source))), None)


def resolve_any(sources: Sequence[WeightsSource], checkpoint: str | Path | None = None) -> Path:
    """Return the first file that is on this machine of weights that will all do, else download the first of them.

    Raises:
        WeightsError: see `resolve_weights`.
    """
    return find_any(sources, checkpoint) or resolve_weights(sources[0], checkpoint)


def check_weights(source: WeightsSource, path: Path) -> None:
    """Refuse a safetensors file that is damaged or of another model, by its header alone.

    Raises:
        WeightsError: it is.
    """
    if path.suffix.lower() != ".safetensors" or not source.tensor:
        return
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, "pt") as file:
            names = {name.removeprefix("module.") for name in file.keys()}  # noqa: SIM118 - it is no mapping
        found = f"{len(names)} tensors, none of which is {source.tensor}"
    except (SafetensorError, OSError) as error:
        names, found = set(), f"no whole safetensors file ({_first_line(error)})"
    if source.tensor not in names:
        raise WeightsError(
            f"{path}: these are not weights of {source.model}: found {found}. Expected {source}. Correct "
            f"`{source.setting}`, or get the file again. Or {source.alternative}."
        )


def read_state_dict(path: str | Path) -> "dict[str, Tensor]":
    """Return the tensors of a checkpoint file by name, on the CPU.

    Reads `.safetensors`, and what `torch.save` wrote as long as it holds tensors only: no code in a file is run.
    Tensors in a dict under `model`, `state_dict` or the like are taken from there, and a prefix `module.` of all
    names is taken off. Tensors may be mapped from the file: do not change it while they are in use.

    Raises:
        WeightsError: no such file, not a checkpoint, damaged, would run code, or holds more than tensors.
    """
    path = Path(path)
    try:
        size = path.stat().st_size
        with open(path, "rb") as stream:
            kind = _kind(stream.read(64))
    except OSError as error:
        raise WeightsError(
            f"{path}: cannot be read ({error.strerror}); expected a file `.safetensors` or `.pt`."
        ) from error
    where = f"{path} ({size:,} bytes)"
    suffix = path.suffix.lower()
    wanted = "safetensors" if suffix == ".safetensors" else "torch pickle" if suffix in _PICKLES else None
    if kind not in ("safetensors", "torch pickle"):
        raise WeightsError(
            f"{where} is {kind}; expected {wanted or 'safetensors or torch pickle'} data. Get the file again."
        )
    if wanted not in (kind, None):
        raise WeightsError(f"{where} is named {suffix} but holds {kind} data. Get the right file, or rename this one.")
    return _tensors(_read_safetensors(path, where) if kind == "safetensors" else _read_pickle(path, where), where)


def load_checkpoint(
    module: "nn.Module",
    checkpoint: "str | Path | Mapping[str, Tensor]",
    name: str = "",
    ignore: tuple[str, ...] = (),
) -> None:
    """Put a checkpoint's tensors into a module, ready for inference: no gradients, in eval mode.

    Tensors become the module's own without a copy where type and layout allow, so that one built under
    `torch.device("meta")` costs no more memory than its weights. The module then shares memory with a dict that is
    given: what changes in one changes in the other. Numbers of another floating type are converted.

    Args:
        module: has the checkpoint's parameters and buffers, each with its shape and type.
        checkpoint: a file (see `read_state_dict`), or tensors by name.
        name: of the network, for messages.
        ignore: how keys begin that the checkpoint may have and the module does without.

    Raises:
        WeightsError: not a checkpoint, or one of another network; names the missing, unexpected, mis-shaped and
            mis-typed keys. The module is then as it was.
    """
    if isinstance(checkpoint, Mapping):
        where, state = "the given dict", _tensors(checkpoint, "the given dict")
    else:
        where, state = str(checkpoint), read_state_dict(checkpoint)
    state = {key: value for key, value in state.items() if not key.startswith(ignore)}
    expected: dict[str, Tensor] = module.state_dict()
    common = [key for key in expected if key in state]
    missing = [key for key in expected if key not in state]
    unexpected = [key for key in state if key not in expected]
    mis_shaped = [
        f"{key} found {tuple(state[key].shape)}, expected {tuple(expected[key].shape)}"
        for key in common
        if state[key].shape != expected[key].shape
    ]
    mis_typed = [
        f"{key} found {state[key].dtype}, expected {expected[key].dtype}"
        for key in common
        if state[key].dtype != expected[key].dtype
        and not (state[key].is_floating_point() and expected[key].is_floating_point())
    ]
    faults = {"missing": missing, "unexpected": unexpected, "mis-shaped": mis_shaped, "mis-typed": mis_typed}
    if any(faults.values()):
        lines = [f"\n  {len(keys)} {fault}: {_first(keys)}" for fault, keys in faults.items() if keys]
        part = next((part for part, _ in module.named_children() if _is_part(part, unexpected, expected)), None)
        hint = f"\nThe unexpected keys are those of its part `{part}` alone." if part else ""
        raise WeightsError(
            f"{where}: these are not weights of {name or type(module).__name__}, which has {len(expected)} keys; "
            f"found {len(state)}.{''.join(lines)}{hint}\nGet the official file of this model."
        )
    # Detached: a Parameter of the caller's would become the module's itself, and lose its requires_grad.
    own = {key: value.detach().to(expected[key].dtype).contiguous() for key, value in state.items()}
    module.load_state_dict(own, strict=True, assign=True)
    module.requires_grad_(False).eval()


def weights_digest(module: "nn.Module") -> str:
    """Return 16 hex digits that identify the weights of a module by their names and values."""
    import torch

    digest = hashlib.sha256()
    for name, tensor in module.state_dict().items():
        digest.update(name.encode())
        digest.update(tensor.detach().cpu().contiguous().flatten().view(torch.uint8).numpy())
    return digest.hexdigest()[:16]


def _progress_bar() -> type:
    """Return a bar that shows wherever those of the stages do: the library's own only does on a terminal."""
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
    # The cache is searched under the commit that the branch stood at last, and under the branch's name before that.
    branch = folder / "refs" / constants.DEFAULT_REVISION
    revision = branch.read_text(encoding="utf-8") if branch.is_file() else constants.DEFAULT_REVISION
    return WeightsError(
        f"{source.model}: no weights on this machine, and the download failed: {reason}.\n"
        f"Get {source}, put it anywhere and name it in the manifest as `{source.setting}`; or put it at "
        f"{folder / 'snapshots' / revision / source.filename}, where it is found without.\n"
        f"Or {source.alternative}."
    )


def _remove(path: Path) -> None:
    """Delete a file of the hub's cache: the links to it, and what they lead to."""
    while path.is_symlink():
        target = path.parent / path.readlink()
        path.unlink()
        path = target
    path.unlink(missing_ok=True)


def _kind(head: bytes) -> str:
    """Return what a file is, in words, from its first bytes."""
    if not head:
        return "empty"
    if head[8:9] == b"{":  # after the header's length, 8 bytes
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
            f"{where} is not a whole safetensors file: {_first_line(error)}; expected {_announced_size(path)}. "
            "Delete it and get it again."
        ) from error


def _announced_size(path: Path) -> str:
    """Return how long a safetensors file says it is: header length (8 bytes), header (JSON), then the numbers."""
    try:
        with open(path, "rb") as stream:
            length = int.from_bytes(stream.read(8), "little")
            header = json.loads(stream.read(min(length, 100_000_000)))  # the format allows no longer one
        ends = [entry["data_offsets"][1] for key, entry in header.items() if key != "__metadata__"]
        return f"{8 + length + max(ends, default=0):,} bytes by its header"
    except (ValueError, LookupError, TypeError, AttributeError):
        return "a header of names, types and shapes first"


def _read_pickle(path: Path, where: str) -> Any:
    import torch

    with open(path, "rb") as stream:
        is_zip = stream.read(2) == b"PK"  # only this layout, since torch 1.6, can be mapped
    try:
        return torch.load(path, map_location="cpu", weights_only=True, mmap=is_zip)
    except pickle.UnpicklingError as error:
        wanted = re.search(r"GLOBAL (\S+)", str(error))
        raise WeightsError(
            f"{where} is a pickle that runs code when it is read{f' ({wanted[1]})' if wanted else ''}; it was not "
            "loaded. Expected tensors only: convert it to .safetensors where you trust it, or get the official file."
        ) from error
    except Exception as error:  # torn files fail in as many ways as there are places to tear them
        raise WeightsError(
            f"{where} is not a whole file of torch.save: {_first_line(error)}. Delete it and get it again."
        ) from error


def _tensors(content: Any, where: str) -> "dict[str, Tensor]":
    """Return the tensors of what a file holds, or refuse it."""
    from torch import Tensor

    def holds_tensors(value: Any) -> bool:
        return isinstance(value, Mapping) and any(isinstance(item, Tensor) for item in value.values())

    if not holds_tensors(content):
        found = f"a {type(content).__name__}"
        if isinstance(content, Mapping):
            found = f"a dict of {_first([str(key) for key in content]) or 'nothing'}"
            content = next((content[key] for key in _ENCLOSING if holds_tensors(content.get(key))), None)
        if not holds_tensors(content):
            raise WeightsError(
                f"{where}: found {found}; expected a dict of tensors, by itself or under {', '.join(_ENCLOSING)}."
            )
    others = [
        f"{key} ({type(value).__name__})"
        for key, value in content.items()
        if not (isinstance(key, str) and isinstance(value, Tensor))
    ]
    if others:
        raise WeightsError(
            f"{where}: {len(others)} unexpected beside the tensors: {_first(others)}; expected tensors by name only."
        )
    if all(key.startswith("module.") for key in content):  # left by torch's wrapper for several GPUs
        return {key.removeprefix("module."): value for key, value in content.items()}
    return dict(content)


def _is_part(part: str, unexpected: list[str], expected: Iterable[str]) -> bool:
    """Tell whether most of the unexpected keys are expected under the name of a part."""
    known = set(expected)
    return 2 * sum(f"{part}.{key}" in known for key in unexpected) > len(unexpected)


def _first(names: list[str], count: int = 5) -> str:
    return ", ".join(names[:count]) + (", ..." if len(names) > count else "")


def _first_line(error: Exception) -> str:
    return f"{type(error).__name__}: {str(error).strip()}".split("\n")[0].rstrip(".")
