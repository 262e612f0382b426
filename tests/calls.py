"""Calls of stages whose settings stand among the other arguments."""

import inspect
from collections.abc import Callable
from typing import Any


def call(stage: Callable[..., Any], *places: Any, **options: Any) -> Any:
    """Call a stage; what is no argument of it is one of its settings."""
    known = inspect.signature(stage).parameters
    arguments = {name: value for name, value in options.items() if name in known}
    settings = {name: value for name, value in options.items() if name not in known}
    return stage(*places, **({"settings": settings} if settings else {}), **arguments)
