"""JupyterLab's settings, as `make lab` starts it."""

from toolkit.runs.lab import drop_widgets

c = get_config()  # type: ignore[name-defined]  # noqa: F821 - Jupyter's, where it reads this file
c.ContentsManager.pre_save_hook = drop_widgets
