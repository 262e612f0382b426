"""Files of references: what is read, and how what is no such file is refused."""

import json
from pathlib import Path

import pytest

from toolkit.errors import ArtifactError
from toolkit.files import read_references

ROW = {"path": "A/sessions/q/1.jpg", "timestamp": "1", "sensor_id": "a", "topk": [{"path": "A/sessions/m/2.jpg"}]}


def test_rows_come_as_they_are_and_blank_lines_do_not_count(tmp_path: Path) -> None:
    path = tmp_path / "pair.jsonl"
    path.write_text(f"{json.dumps(ROW)}\n\n{json.dumps(ROW | {'topk': []})}\n")
    assert read_references(path) == [ROW, ROW | {"topk": []}]


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("{", "Expecting property name"),
        ("[]", r"found \[\]; expected the keys"),
        (json.dumps({"timestamp": "1"}), "found .*timestamp.*; expected the keys"),
        (json.dumps(ROW | {"timestamp": "noon"}), "noon"),
        ('{"timestamp": Infinity, "sensor_id": "a", "topk": []}', "infinity"),
        (json.dumps(ROW | {"topk": {}}), "expected a list of references"),
        (json.dumps(ROW | {"topk": [{"score": 1}]}), "has no path"),
    ],
)
def test_a_line_that_is_no_row_is_named(tmp_path: Path, line: str, message: str) -> None:
    path = tmp_path / "pair.jsonl"
    path.write_text(f"{json.dumps(ROW)}\n\n{line}\n")
    with pytest.raises(ArtifactError, match=rf"pair\.jsonl, line 3: .*{message}"):
        read_references(path)


def test_keys_that_a_reader_needs_are_asked_for(tmp_path: Path) -> None:
    path = tmp_path / "pair.jsonl"
    path.write_text(json.dumps({key: value for key, value in ROW.items() if key != "path"}))
    assert read_references(path)[0]["sensor_id"] == "a"
    for file, named in ((path, "path, sensor_id, timestamp, topk"), (tmp_path / "none.jsonl", r"none\.jsonl")):
        with pytest.raises(ArtifactError, match=named):
            read_references(file, "path")
