"""The command line: `visloc run|lab|compare|settings|check|new|import|export|...`, or `python -m toolkit ...`."""

import inspect
import json
import os
import re
import signal
import sys
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict
from functools import partial, wraps
from importlib import import_module
from pathlib import Path
from types import FrameType
from typing import Annotated, Any

try:
    import typer
    from typer import Argument, Option

    from toolkit import __version__
    from toolkit.errors import (
        COMMAND,
        COMMAND_VARIABLE,
        ArtifactError,
        IncompleteError,
        ManifestError,
        ToolkitError,
        exit_code,
        optional,
        sentence,
    )
except ModuleNotFoundError as missing:  # users may run `python -m toolkit` with the wrong Python
    do = "Use the Python that the toolkit is installed for: .venv/bin/python -m toolkit, if `make` installed it."
    raise SystemExit(f"Error: {sys.executable} has no package {missing.name}. {do}") from None

app = typer.Typer(
    no_args_is_help=True, pretty_exceptions_enable=False, context_settings={"help_option_names": ["-h", "--help"]}
)


import_app = typer.Typer(help="Make a session from your own images.", no_args_is_help=True)
export_app = typer.Typer(help="Write files for other tools.", no_args_is_help=True)
app.add_typer(import_app, name="import")
app.add_typer(export_app, name="export")

USAGE, INTERRUPTED = 2, 130
"""Exit codes of typer: a wrong option; Ctrl-C."""

_CAM = "'MODEL, W, H, ...'"
Device = Annotated[str, Option(help="Device type: ios, hl, spot or another name.")]
Placing = Annotated[str, Option("--images", metavar="link|copy", help="Link to the images, or copy them.")]
_MASKS = "Folder of masks, black where to use no features: 1.jpg.png of 1.jpg. Default: `masks` beside or in IMAGES."
Masks = Annotated[Path | None, Option(help=_MASKS)]
Run = Annotated[Path, Argument(help="Run folder.")]
Scene = Annotated[str, Argument(help="Name of the capture.")]
MapDevice = Annotated[str, Argument(help="Map device.")]
QueryDevice = Annotated[str, Argument(help="Query device.")]
TextFile = Annotated[Path, Argument(help="Text file.")]
Hdf5File = Annotated[Path, Argument(help="HDF5 file.")]
Kind = Annotated[str, Option(help="Kind of features.")]
_AXES = "Camera axes of the poses. opencv: x right, y down, z forward; opengl: x right, y up, z backward."
Axes = Annotated[str, Option("--axes", metavar="opencv|opengl", help=_AXES)]
_DIRECTION = "Direction of the table's poses; the last has camera centers, as NVM, Bundler and Cambridge have them."
ImportedTo = Annotated[Path, Argument(help="Capture folder; the session is sessions/<device>_<split>.")]
_SPLIT = "A map needs poses; those of queries become ground truth."
Split = Annotated[str, Option(metavar="map|query", help=_SPLIT)]
Unit = Annotated[float | None, Option("--unit", metavar="METERS", help="Meters per unit of the poses if known.")]
MeterUnit = Annotated[float, Option("--unit", metavar="METERS", help="Meters per unit of the poses, e.g. 0.01.")]
Replace = Annotated[bool, Option("--replace", help="Replace the session if it exists.")]
ReportJson = Annotated[bool, Option("--json", help="Print the report as JSON, as in proc/import.json.")]
_ALIKE = "Take files whose names differ only in case, extension or separators."
_GPS = "Move the world to x east, y north, z up, in meters, by GPS in EXIF."
Positions = Annotated[Path | None, Option(help="CSV: image,x,y,z, known camera centers in meters.")]
_TIMES = "Times of the images: the last numbers in their names, or a file with time and name in each line."
_FIXES = "GPS: CSV with image or timestamp, latitude, longitude, altitude, accuracy; or exif."
_APPLIED = "Undo applied_transform and applied_scale, by which nerfstudio has changed the world of its input."
_NAMES = "Name imported images as in your folder (own), or as in the capture (capture)."
Names = Annotated[str, Option("--names", metavar="own|capture|file", help=_NAMES)]
Settings = Annotated[
    list[str] | None, Option("--set", metavar="KEY=VALUE", help="Replace a setting; `run`: in a new run.")
]
Capture = Annotated[Path | None, Option(help="Capture folder, if it has moved since the run.")]
Json = Annotated[bool, Option("--json", help="Print only a summary as JSON to stdout, everything else to stderr.")]
_CLUSTER = "Dask workers: N on this machine, of a scheduler, or started by a cluster's queue (see docs/scaling.md)."
_KINDS = "7scenes, 12scenes, cambridge, aachen, eth3d, tum, kitti, euroc; strecha or strecha-hard: three devices."
_ONLY = "Run only these stages; `map`: build the maps without queries, for `localize`."
_MANIFEST = "Manifest: a file, or the name of one in data_manifests/ or of the toolkit's own, such as demo."
_SWEEP = "Run once per value, each in its own folder, and compare. Repeat it to run all combinations."
_FAILED = (
    "What to write for a query without a pose. `nearest`, the default: the pose of its best retrieved reference, as "
    "recall counts a missing pose as a miss, so a rough pose cannot reduce it, and the submission is complete. The "
    "description gives the number of such queries, and submission.csv lists them. `leave-out`: nothing."
)
_SOURCES = "Image files, folders of images (a camera each) and videos; the last one is the folder of the new capture."
_HELD_OUT = "Every Nth photograph becomes a query with truth, and the map is run and evaluated on them; 0: none."
_REMOVE = "Remove the images of a folder, file or video that was added; give only CAPTURE."
_KNOWN = "CSV: image,model,width,height,params, or hloc's list: known cameras."
_PRIOR = "CSV: image,qw,qx,qy,qz,tx,ty,tz of a device's tracking, meters; the map gets its world."
_RIG = "`folders`: each is a camera of one rig, equal names were taken at once; or COLMAP's rig_config.json."
_DISTANCE = "Meters between two points, given by a pixel each, or between the cameras of two images."
_TABLE = "CSV with a header: image; qw,qx,qy,qz,tx,ty,tz for poses; camera_id, or model,width,height,params."


def _version(asked: bool) -> None:
    if asked:
        print(f"visual-localization {__version__}")
        raise typer.Exit


@app.callback()
def _common(
    version: Annotated[bool, Option("--version", callback=_version, is_eager=True, help="Show the version.")] = False,
) -> None:
    """Visual localization: find where images were taken in a map of images with known poses."""


@app.command()
def run(
    manifest: Annotated[str, Argument(help=_MANIFEST)],
    only: Annotated[str | None, Option(metavar="STAGE,...", help=_ONLY)] = None,
    force: Annotated[bool, Option("--force", help="Also run stages that are up to date.")] = False,
    overrides: Settings = None,
    name: Annotated[str | None, Option(help="Name of the run folder; default: says what --set changes.")] = None,
    in_place: Annotated[bool, Option("--in-place", help="With --set: replace the manifest's own results.")] = False,
    cluster: Annotated[str | None, Option(metavar="local[:N]|tcp://HOST:PORT|slurm:FILE", help=_CLUSTER)] = None,
    sweeps: Annotated[list[str] | None, Option("--sweep", metavar="KEY=A,B,C", help=_SWEEP)] = None,
    as_json: Json = False,
) -> None:
    """Run the notebooks of a manifest, skip what is up to date, and write a report.

    Exit codes: 0 done; 1 an error that you can fix, as the message says; 2 done, but more images, queries or pairs
    failed than the manifest tolerates (`tolerate_failed`); 3 a bug; 130 or 143 interrupted.
    """
    from toolkit import pipeline
    from toolkit.manifest import find_manifest
    from toolkit.runs.folder import summary

    tell = partial(print, file=sys.stderr) if as_json else print
    path = Path(manifest)
    try:
        path = find_manifest(manifest)
        if sweeps and (name or in_place):
            raise ManifestError("--sweep names its runs itself: leave out --name and --in-place.")
        if sweeps:
            _compare_swept(*pipeline.sweep(path, sweeps, overrides or (), tell, only, force, cluster), tell, as_json)
            return
        run_dir = pipeline.run(path, only, force, overrides or (), tell, cluster, name, in_place)
    except BaseException as error:
        if as_json:
            status = {IncompleteError: "incomplete", KeyboardInterrupt: "interrupted"}.get(type(error), "failed")
            outcome = {"status": status, "exit_code": exit_code(error), "error": sentence(error)}
            _print_json(_summary_of_stopped(path, overrides or (), name, in_place) | outcome)
        raise
    tell(f"Report: {run_dir / 'report.html'}")
    if only == pipeline.MAP:
        tell(f"Localize a photograph: {COMMAND} localize {run_dir} PHOTOGRAPH")
    result = summary(run_dir)
    if as_json:
        _print_json(result)
    if result["exit_code"] != 0:
        raise IncompleteError(result["error"])


@app.command()
def localize(
    run: Run,
    photographs: Annotated[list[Path], Argument(help="Image files.")],
    device: Annotated[str | None, Option(help="Map device; default: the first of the run.")] = None,
    scene: Annotated[str | None, Option(help="Capture; default: the run's only one.")] = None,
    camera: Annotated[str | None, Option(metavar=_CAM, help="Intrinsics; default: estimated from the matches.")] = None,
    picture: Annotated[Path | None, Option(help="Image file to write: the map and the poses, from above.")] = None,
    as_json: Json = False,
) -> None:
    """Localize photographs in the map of a run, which is not changed."""
    import numpy as np

    from toolkit.capture import parse_camera
    from toolkit.errors import CameraError, CaptureError
    from toolkit.exchange.georeference import GEO_COLUMNS, deviation_of, geographic_poses, origin_of
    from toolkit.geometry import qt_from_pose
    from toolkit.scene import Run as FinishedRun
    from toolkit.scene import localize_images

    try:
        given = None if camera is None else parse_camera("camera", camera)
    except ValueError as error:
        raise CameraError(f"camera: {error}") from None
    scene_map = FinishedRun.open(run).map(device, scene)
    origin, place_std_m = None, deviation_of(scene_map.session)
    with suppress(CaptureError):
        origin = origin_of(scene_map.session)
    rows, poses = list[dict[str, Any]](), list[Any]()
    for path, result in zip(photographs, localize_images(scene_map, photographs, given), strict=True):
        row: dict[str, Any] = {"image": str(path), "status": result.status_text, "world_from_cam": None}
        row |= {"inliers": result.num_inliers, "remark": result.remark}
        if result.world_from_rig is not None:
            poses.append(result.world_from_rig)
            unknown = {} if scene_map.settings.unit else {"unit": "unknown"}  # as in a table of poses
            row |= {"world_from_cam": result.world_from_rig.tolist(), **unknown}
            row["position_std" if unknown else "position_std_m"] = result.position_std
            if origin is not None:
                geo = geographic_poses(poses[-1][None], origin)[0].tolist()
                row |= {name: None if np.isnan(one) else one for name, one in zip(GEO_COLUMNS, geo, strict=True)}
                row["geographic_std_m"] = float(np.hypot(result.position_std, place_std_m))
        rows.append(row)
        if not as_json:
            print(f"{path}: {row['status']}. {row['remark']}".strip())
            if row["world_from_cam"] is not None:
                qw, qx, qy, qz, *xyz = qt_from_pose(np.array(row["world_from_cam"])).tolist()
                print(f"  position {xyz[0]:.3f} {xyz[1]:.3f} {xyz[2]:.3f}, qw qx qy qz "
                      f"{qw:.5f} {qx:.5f} {qy:.5f} {qz:.5f}, {row['inliers']} inliers")  # fmt: skip
                if origin is not None:
                    print(f"  latitude {geo[0]:.7f}, longitude {geo[1]:.7f}, altitude {geo[2]:.2f} m, "
                          f"heading {geo[3]:.1f}, pitch {geo[4]:.1f} degrees")  # fmt: skip
                    print(f"  good to {row['geographic_std_m']:.2f} m, with the GPS that placed the map")
    if picture is not None:
        from toolkit.figures.top_view import draw_scene
        from toolkit.results.localized import sure_points

        cloud = sure_points(scene_map.mapped[0].map if scene_map.mapped else None)
        found = np.array(poses).reshape(-1, 4, 4)
        title = f"Photographs in the map, from above: {len(poses)} of {len(rows)} have a pose"
        unit = ("m" if scene_map.capture.unit else "unknown unit", 1.0)
        cameras = scene_map.session.world_from_cam()
        draw_scene(*cloud, cameras, found, np.full_like(found, np.nan), title=title, unit=unit).savefig(picture)
        print(f"Picture: {picture}", file=sys.stderr if as_json else sys.stdout)
    if as_json:
        _print_json({"run": str(run), "photographs": rows})


@app.command()
def compare(
    runs: Annotated[list[Path], Argument(help="Two or more run folders, compared with the first.")],
    out: Annotated[Path | None, Option(help="HTML file; default: compare_<names>.html by the first run.")] = None,
    pictures: Annotated[int, Option(min=0, help="Number of queries won or lost to draw, per run.")] = 4,
    seed: Annotated[int, Option(min=0, help="Seed of the resampling for the intervals.")] = 0,
    as_json: Json = False,
) -> None:
    """Compare runs: recall with intervals, queries won and lost, time, memory, settings. Write notebook and page."""
    _compare(runs, print, as_json, out, pictures, seed)


@app.command()
def settings(branch: Annotated[str, Argument(help="Only these, e.g. localize or localize.pnp.")] = "") -> None:
    """Show all settings of a manifest with their meanings and defaults, as YAML to copy into a manifest."""
    from toolkit.manifest import Manifest, describe, nearest
    from toolkit.manifest.settings import nested_model

    model: Any = Manifest
    keys = branch.split(".") if branch else []
    for key in keys:
        inner = {name: of for name, field in model.model_fields.items() if (of := nested_model(field.annotation))}
        if key not in inner:
            raise ManifestError(f"settings {branch}: no section {key!r}. {nearest(key, inner)}")
        model = inner[key]
    heads = [f"{'  ' * depth}{key}:" for depth, key in enumerate(keys)]
    print("\n".join([*heads, *describe(model, "  " * len(keys))]))


@app.command(context_settings={"allow_extra_args": True, "ignore_unknown_options": True})
def lab(context: typer.Context) -> None:
    """Open JupyterLab on your own copies of the notebooks, in lab/; further options go to JupyterLab."""
    from toolkit.files import shipped
    from toolkit.manifest import find_manifest
    from toolkit.notebook import copy_notebooks

    optional("jupyterlab")
    find_manifest("demo")  # makes this folder the one whose runs/ the notebooks see
    for message in copy_notebooks(Path("lab")):
        print(message)
    # The page shows the whole folder, so that links from a notebook to a run's report and recordings work.
    options = [f"--config={shipped('notebooks') / 'lab_config.py'}", "--notebook-dir", ".", *context.args]
    os.execv(sys.executable, [sys.executable, "-m", "jupyterlab", *options, "lab/start.ipynb"])


@app.command()
def report(run_dir: Annotated[Path, Argument(metavar="RUN", help="Run folder, for example runs/demo.")]) -> None:
    """Write the report of a run again from its folder."""
    from toolkit.report.page import write_report

    print(f"Report: {write_report(run_dir)}")


@app.command()
def check(
    capture: Annotated[Path, Argument(help="Capture folder, with sessions/ in it.")],
    deep: Annotated[bool, Option("--deep", help="Decode the images completely, not only their headers.")] = False,
    as_json: Json = False,
) -> None:
    """Show the content of a capture and all its inconsistencies, with file and line."""
    from toolkit.capture.check import check_capture

    report = check_capture(capture, deep)
    if as_json:
        _print_json({"capture": str(capture), "ok": report.ok, "problems": [asdict(row) for row in report.problems]})
    else:
        print(report.text())
    if not report.ok:
        raise typer.Exit(1)


@app.command()
def new(
    name: Annotated[str, Argument(help="Name of the manifest and its run, runs/<name>: letters, digits, -, _.")],
    capture: Annotated[Path | None, Argument(help="Capture folder; default: NAME, else a line to fill in.")] = None,
    out: Annotated[Path, Option(help="Folder of the manifest.")] = Path("data_manifests"),
) -> None:
    """Write a manifest for a capture, with explanations and the findings of `check`."""
    from toolkit.exchange.import_report import new_manifest

    if capture is None and Path(name, "sessions").is_dir():
        capture = Path(name)
    path = new_manifest(name, capture, out)
    print(f"Manifest: {path}{'' if capture else '. Name your capture in it.'}\nRun it: {COMMAND} run {path}")


@app.command()
def submit(
    runs: Annotated[list[Path], Argument(help="Run folders; scenes may be distributed over several.")],
    description: Annotated[str, Option(metavar="TEXT|FILE", help="Method, thresholds, link to the code.")] = "",
    out: Annotated[Path | None, Option(help="Zip file; default: RUN/submission.zip.")] = None,
    failed: Annotated[str, Option(metavar="nearest|leave-out", help=_FAILED)] = "nearest",
    queries: Annotated[str | None, Option(help="List of the query keyframes; default: the challenge's.")] = None,
    scene: Annotated[list[str] | None, Option(help="Only this scene; repeat for more.")] = None,
    capture: Annotated[list[Path] | None, Option(help="Capture folder, if it has moved since the run.")] = None,
    sequence: Annotated[bool, Option("--sequence", help="Use the poses of the stage `sequence`.")] = False,
    dry_run: Annotated[bool, Option("--dry-run", help="Show what would be in the zip, write nothing.")] = False,
) -> None:
    """Check the poses of runs and write the zip file for the challenge; list missing pairs."""
    from toolkit.exchange.submission import collect

    if not description.strip() and not dry_run:
        raise ManifestError("--description is missing: give a text or a file. The challenge requires a description.")
    submission = collect(runs, description, out, failed, queries, scene or (), capture or (), sequence)
    print(submission.text())
    if not dry_run:
        print(f"Submission: {submission.write()}")


@app.command()
def download(
    manifest: Annotated[str, Argument(help="Manifest with `dataset`: a file, or a name such as crocodl-hydro.")],
    sessions: Annotated[str, Option(metavar="NAME,...", help="Only these, e.g. ios_map,hl_query.")] = "",
    dry_run: Annotated[bool, Option("--dry-run", help="List files and sizes; fetch nothing.")] = False,
    overrides: Settings = None,
) -> None:
    """Download, unpack and check the captures of a manifest; resume a stopped download."""
    from toolkit.datasets.download import download
    from toolkit.manifest import find_manifest

    names = [name.strip() for name in sessions.split(",") if name.strip()]
    reports = download(find_manifest(manifest), names, dry_run, overrides or ())
    if not all(report.ok for report in reports):
        raise typer.Exit(1)


@app.command()
def demo_data(
    out: Annotated[Path, Option(help="Capture folder to write.")],
    rooms: Annotated[int, Option(min=1, help="Number of rooms.")] = 2,
    frames: Annotated[int, Option(min=2, help="Frames per room and map session.")] = 12,
    seed: Annotated[int, Option(min=0, help="Random seed; another seed gives other rooms.")] = 0,
    alike: Annotated[bool, Option("--alike", help="The last room looks exactly like the first.")] = False,
    hard: Annotated[bool, Option("--hard", help="Add hard images: dark, blurred, torn, elsewhere, ...")] = False,
    seconds: Annotated[int, Option(min=0, help="Length of a query recording; adds odometry between images.")] = 0,
    losses: Annotated[int, Option(min=0, help="Tracking losses per query recording.")] = 0,
    gaps: Annotated[int, Option(min=0, help="Gaps of 4 s in the odometry of a query recording.")] = 0,
    radio: Annotated[bool, Option("--radio", help="Add scans of WiFi and Bluetooth.")] = False,
) -> None:
    """Render a capture with exact ground truth, for demos, tests and benchmarks."""
    from toolkit.synthetic import render_capture

    capture = render_capture(
        out, rooms, frames, seed, alike=alike, hard=hard, seconds=seconds, losses=losses, gaps=gaps, radio=radio
    )
    print(f"Capture: {capture}")


def importer(name: str, runs_itself: bool = False) -> Callable[[Callable[..., Any]], None]:
    """Register an import, itself or the function of its name in `exchange.interchange`, with the options of all."""

    def register(command: Callable[..., Any]) -> None:
        own, shared = inspect.signature(command, eval_str=True), inspect.signature(_shared, eval_str=True)
        parameters = {**own.parameters, **shared.parameters, **own.parameters}  # its own come first, and win
        parameters.pop("options", None)

        @wraps(command)
        def run_it(as_json: bool, **given: Any) -> None:
            report = (command if runs_itself else _in_exchange("interchange", command))(**given)
            if report is not None:
                print(report.as_json() if as_json else report.text())

        run_it.__signature__ = own.replace(parameters=list(parameters.values()), return_annotation=None)  # type: ignore
        run_it.__annotations__ = {key: one.annotation for key, one in parameters.items()}
        import_app.command(name)(run_it)

    return register


def _in_exchange(module: str, command: Callable[..., Any]) -> Callable[..., Any]:
    return getattr(import_module(f"toolkit.exchange.{module}"), command.__name__)


def _shared(
    device: Device = "ios",
    hold_out: Annotated[int, Option(metavar="N", help="Every Nth image becomes a query with truth; 0: none.")] = 0,
    match_names: Annotated[bool, Option("--match-names", help=_ALIKE)] = False,
    placing: Placing = "link", masks: Masks = None,
    gps: Annotated[bool, Option("--gps", help=_GPS)] = False,
    positions: Positions = None,
    timestamps: Annotated[str | None, Option(metavar="names|FILE", help=_TIMES)] = None,
    timestamps_unit: Annotated[str | None, Option(metavar="s|ms|us|ns", help="Of times that are given.")] = None,
    odometry: Annotated[Path | None, Option(help="The queries' own poses: TUM, EuRoC, KITTI, ARKit.")] = None,
    depth: Annotated[Path | None, Option(metavar="DIR", help="Depth maps: PNG, 16 bits, millimeters.")] = None,
    depth_unit_mm: Annotated[float, Option("--depth-unit", metavar="MM", help="Millimeters per unit; TUM: 0.2.")] = 1.0,
    depth_camera: Annotated[str | None, Option(metavar=_CAM, help="If it is not the image's.")] = None,
    fixes: Annotated[str | None, Option(metavar="exif|FILE", help=_FIXES)] = None,
    replace: Replace = False,
    add: Annotated[bool, Option("--add", help="Add the images that the session lacks; the others stay.")] = False,
    as_json: ReportJson = False,
) -> None:  # fmt: skip
    """Hold the options of all imports, see `exchange.drafts.Options`."""


@importer("colmap")
def import_colmap(
    model: Annotated[Path, Argument(help="Folder with cameras, images, points3D as .bin or .txt.")],
    images: Annotated[Path, Argument(help="Folder that the model's image names are relative to.")],
    capture: ImportedTo, split: Split = "map", axes: Axes = "opencv", unit_m: Unit = None,
) -> None:  # fmt: skip
    """Make a session from a COLMAP model: cameras, poses, rigs."""


@importer("images")
def import_images(
    images: Annotated[Path, Argument(help="Folder of JPEG and PNG files.")],
    capture: ImportedTo, split: Split = "query",
    table: Annotated[Path | None, Option(help=_TABLE)] = None,
    poses_are: Annotated[
        str, Option(metavar="world_from_cam|cam_from_world|rotation_of_cam_from_world", help=_DIRECTION)
    ] = "world_from_cam",
    axes: Axes = "opencv", unit_m: MeterUnit = 1.0,
    truth: Annotated[Path | None, Option(help="CSV like the table, with ground-truth poses of queries.")] = None,
    camera: Annotated[
        str | None, Option(metavar=_CAM, help="Intrinsics of all images; else guessed from EXIF.")
    ] = None,
    cameras: Annotated[Path | None, Option(help="COLMAP's cameras.txt.")] = None,
    only: Annotated[list[str] | None, Option(metavar="PATTERN", help="Only such images: '*.color.png'.")] = None,
    skip: Annotated[list[str] | None, Option(metavar="PATTERN", help="No such images: 'masks/*'.")] = None,
) -> None:  # fmt: skip
    """Make a session from a folder of images: a map with poses, or queries."""


@importer("panoramas")
def import_panoramas(
    images: Annotated[Path, Argument(help="Folder of equirectangular JPEG and PNG files, of the whole sphere.")],
    capture: ImportedTo, split: Split = "query",
    table: Annotated[Path | None, Option(help="CSV: image,qw,qx,qy,qz,tx,ty,tz of each panorama.")] = None,
    poses_are: Annotated[
        str, Option(metavar="world_from_cam|cam_from_world", help="Direction of the table's poses.")
    ] = "world_from_cam",
    axes: Axes = "opencv", unit_m: MeterUnit = 1.0,
) -> None:  # fmt: skip
    """Make a session of 360-degree panoramas: each becomes a rig of perspective views."""


@importer("transforms")
def import_transforms(
    path: Annotated[
        Path, Argument(metavar="transforms", help="transforms.json of nerfstudio or instant-ngp, near its images.")
    ],
    capture: ImportedTo, split: Split = "map", axes: Axes = "opengl", unit_m: Unit = None,
    undo_applied: Annotated[bool, Option("--undo-applied", help=_APPLIED)] = False,
) -> None:  # fmt: skip
    """Make a session from a transforms.json: cameras with distortion, poses."""


@importer("dataset", runs_itself=True)
def import_dataset(
    context: typer.Context,
    kind: Annotated[str, Argument(metavar="KIND", help=_KINDS)],
    path: Annotated[Path, Argument(help="Folder of the data set as published, or of one of its scenes.")],
    capture: Annotated[Path, Argument(help="New capture folder, with a map and a query session.")],
    scene: Annotated[str | None, Option(help="Scene below PATH, e.g. chess.")] = None,
    every: Annotated[int, Option(min=1, metavar="N", help="Take every Nth image of each folder.")] = 1,
    hold_out: Annotated[int, Option(min=2, metavar="N", help="Every Nth image is a query, without a split.")] = 8,
    **options: Any,
) -> Any:
    """Make a map and queries from a data set of the field, and a manifest with its thresholds."""
    from toolkit.datasets.layouts import LAYOUTS, import_dataset
    from toolkit.exchange.import_report import new_manifest
    from toolkit.manifest import nearest
    from toolkit.synthetic.photographs import KINDS, SCENES, THRESHOLDS, arrange

    if kind not in {*LAYOUTS, *KINDS}:
        raise ManifestError.at("KIND", repr(kind), do=nearest(kind, [*LAYOUTS, *KINDS]))
    manifest, report, thresholds = _manifest_of(capture), None, THRESHOLDS
    if kind in KINDS:
        _refuse_options(context, "scene")
        arrange(path, capture, (scene,) if scene else SCENES, hard=KINDS[kind])
    else:
        report = import_dataset(kind, path, capture, scene, every=every, hold_out=hold_out, **options)
        thresholds = LAYOUTS[kind].thresholds
    if not manifest.exists():
        new_manifest(manifest.stem, capture, thresholds=thresholds)
    print(f"Run it: {COMMAND} run {manifest}", file=sys.stderr)
    return report


def _refuse_options(context: typer.Context, *known: str) -> None:
    """Refuse given options of the running command, except the known ones: they would have no effect."""
    for one in context.command.params:
        source = context.get_parameter_source(one.name or "")
        if one.param_type_name == "option" and one.name not in known and source and source.name == "COMMANDLINE":
            raise ManifestError.at(one.opts[0], "an option without effect on this data set", do="Leave it out.")


def _manifest_of(capture: Path) -> Path:
    """Return the manifest of a capture, which may not exist. Raise ManifestError if it is about another one."""
    manifest = Path("data_manifests") / f"{re.sub(r'[^A-Za-z0-9._-]', '-', capture.resolve().name)}.yaml"
    if manifest.exists() and str(capture) not in manifest.read_text(encoding="utf-8"):
        raise ManifestError(f"{manifest} is about another capture. Rename it, or give {capture} another name.")
    return manifest


@app.command()
def reconstruct(
    sources: Annotated[list[Path], Argument(metavar="PHOTOS... CAPTURE", help=_SOURCES)],
    device: Device = "ios",
    hold_out: Annotated[int, Option(metavar="N", help=_HELD_OUT)] = 0,
    fps: Annotated[float | None, Option(help="Frames per second of a video; default: chosen by motion.")] = None,
    camera: Annotated[str | None, Option(metavar=_CAM, help="Intrinsics of all photographs; else estimated.")] = None,
    distance: Annotated[
        tuple[str, str, float] | None, Option(metavar="IMAGE:X,Y IMAGE:X,Y METERS", help=_DISTANCE)
    ] = None,
    positions: Positions = None,
    table: Annotated[Path | None, Option(help=_KNOWN)] = None,
    poses_prior: Annotated[Path | None, Option(metavar="TABLE", help=_PRIOR)] = None, axes: Axes = "opencv",
    rig: Annotated[str | None, Option(metavar="folders|FILE", help=_RIG)] = None,
    mapper: Annotated[str, Option(metavar="incremental|global", help="COLMAP's mapper.")] = "incremental",
    placing: Placing = "link", masks: Masks = None,
    remove: Annotated[str | None, Option(metavar="RECORDING", help=_REMOVE)] = None,
    replace: Replace = False, as_json: ReportJson = False,
) -> None:  # fmt: skip
    """Make a map from photographs or videos without poses, by structure from motion; or add them to the map of CAPTURE.

    Poses that are in the map stay as they are.
    """
    from toolkit import pipeline
    from toolkit.capture import Capture
    from toolkit.capture.session import IMPORT_RECORD
    from toolkit.exchange.import_report import new_manifest
    from toolkit.exchange.reconstruct import (
        FOLDER,
        add_recording,
        inputs_of,
        model_points,
        reconstruct,
        remove_recording,
    )
    from toolkit.figures.explore import draw_top_view
    from toolkit.files import read_json

    if (len(sources) != 1) if remove else (len(sources) < 2):
        raise ManifestError("reconstruct: expected photographs and then the folder of the new capture.")
    *photos, capture = sources
    manifest = _manifest_of(capture)
    tell = partial(print, file=sys.stderr) if as_json else print
    option, report = "", None
    session = capture / "sessions" / f"{device}_map"
    made = read_json(session / IMPORT_RECORD)
    first = {"hold_out": hold_out, "camera": camera, "table": table, "distance": distance, "positions": positions,
             "poses_prior": poses_prior, "rig": rig, "masks": masks}  # fmt: skip
    inputs = {} if remove else inputs_of(photos, **first, fps=fps, axes=axes, mapper=mapper)
    if remove:
        tell(remove_recording(remove, capture, device))
    elif not replace and made.get("input") == inputs and "before" not in made:  # else those left out may fit now
        tell(f"{session}: reconstructed before from the same photographs, kept")
    elif session.exists() and not replace:
        if given := next((name for name, value in first.items() if value), "").replace("_", "-"):
            raise ManifestError(f"--{given} is for a new map. {capture} has one, to which the photographs are added.")
        report = add_recording(photos, capture, device, fps)
    else:
        result = reconstruct(
            photos, capture, device, fps, camera, distance, mapper, table, poses_prior, rig,
            hold_out=hold_out, positions=positions, placing=placing, masks=masks, axes=axes, replace=replace,
            record={"input": inputs},
        )  # fmt: skip
        report, option = result.report, result.camera
    if report is not None:
        print(report.as_json() if as_json else report.text())
    picture = capture / FOLDER / "cameras.png"
    points, colors = model_points(capture)
    draw_top_view(Capture.open(capture), points=points, colors=colors).savefig(picture)
    tell(f"Picture: {picture}")
    if not manifest.exists():
        new_manifest(manifest.stem, capture)
    tell(f"Manifest: {manifest}")
    run_dir = pipeline.run(manifest, None if hold_out else pipeline.MAP, say=tell)
    if hold_out:
        tell(f"Report: {run_dir / 'report.html'}")
    tell(f"Localize a photograph: {COMMAND} localize {run_dir} PHOTOGRAPH --picture above.png")
    if not hold_out:
        tell(f"Or many: {COMMAND} import images QUERIES {capture} --device {device}{option}, and then")
        tell(f"{COMMAND} run {manifest}")


@export_app.command("colmap")
def export_colmap(
    run: Run, scene: Scene, device: MapDevice, out: Annotated[Path, Argument(help="New folder for the model.")],
    capture: Capture = None, names: Names = "own",
) -> None:  # fmt: skip
    """Write the triangulated map of a run as a COLMAP model."""
    from toolkit.exchange import export

    print(f"{out}: {export.export_colmap(run, scene, device, out, capture, names).summary()}")


def exporter(name: str, unit: str) -> Callable[[Callable[..., None]], None]:
    """Register the function of `exchange.export` with the name of a command, which returns a number."""

    def register(command: Callable[..., None]) -> None:
        @wraps(command)
        def run_it(out: Path, **given: Any) -> None:
            print(f"{out}: {_in_exchange('export', command)(out=out, **given)} {unit}")

        export_app.command(name)(run_it)

    return register


@exporter("pairs", "pairs")
def export_pairs(
    run: Run, scene: Scene, map_device: MapDevice, query_device: QueryDevice, out: TextFile,
    topk: Annotated[int | None, Option(min=1, help="References per query; default: all.")] = None, names: Names = "own",
) -> None:  # fmt: skip
    """Write the retrieval of a pair in hloc's format: `query reference` per line."""


@exporter("poses", "poses")
def export_poses(
    run: Run, scene: Scene, map_device: MapDevice, query_device: QueryDevice, out: TextFile, capture: Capture = None,
    names: Names = "own",
) -> None:  # fmt: skip
    """Write the poses of a pair's queries in hloc's format: `name qw qx qy qz tx ty tz` per line, cam_from_world."""


@exporter("intrinsics", "images")
def export_intrinsics(
    run: Run, scene: Scene, map_device: MapDevice, query_device: QueryDevice, out: TextFile, capture: Capture = None,
    names: Names = "own",
) -> None:  # fmt: skip
    """Write the cameras of a pair's queries in hloc's format: `name MODEL width height parameters` per line."""


@exporter("features", "images")
def export_features(
    run: Run, scene: Scene, session: Annotated[str, Argument(help="Session, e.g. ios_map.")], out: Hdf5File,
    kind: Kind = "sift",
) -> None:  # fmt: skip
    """Write the local features of a session in hloc's format."""


@exporter("matches", "pairs")
def export_matches(
    run: Run, scene: Scene,
    session0: Annotated[str, Argument(help="Session of the first images, e.g. ios_map.")],
    session1: Annotated[str, Argument(help="Session of the second images; the same for the pairs of a map.")],
    out: Hdf5File, kind: Kind = "sift", capture: Capture = None,
) -> None:  # fmt: skip
    """Write the matches of two sessions in hloc's format."""


@exporter("geo", "images")
def export_geo(
    run: Run, out: Annotated[Path, Argument(help="File to write: .csv, or .geojson.")], capture: Capture = None
) -> None:
    """Write latitude, longitude, altitude and heading of the queries of a run in maps with GPS."""


@exporter("exif", "pictures")
def export_exif(
    run: Run, out: Annotated[Path, Argument(help="Folder for copies of the pictures.")], capture: Capture = None,
    unsure: Annotated[bool, Option("--unsure", help="Also poses of low confidence.")] = False,
    xmp: Annotated[bool, Option("--xmp", help="XMP files to lie beside the pictures, instead of copies.")] = False,
) -> None:  # fmt: skip
    """Write position and direction into copies of the query pictures of a run in maps with GPS."""


@app.command()
def record(
    scene: Annotated[Path, Argument(help="Capture folder, with sessions/ in it.")],
    device: Annotated[str, Option(help="ios, hl or spot.")],
    split: Annotated[str, Option(help="map or query.")] = "map",
    subsession: Annotated[str, Option(help="One subsession, or all.")] = "all",
    keyframes_only: Annotated[bool, Option("--keyframes-only", help="Only the query keyframes.")] = False,
    every: Annotated[int, Option(min=1, help="Record only every Nth frame.")] = 1,
    spawn: Annotated[bool, Option("--spawn", help="Open the viewer when done.")] = False,
    vis_retrieve_queries: Annotated[
        bool, Option("--vis-retrieve-queries", help="Connect queries with the references that localized them.")
    ] = False,
    queries_pose: Annotated[Path | None, Option(help="Trajectories file with the poses of queries.")] = None,
    map_dir: Annotated[Path | None, Option(help="Folder of triangulated maps, to show their points.")] = None,
    out: Annotated[Path | None, Option(help="File to write, .rrd.")] = None,
) -> None:
    """Record a session for the rerun viewer: images on a timeline, cameras, depth and points."""
    from toolkit.viewer.sessions import record_session

    rrd = record_session(
        scene, split, device, subsession, keyframes_only, every, spawn, vis_retrieve_queries, queries_pose,
        out=out, map_dir=map_dir,
    )  # fmt: skip
    for message in rrd.messages:
        print("Note:", message)
    print(f"{rrd.frames} frames, {rrd.images} images, {rrd.bytes / 1e6:.1f} MB in {rrd.seconds:.0f} s")
    print(f"Open it: {rrd.command}")


def _compare_swept(folders: list[Path], errors: list[ToolkitError], tell: Callable[..., None], as_json: bool) -> None:
    """Compare the finished runs of a sweep, and raise the first error."""
    from toolkit.runs.folder import summary

    for result in map(summary, folders):
        if result["exit_code"] != 0:
            errors.append(IncompleteError(f"{result['name']}: {result['error']}"))
    if len(folders) > 1:
        as_json = as_json and not errors  # if there is an error, stdout has its JSON instead
        try:
            _compare(folders, tell, as_json)
        except ArtifactError as error:  # not evaluated (`--only`), or without ground truth
            text = f"Nothing to compare: {sentence(error)}"
            tell(text)
            if as_json:
                _print_json({"runs": {folder.name: str(folder) for folder in folders}, "messages": [text]})
    if errors:
        raise errors[0]


def _compare(runs: list[Path], tell: Callable[..., None], as_json: bool, out: Path | None = None, pictures: int = 4,
             seed: int = 0) -> None:  # fmt: skip
    """Compare runs and print the result; execute the notebook on them, and write it as a page."""
    from toolkit.notebook import execute, notebook_path, write_page
    from toolkit.report.comparison import compare_runs

    comparison = compare_runs(list(map(str, runs)), seed)
    if not as_json:
        tell(comparison.text())
    name = f"compare_{'_'.join(comparison.names)}"[:100]  # file systems limit the length
    page = (out or runs[0].resolve().parent / f"{name}.html").resolve()
    first, *others = (str(run.resolve()) for run in runs)
    parameters = {"run": first, "others": others, "pictures": pictures, "seed": seed}
    notebook, _ = execute(notebook_path("compare"), page.with_suffix(".ipynb"), parameters)
    write_page(notebook, page)
    if as_json:
        _print_json(comparison.summary() | {"page": str(page)})
    else:
        tell(f"Comparison: {page}")


def _summary_of_stopped(manifest: Path, overrides: Sequence[str], name: str | None, in_place: bool) -> dict[str, Any]:
    """Return the summary of the run that this process started; empty if it had not started."""
    from toolkit.manifest import load_manifest
    from toolkit.pipeline import run_name
    from toolkit.runs.folder import summary

    with suppress(ToolkitError, OSError):
        content = load_manifest(manifest, overrides)
        own = content.name if in_place else run_name(manifest, content, overrides, name)[1]
        result = summary(Path(content.output_root) / own)
        if result.pop("pid") == os.getpid():
            return result
    return {}


def _print_json(content: dict[str, Any]) -> None:
    print(json.dumps(content, indent=1, default=str))


def main() -> None:
    """Run the command line. Print an error as one sentence, with a traceback only if it is a bug of the toolkit."""

    import pycolmap  # noqa: F401 - its import installs a SIGTERM handler, which must not replace the one below

    if not sys.stderr.isatty():
        os.environ.setdefault("TQDM_MININTERVAL", "30")  # seconds between lines about progress in a log

    os.environ[COMMAND_VARIABLE] = COMMAND
    received: list[int] = []

    def stop(number: int, frame: FrameType | None) -> None:
        received.append(number)
        raise KeyboardInterrupt(number)

    for name in ("SIGTERM", "SIGHUP"):  # act like Ctrl-C, unless they are ignored, e.g. under `nohup`
        if hasattr(signal, name) and signal.getsignal(getattr(signal, name)) == signal.SIG_DFL:
            signal.signal(getattr(signal, name), stop)
    try:
        app(prog_name=COMMAND)
    except SystemExit as end:  # typer has printed the message
        if end.code != INTERRUPTED:
            raise SystemExit(1 if end.code == USAGE else end.code) from None
        error: BaseException = KeyboardInterrupt(*received)
    except Exception as caught:
        error = caught
    if exit_code(error) == 3 and not isinstance(error, ToolkitError):
        traceback.print_exception(error)
    print(f"{'' if isinstance(error, KeyboardInterrupt) else 'Error: '}{sentence(error)}", file=sys.stderr)
    raise SystemExit(exit_code(error))


if __name__ == "__main__":
    main()
