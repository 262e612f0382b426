"""Validation errors in words: the key, what was found, what was expected, and the nearest known name."""

import difflib
import re
from collections.abc import Callable, Iterable
from typing import Any, get_args

from pydantic import BaseModel, ValidationError

_BRANCH = r"literal|str$|list\[|dict\[|constrained"
"""What pydantic adds to the keys of a value that may be of several types."""


def nearest(name: str, known: Iterable[str]) -> str:
    """Return a sentence that names the nearest of the known names, and lists them all."""
    known = sorted(known)
    match = difflib.get_close_matches(name.lower(), known, n=1, cutoff=0.5)
    return (f"Did you mean {match[0]!r}? " if match else "") + f"Known: {', '.join(known) or 'none'}."


def nested_model(annotation: Any) -> type[BaseModel] | None:
    """Return the model in a field's type: `M`, `M | None` and `dict[str, M]` hold M."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next((inner for part in get_args(annotation) if (inner := nested_model(part))), None)


def explain(
    error: ValidationError, model: type[BaseModel], source: str, origin: Callable[[list[str]], str] = lambda keys: ""
) -> str:
    """Return the lines of an error.

    Args:
        source: what was validated, for the first line.
        origin: returns what to add of where the value under some keys comes from.
    """
    lines = []
    for problem in error.errors():
        path = [str(key) for key in problem["loc"]]
        keys = [key for key in path if not re.match(_BRANCH, key)]
        where = ".".join(keys) or source
        of_branch = path != [] and re.match(_BRANCH, path[-1]) is not None
        if problem["type"] == "extra_forbidden":
            line = f"unknown key {where!r}. {nearest(keys[-1], _model_at(model, keys[:-1]).model_fields)}"
        elif problem["type"] == "value_error":
            line = f"{where}: {problem['ctx']['error']}." if keys else f"{problem['ctx']['error']}."
        elif of_branch and problem["type"] in ("literal_error", "string_type") and isinstance(problem["input"], list):
            continue  # the other branch of `"all" | list` or `str | list`, which says what is wrong in the list
        elif of_branch and problem["type"] in ("list_type", "dict_type") and isinstance(problem["input"], list | dict):
            continue  # likewise, of `list | dict`
        elif problem["type"] == "literal_error" and isinstance(problem["input"], str):
            line = f"{where}: found {problem['input']!r}. {nearest(problem['input'], _choices(problem))}"
        elif problem["type"] == "missing":
            line = f"{where}: not given. {problem['msg']}."
        else:
            line = f"{where}: found {problem['input']!r}. {_expected(problem, model, keys)}"
        lines.append(line + origin(keys))
    return "\n  ".join([f"{source}:", *dict.fromkeys(lines)])


def _choices(problem: Any) -> list[str]:
    """Return the words that a value may be, of an error of pydantic."""
    return re.findall(r"'([^']*)'", problem["ctx"]["expected"])


def _expected(problem: Any, model: type[BaseModel], keys: list[str]) -> str:
    """Return what pydantic expected and what the setting means; that alone where pydantic has a regex."""
    fields = _model_at(model, keys[:-1]).model_fields
    meaning = fields[keys[-1]].description if keys and keys[-1] in fields else None
    said = "" if meaning and problem["type"] == "string_pattern_mismatch" else f"{problem['msg']}."
    return f"{said} It is: {meaning}".strip() if meaning else said


def _model_at(model: type[BaseModel], keys: list[str]) -> type[BaseModel]:
    """Return the model of the section under these keys."""
    for key in keys:
        if key in model.model_fields:  # else a name in a mapping of sections
            model = nested_model(model.model_fields[key].annotation) or model
    return model
