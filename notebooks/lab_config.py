"""JupyterLab's settings, as `make lab` starts it."""

import warnings
from typing import Any

WIDGET = "application/vnd.jupyter.widget-view+json"


def drop_widgets(model: dict[str, Any], **_: Any) -> None:
    """Remove widgets (progress bars, viewers) from a notebook that is about to be saved; their pictures stay.

    A saved widget is only a reference to a live page: reopened, it shows `Error displaying widget`.

    Args:
        model: Jupyter's contents model; its `content`, the notebook, is changed in place.
    """
    if model.get("type") != "notebook" or not isinstance(model.get("content"), dict):
        return
    for cell in model["content"].get("cells", []):
        if "outputs" in cell:
            for output in cell["outputs"]:
                if WIDGET in output.get("data", {}):
                    kinds = [kind for kind in output["data"] if kind.startswith("image/")]
                    output["data"] = {kind: output["data"][kind] for kind in kinds}
            cell["outputs"] = [output for output in cell["outputs"] if output.get("data", True)]
    model["content"].get("metadata", {}).pop("widgets", None)


# Jupyter reads this file twice, and would tell that the second time replaces the first.
warnings.filterwarnings("ignore", "Overriding existing pre_save_hook")
c = get_config()  # type: ignore[name-defined]  # noqa: F821 - Jupyter's, where it reads this file
c.ContentsManager.pre_save_hook = drop_widgets
c.ServerApp.allow_root = True  # as in containers; whoever may run make may run this
