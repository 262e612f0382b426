"""Read a manifest; resolve inheritance, paths, environment variables and `--set`."""

import itertools
import os
import re
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError

from toolkit.errors import ManifestError
from toolkit.files import RUN_FILES, shipped, write_text
from toolkit.manifest.manifest import Manifest
from toolkit.manifest.settings import expand, explain, merge, nearest

PATHS = ("captures", "output_root", "retrieve.mask.poses")
"""Keys whose values are paths; the keys of checkpoints are paths too."""
MOST_VALUES = 100_000
"""Largest number of values in a manifest: nested YAML aliases can expand to so many that they fill the memory."""


def load_manifest(path: str | Path, overrides: Iterable[str] = ()) -> Manifest:
    """Read and check a manifest and make its paths absolute.

    `inherits: FILE` (or a list of files, relative to the manifest) merges the manifest over those files: sections key
    by key, while lists and values are replaced. A path is relative to the folder of the file that contains it.

    Args:
        overrides: `key=value` or `section.key=value` at any depth, the value in YAML; merged over the file. Their paths
            are relative to the working directory, where the user types them.

    Raises:
        ManifestError: names the file (also the inherited one), the key, what was found, and the nearest known key.
    """
    path, overrides = Path(path), list(overrides)
    source = " ".join([f"{path} with --set" if overrides else f"{path}", *overrides])
    chain = _read_chain(path, ())
    # `output_root` is a path like any other.
    raw: dict[str, Any] = {"name": path.stem, "output_root": Manifest.model_fields["output_root"].default}
    typed = [_anchor(_read_override(override), Path.cwd()) for override in overrides]
    for content in [*(content for _, content in chain), *typed]:
        raw = merge(raw, expand(Manifest, content))
    raw = _map_paths(raw, lambda text, key: str(_expand(text, path.resolve().parent, f"{source}: {key}")))
    try:
        manifest = Manifest.model_validate(raw)
    except ValidationError as error:

        def origin(keys: list[str]) -> str:
            """Name the inherited file that sets a key; empty if the manifest itself does."""
            setter = next((file for file, content in reversed(chain) if _has(content, keys)), path)
            return "" if setter == path else f" (in {setter}, which it inherits)"

        raise ManifestError(explain(error, Manifest, source, origin)) from None
    names = [Path(capture).name for capture in manifest.captures]
    for name in names:
        found = f"two folders called {name!r}, so their results would overwrite each other"
        if name in RUN_FILES:
            found = f"a folder called {name!r}, as a file of the run itself"
        if name in RUN_FILES or names.count(name) > 1:
            raise ManifestError.at(f"{source}: captures", found, do="Rename one, or name a link to it.")
    return manifest


def find_manifest(given: str | Path) -> Path:
    """Return the path of a manifest that is given by its path or by its name, such as `demo`.

    One that is not here but comes with the toolkit is copied to `data_manifests/` first, with those that it inherits,
    so that its data and runs are here, too, and a user can see and change it. Raise ManifestError if there is none.
    """
    path, folder = Path(given), Path("data_manifests")
    name = path.name if path.suffix in (".yaml", ".yml") else f"{path.name}.yaml"
    if path.is_file() or path.parent not in (Path(), folder):
        return path
    if (folder / name).is_file():
        return folder / name
    own = shipped("data_manifests")
    if not (own / name).is_file():
        known = sorted({one.stem for one in (*folder.glob("*.yaml"), *own.glob("*.yaml"))})
        raise ManifestError(f"{given}: no such manifest. {nearest(Path(name).stem, known)}")
    for file, _ in reversed(_read_chain(own / name, ())):
        target = folder / os.path.relpath(file, own)
        if not target.exists():
            write_text(target, file.read_text(encoding="utf-8"))
    return folder / name


Chain = list[tuple[Path, dict[str, Any]]]
"""The files of a manifest and their own contents, inherited files first; a later file wins."""


def _read_chain(path: Path, heirs: tuple[Path, ...]) -> Chain:
    if path.resolve() in [heir.resolve() for heir in heirs]:
        circle = " inherits ".join(map(str, (*heirs, path)))
        raise ManifestError(f"{circle}: a manifest cannot inherit from itself. Remove one of these `inherits`.")
    raw = _read_yaml(path, heirs[-1] if heirs else None)
    bases = raw.pop("inherits", [])
    bases = [bases] if isinstance(bases, str) else bases
    if not (isinstance(bases, list) and all(isinstance(base, str) for base in bases)):
        raise ManifestError(f"{path}: inherits: found {bases!r}, expected a file name or a list of them.")
    chain: Chain = []
    for base in bases:
        file = _expand(base, path.parent, f"{path}: inherits")
        chain += _read_chain(file, (*heirs, path))
    return [*chain, (path, _anchor(raw, path.resolve().parent) if heirs else raw)]


def _map_paths(raw: dict[str, Any], change: Callable[[str, str], str], where: str = "") -> dict[str, Any]:
    """Return raw values with every path replaced by `change(path, key)`."""
    changed: dict[str, Any] = {}
    for name, value in raw.items():
        key = f"{where}{name}"
        if isinstance(value, dict):
            value = _map_paths(value, change, f"{key}.")
        elif re.search(r"checkpoint(\.\w+)?$", key) or key in PATHS:
            if isinstance(value, list):
                value = [change(text, key) if isinstance(text, str) else text for text in value]
            elif isinstance(value, str):
                value = change(value, key)
        changed[name] = value
    return changed


def _anchor(raw: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Return the values of an inherited file, or of `--set`, with paths made absolute, relative to a folder."""

    def anchor(text: str, key: str) -> str:
        if text.startswith("~") or "$" in os.path.expandvars(text):
            return text  # expanded or refused at the end, because an heir may replace it
        return os.path.normpath(folder / os.path.expandvars(text))

    return _map_paths(raw, anchor)


def _read_yaml(path: Path, heir: Path | None = None) -> dict[str, Any]:
    where = f"{heir}: inherits {path}" if heir else f"{path}"
    try:
        raw = _parse_yaml(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ManifestError(f"{where}: no such manifest. `demo` is an example.") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ManifestError(f"{where}: cannot be read as a text file ({error}).") from None
    except yaml.YAMLError as error:
        text = str(error).replace('"<unicode string>"', str(path))
        raise ManifestError(f"{where}: not valid YAML. {text}") from None
    if not isinstance(raw, dict):
        raise ManifestError(f"{path}: found {type(raw).__name__}, expected `key: value` lines.")
    return raw


def _parse_yaml(text: str) -> Any:
    """Return the content of a YAML text; raise yaml.YAMLError for an invalid one, or for aliases that expand to too
    much.
    """
    loader = yaml.SafeLoader(text)
    try:
        node = loader.get_single_node()
        if node is None:
            return None
        if _size(node, {}) > MOST_VALUES:
            raise yaml.YAMLError(f"Its aliases expand to more than {MOST_VALUES:,} values.")
        _require_single_keys(node, set())
        return loader.construct_document(node)
    except RecursionError:
        raise yaml.YAMLError("It is nested too deeply, or an alias contains itself.") from None
    except (ValueError, LookupError, AttributeError, TypeError) as error:  # 2024-99-99, or !!int of no number
        raise yaml.YAMLError(f"A value does not fit its type ({error}).") from None


def _require_single_keys(node: yaml.Node, seen: set[int]) -> None:
    """Raise YAMLError if a mapping has a key twice: PyYAML silently takes the last."""
    if id(node) in seen or not isinstance(node, yaml.CollectionNode):
        return
    seen.add(id(node))
    if isinstance(node, yaml.MappingNode):
        first: dict[tuple[str, str], yaml.Node] = {}
        for key, value in node.value:
            plain = isinstance(key, yaml.ScalarNode) and key.tag != "tag:yaml.org,2002:merge"
            if plain and (other := first.setdefault((key.tag, key.value), key)) is not key:
                found = f"The key {key.value!r} is there twice, first in line {other.start_mark.line + 1}"
                raise yaml.MarkedYAMLError(problem=f"{found}; keep one of them", problem_mark=key.start_mark)
            _require_single_keys(value, seen)
    else:
        for value in node.value:
            _require_single_keys(value, seen)


def _size(node: yaml.Node, sizes: dict[int, int]) -> int:
    """Return the number of values in a node with its aliases expanded; `sizes` caches it by the node's id."""
    if id(node) not in sizes:
        entries = node.value if isinstance(node, yaml.CollectionNode) else []
        children = itertools.chain.from_iterable(entry if isinstance(entry, tuple) else (entry,) for entry in entries)
        sizes[id(node)] = 1 + sum(_size(child, sizes) for child in children)
    return sizes[id(node)]


def _read_override(override: str) -> dict[str, Any]:
    """Return `section.key=value` as nested sections."""
    key, equals, text = override.partition("=")
    if not equals or not key.strip():
        raise ManifestError.at(f"--set {override}", expected="key=value, for example localize.method=nearest")
    try:
        value = _parse_yaml(text)
    except yaml.YAMLError as error:
        raise ManifestError(f"--set {override}: the value is not valid YAML. {error}") from None
    return nested({key.strip(): value})


def nested(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return values by keys such as `localize.pnp.seed` as nested sections; values may be sections, too."""
    sections: dict[str, Any] = {}
    for key, value in values.items():
        for name in reversed(str(key).split(".")):
            value = {name: value}
        sections = merge(sections, value)
    return sections


def _has(content: Any, keys: list[str]) -> bool:
    """Tell whether the content of a file sets these keys itself."""
    for key in keys:
        if isinstance(content, list):
            return True
        if not isinstance(content, dict) or key not in content:
            return False
        content = content[key]
    return True


def _expand(text: str, folder: Path, where: str) -> Path:
    expanded = os.path.expandvars(text)
    if unset := re.search(r"\$\{?(\w+)\}?", expanded):
        found = f"the variable ${unset[1]}, which is not set, in {text!r}"
        raise ManifestError.at(where, found, do=f"Set it (export {unset[1]}=...) or write the folder itself.")
    try:
        path = Path(expanded).expanduser()
    except RuntimeError:
        raise ManifestError(f"{where}: {text!r} names an unknown user. Write the folder itself.") from None
    if "\0" in expanded:
        raise ManifestError(f"{where}: {text!r} is not a path: it contains a zero byte.")
    return Path(os.path.normpath(folder / path))
