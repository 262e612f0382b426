"""JupyterLab on copies of the notebooks: what of a copy is saved."""

from typing import Any

WIDGET = "application/vnd.jupyter.widget-view+json"


def drop_widgets(model: dict[str, Any], **_: Any) -> None:
    """Remove widgets (progress bars, viewers) from a notebook that is about to be saved; all else stays.

    A file has no widgets, only references to those of a living page: opened again, each would be an `Error displaying
    widget`. It is called by Jupyter as `ContentsManager.pre_save_hook`, see `notebooks/lab_config.py`.

    Args:
        model: of Jupyter's contents; `content` of a notebook is that of its file, and is changed.
    """
    if model.get("type") != "notebook" or not isinstance(model.get("content"), dict):
        return
    for cell in model["content"].get("cells", []):
        if "outputs" in cell:
            cell["outputs"] = [output for output in cell["outputs"] if WIDGET not in output.get("data", {})]
    model["content"].get("metadata", {}).pop("widgets", None)
