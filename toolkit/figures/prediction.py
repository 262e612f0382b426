"""Draw a network's prediction for one query: references, aligned cameras and depth."""

import textwrap
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from toolkit.figures.query_images import draw_image
from toolkit.figures.style import BLUE, GRAY, GREEN, VERMILLION, new_figure, styled
from toolkit.figures.top_view import Ground, Layer, draw_layers, window_of
from toolkit.pose.base import Query
from toolkit.prediction.feed_forward import CameraAnswer, FeedForwardAnswer, FeedForwardLocalizer

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@styled
def draw_prediction(
    localizer: FeedForwardLocalizer, query: Query, answer: FeedForwardAnswer, camera: int | None = None,
    up: ArrayLike | None = None,
) -> "Figure":  # fmt: skip
    """Draw one query image with its references, and the predicted cameras in the map; return the figure.

    By default, it is the image with the most consistent references, and up is estimated from the map's cameras.
    """
    if camera is None:
        counts = [0 if result.alignment is None else result.alignment.num_consistent for result in answer.cameras]
        camera = int(np.argmax(counts)) if counts else 0
    result = answer.cameras[camera] if answer.cameras else CameraAnswer(np.zeros(0, np.int64))
    views = [query.views[camera], *(localizer.view(int(index)) for index in result.references)]
    kept = np.zeros(len(result.references), bool) if result.alignment is None else result.alignment.consistent
    columns = 3
    rows = -(-len(views) // columns)
    figure = new_figure(14, max(5.5, 3.6 * rows))
    left, right = figure.subfigures(1, 2, squeeze=False, width_ratios=[1.0, 1.25])[0]
    _draw_from_above(left.subplots(), localizer, result, kept, up)
    panels = right.subplots(2 * rows, columns, squeeze=False)
    for axis in panels.flat:
        axis.set_axis_off()
    labels = ["query", *(f"reference {k}: {'consistent' if good else 'left out'}" for k, good in enumerate(kept, 1))]
    colors = ["black", *(GREEN if good else VERMILLION for good in kept)]
    for number, (view, label, color) in enumerate(zip(views, labels, colors, strict=True)):
        row, column = 2 * (number // columns), number % columns
        panels[row, column].set_axis_on()
        draw_image(panels[row, column], view.image, 3, label, color, frame=color)
        _draw_depth(panels[row + 1, column], number, result, *localizer.unit)
    simulated, estimate = localizer.predictor.simulated, answer.estimate
    title = f"{'SIMULATED, no result: ' if simulated else ''}{localizer.predictor.name} on {views[0].name}"
    scale = f"scale known to {estimate.scale_std:.1%}" if np.isfinite(estimate.scale_std) else "scale unknown"
    status = estimate.status_text + (f"; {scale}" if estimate.world_from_rig is not None else "")
    reason = "" if result.reason in status else f"; {result.reason}"  # the status of a failed query contains it
    text = textwrap.fill(status + reason, 150)
    figure.suptitle(f"{title}\n{text}", fontsize=10, fontweight="bold" if simulated else None)
    return figure


def _draw_depth(axis: "Axes", number: int, result: CameraAnswer, unit: str, length: float) -> None:
    """Draw the depth predicted of an image, in a unit of this length if the scale is known."""
    prediction, alignment = result.prediction, result.alignment
    if prediction is None or prediction.depth is None or not np.isfinite(prediction.depth[number]).any():
        return
    known = alignment is not None and alignment.scale_known
    scale = alignment.world_from_model.scale / length if alignment is not None and known else 1.0
    values = scale * prediction.depth[number]
    low, high = np.nanpercentile(values, (5, 95))
    extent = None
    if prediction.map_from_image is not None:  # draw in pixels of the image
        scale_x, scale_y, offset_x, offset_y = prediction.map_from_image[number]
        height, width = values.shape
        left, right = -offset_x / scale_x, (width - offset_x) / scale_x
        extent = (left, right, (height - offset_y) / scale_y, -offset_y / scale_y)
    axis.imshow(values, cmap="viridis", vmin=low, vmax=high, extent=extent)
    axis.set_title(f"depth {low:.1f} to {high:.1f} {unit if known else '(no unit)'}", fontsize=7)


def _draw_from_above(
    axis: "Axes", localizer: FeedForwardLocalizer, result: CameraAnswer, kept: NDArray[np.bool_], up: ArrayLike | None
) -> None:
    local_map, alignment = localizer.map, result.alignment
    references = local_map.world_from_cams[result.references]
    ground = Ground.below(local_map.world_from_cams, up, localizer.unit)
    layers, drawn = [Layer(local_map.points, None, "0.73", s=1, lw=0, rasterized=True)], [references]
    layers.append(Layer(local_map.world_from_cams, "map", GRAY, 0.02, s=5))
    layers.append(Layer(references, "reference in the map", BLUE, 0.05, hollow=True, s=60, marker="s"))
    if alignment is not None and result.prediction is not None and np.isfinite(alignment.rotation_std_deg):
        aligned = alignment.world_from_model.apply_to_pose(result.prediction.model_from_cams[1:])
        drawn.append(aligned[kept])
        for agrees, color, label in ((True, GREEN, "consistent"), (False, VERMILLION, "left out")):
            layers.append(Layer(aligned[kept == agrees], f"predicted, {label}", color, 0.05, s=28, zorder=3))
            joined = np.stack([references, aligned], axis=1)[kept == agrees, :, :3, 3]
            layers += [Layer(ends, None, color, track=True, lw=0.8) for ends in joined]
    if result.world_from_cam is not None:
        drawn.append(result.world_from_cam[None])
        layers.append(Layer(result.world_from_cam[None], "query", "black", 0.08, s=90, marker="*", zorder=4))
    # The window ignores cameras that were left out: they may be far away.
    centers = ground.flat(np.concatenate(drawn) if sum(map(len, drawn)) else local_map.world_from_cams)
    draw_layers(axis, ground, layers, window_of(centers, margin=0.5))
    axis.set_title("cameras from above; lines join true and predicted references", fontsize=9)
    axis.grid(alpha=0.2)
    axis.legend(fontsize=7, loc="upper center", bbox_to_anchor=(0.5, -0.08), ncols=3, frameon=False)
