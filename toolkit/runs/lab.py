"""JupyterLab: keep widgets out of saved notebooks."""

from typing import Any

WIDGET = "application/vnd.jupyter.widget-view+json"


def drop_widgets(model: dict[str, Any], **_: Any) -> None:
    """Remove widgets (progress bars, viewers) from a notebook that is about to be saved.

    A saved widget is only a reference to a live page: reopened, it shows `Error displaying widget`. Jupyter calls this
    as `ContentsManager.pre_save_hook`, see `notebooks/lab_config.py`.

    Args:
        model: Jupyter's contents model; its `content`, the notebook, is changed in place.
    """
    if model.get("type") != "notebook" or not isinstance(model.get("content"), dict):
        return
    for cell in model["content"].get("cells", []):
        if "outputs" in cell:
            cell["outputs"] = [output for output in cell["outputs"] if WIDGET not in output.get("data", {})]
    model["content"].get("metadata", {}).pop("widgets", None)
