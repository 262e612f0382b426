"""Pairs that cannot be done: the others are, and the reason is kept where later stages find it."""

from pathlib import Path

import pytest

from toolkit.errors import CaptureError, DamagedError, ManifestError
from toolkit.files import pair_devices
from toolkit.runs.folder import failures
from toolkit.runs.pairs import PairRows, left_out, left_out_of


def test_the_devices_of_a_file_follow_from_its_name() -> None:
    for stem in ("A_map_hl_2_query_ios", "A_map_hl_2_query_ios_sequence", "A_map_B_map_hl_2_query_ios"):
        assert pair_devices(stem) == ("hl_2", "ios")
    assert pair_devices("A_map_hl") == pair_devices("poses") == ("", "")


def test_a_pair_that_cannot_be_done_is_a_row_with_the_reason(tmp_path: Path) -> None:
    table = PairRows("P", tmp_path)
    with table.row("ios", "hl"):
        raise CaptureError("images.txt, line 3: a dragon.")
    with table.row("ios", "ios") as row:
        row |= {"queries": 3, "path": "x", "skipped": True, "seconds": 100.0}
    frame = table.frame()
    assert frame.to_dict("list") == {
        "map_device": ["ios", "ios"], "query_device": ["hl", "ios"], "queries": [0, 3], "seconds": [0.0, 100.0],
        "skipped": [False, True], "path": ["", "x"], "reason": ["images.txt, line 3: a dragon.", ""],
    }  # fmt: skip
    (lost,) = left_out_of(frame)
    assert (lost["what"], lost["reason"]) == ("hl queries in the ios map", "images.txt, line 3: a dragon.")

    later = PairRows("P", tmp_path / "later", tmp_path)
    for query in ("hl", "ios"):
        with later.row("ios", query) as row:
            later.check_upstream()
            row["queries"] = 1
    assert later.frame()["reason"].tolist() == ["images.txt, line 3: a dragon.", ""]
    with table.row("ios", "hl"):
        pass
    assert left_out(tmp_path, "P_map_ios_query_hl") == "", "done again, it has no reason any more"


def test_where_no_pair_can_be_done_the_first_error_is_raised(tmp_path: Path) -> None:
    table = PairRows("P", tmp_path)
    for query in ("hl", "ios"):
        with table.row("ios", query):
            raise CaptureError(query)
    with pytest.raises(CaptureError, match="hl"):
        table.frame()


def test_an_error_of_the_settings_or_a_bug_stops_at_once(tmp_path: Path) -> None:
    table = PairRows("P", tmp_path)
    for error in (ManifestError("topk"), KeyError("a bug"), MemoryError(), DamagedError(tmp_path, "made again")):
        with pytest.raises(type(error)), table.row("ios", "hl"):
            raise error


def test_failures_are_counted_once() -> None:
    lost = [{"what": str(number), "reason": "x"} for number in range(6)]
    rows = [
        {"scene": "P", "stage": "embed", "counts": {"images": 9, "unreadable": 2}, "asked": 12, "left_out": lost},
        {"scene": "P", "stage": "retrieve", "asked": 9, "left_out": lost[:4]},
        {"scene": "P", "stage": "localize", "counts": {"queries": 7, "failed": 1}, "asked": 9, "left_out": lost[1:5]},
        {"scene": "Q", "stage": "localize", "counts": {"queries": 3, "failed": 0}, "asked": 4, "left_out": []},
    ]
    assert failures(rows) == {
        "images": {"failed": 2, "of": 9}, "queries": {"failed": 1, "of": 10}, "pairs": {"failed": 5, "of": 13}
    }  # fmt: skip
    assert failures(rows[:1])["pairs"] == {"failed": 6, "of": 12}, "without pairs, recordings"
