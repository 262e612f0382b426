import html
import os
import re
import shlex
from pathlib import Path

import numpy as np
import pytest

from tests.displayed import picture_of
from toolkit.errors import ArtifactError
from toolkit.figures.style import new_figure
from toolkit.notebook import TEXT_BARS
from toolkit.viewer.queries import ASSETS, open_recording, show_recording


@pytest.fixture
def recording(tmp_path, monkeypatch):
    import rerun.blueprint as rrb

    recording = tmp_path / "run" / "100 % & more #1.rrd"
    recording.parent.mkdir()
    with open_recording(recording, "name", rrb.Blueprint()):
        pass
    (tmp_path / "notebooks").mkdir()
    monkeypatch.chdir(tmp_path / "notebooks")
    return recording


def test_a_saved_page_has_the_link_and_the_command(recording, monkeypatch):
    shown = []
    monkeypatch.setattr("IPython.display.display", shown.append)
    monkeypatch.setenv(TEXT_BARS, "1")
    assert show_recording(recording) is None
    (text,) = shown
    page = text.data
    assert 'href="../run/100%20%25%20%26%20more%20%231.rrd"' in page
    (command,) = re.findall("<code>(.*)</code>", page)
    assert shlex.split(html.unescape(command)) == ["rerun", str(recording)]


@pytest.mark.slow
def test_the_viewer_is_served_by_this_process_and_gets_the_whole_file(recording, monkeypatch):
    monkeypatch.delenv(TEXT_BARS, raising=False)
    monkeypatch.delenv(ASSETS, raising=False)
    monkeypatch.setattr("IPython.display.display", lambda _: None)
    viewer = show_recording(recording)
    assert os.environ[ASSETS] == "serve-local"
    assert str(viewer._esm).startswith("http://localhost:")
    ((message, buffers),) = viewer._event_queue
    assert message == {"type": "rrd"}
    assert buffers == [recording.read_bytes()]


def test_no_recording_is_said(tmp_path):
    with pytest.raises(ArtifactError, match=r"gone\.rrd: no such recording"):
        show_recording(Path(tmp_path / "gone.rrd"))


def test_a_figure_of_photographs_is_kept_small_and_one_of_lines_sharp():
    photographs, lines = new_figure(4, 3), new_figure(4, 3)
    noise = np.random.default_rng(0).integers(0, 255, (300, 400, 3), np.uint8)
    photographs.subplots().imshow(noise)
    lines.subplots().plot([0, 1, 2], [0, 1, 0])
    assert [picture_of(figure).format for figure in (photographs, lines)] == ["JPEG", "PNG"]
