"""Turn validation errors into messages: the key, what was found, what was expected, and the nearest known name."""

import difflib
import re
from collections.abc import Callable, Iterable
from typing import Any, get_args

from pydantic import BaseModel, ValidationError

_BRANCH = r"literal|int$|str$|list\[|dict\[|constrained"
"""Names that pydantic adds to the path of a key whose value may have several types."""


def nearest(name: str, known: Iterable[str]) -> str:
    """Return a sentence that suggests the known name nearest to `name`, and lists all known names."""
    known = sorted(known)
    match = difflib.get_close_matches(name.lower(), known, n=1, cutoff=0.5)
    return (f"Did you mean {match[0]!r}? " if match else "") + f"Known: {', '.join(known) or 'none'}."


def nested_model(annotation: Any) -> type[BaseModel] | None:
    """Return the model in a field's type: M for `M`, `M | None` and `dict[str, M]`; None without a model."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next((inner for part in get_args(annotation) if (inner := nested_model(part))), None)


def explain(
    error: ValidationError, model: type[BaseModel], source: str, origin: Callable[[list[str]], str] = lambda keys: ""
) -> str:
    """Return the message of a validation error of the file or class `source`, one line per problem; `origin` maps the
    keys of a value to a suffix that says where the value comes from.
    """
    lines = list[str]()
    for problem in error.errors():
        path = [str(key) for key in problem["loc"]]
        keys = [key for key in path if not re.match(_BRANCH, key)]
        where = ".".join(keys) or source
        of_branch = path != [] and re.match(_BRANCH, path[-1]) is not None
        if problem["type"] == "extra_forbidden":
            line = f"unknown key {where!r}{_why_unknown(keys[-1], _model_at(model, keys[:-1]))}"
        elif problem["type"] == "value_error":
            line = f"{where}: {problem['ctx']['error']}." if keys else f"{problem['ctx']['error']}."
        elif of_branch and problem["type"] in ("literal_error", "string_type") and isinstance(problem["input"], list):
            continue  # of `"all" | list` or `str | list`; the list branch reports what is wrong in the list
        elif of_branch and problem["type"] in ("list_type", "dict_type") and isinstance(problem["input"], list | dict):
            continue  # likewise for `list | dict`
        elif problem["type"] == "literal_error" and isinstance(problem["input"], str):
            choices = re.findall(r"'([^']*)'", problem["ctx"]["expected"])
            line = f"{where}: found {problem['input']!r}. {nearest(problem['input'], choices)}"
        elif problem["type"] == "missing":
            line = f"{where}: not given. {problem['msg']}."
        else:
            line = f"{where}: found {problem['input']!r}. {_expected(problem, model, keys)}"
            if lines and lines[-1].startswith(f"{where}: found {problem['input']!r}. Input should be "):
                # Another type that the value may have.
                lines[-1] = lines[-1].replace(" Input should be", f" {problem['msg']} or", 1)
                continue
        lines.append(line + origin(keys))
    return "\n  ".join([f"{source}:", *dict.fromkeys(lines)])


def _why_unknown(name: str, model: type[BaseModel]) -> str:
    """Return the end of a message: the file if a former setting is a constant now, else the known keys."""
    files = [file for file, names in getattr(model, "constants", {}).items() if name in names.split()]
    if files:
        return f": it is no setting any more, but a constant in toolkit/{files[0]}."
    return f". {nearest(name, model.model_fields)}"


def _expected(problem: Any, model: type[BaseModel], keys: list[str]) -> str:
    """Return what pydantic expected and the description of the setting; only the description instead of a regex."""
    fields = _model_at(model, keys[:-1]).model_fields
    meaning = " ".join((fields[keys[-1]].description or "").split()) if keys and keys[-1] in fields else ""
    expected = "" if meaning and problem["type"] == "string_pattern_mismatch" else f"{problem['msg']}."
    return f"{expected} Meaning: {meaning}".strip() if meaning else expected


def _model_at(model: type[BaseModel], keys: list[str]) -> type[BaseModel]:
    """Return the model of the section under these keys."""
    for key in keys:
        if key in model.model_fields:  # else it is a key of a mapping of sections
            model = nested_model(model.model_fields[key].annotation) or model
    return model
