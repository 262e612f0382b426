"""JupyterLab's settings, as `make lab` starts it."""

import warnings

from toolkit.runs.lab import drop_widgets

# Jupyter reads this file twice, and would tell that the second time replaces the first.
warnings.filterwarnings("ignore", "Overriding existing pre_save_hook")
c = get_config()  # type: ignore[name-defined]  # noqa: F821 - Jupyter's, where it reads this file
c.ContentsManager.pre_save_hook = drop_widgets
