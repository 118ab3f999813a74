"""Names of others act neither on a terminal nor in a report, and paths may be any bytes."""

import json
import os
import re
import shutil
from pathlib import Path

RECORDING = Path(__file__).parents[2] / "data" / "drive_small"
HOSTILE = "a\x1b[2J\u202eb|c <img src=x> [click](http://x) $\\frac$ \udcff"
QUICK = ("--estimators", "dead-reckoning", "--max-frames", "10", "--workers", "1")


def test_names_act_neither_on_the_terminal_nor_in_the_report(vislam, capfd):
    folder = Path(shutil.copytree(RECORDING, "hostile"))
    text = json.loads((folder / "recording.json").read_text())
    text["name"], text["provenance"]["facts"] = HOSTILE, [f"# {HOSTILE}\n\n---"]
    (folder / "recording.json").write_text(json.dumps(text))
    assert vislam("compare", "hostile", *QUICK, "--out", "run") == 0
    messages = capfd.readouterr()
    assert messages.err == ""
    assert messages.out.replace("\n", "").isprintable()
    report = Path("run/report.md").read_text(encoding="utf-8")
    assert report.replace("\n", "").isprintable()
    assert not re.search(r"(?<!\\)(<img|\[click|\|c )|^---", report, re.MULTILINE)
    assert vislam("report", "run") == 0
    assert vislam("check-data", "hostile") == 0
    assert capfd.readouterr().out.replace("\n", "").isprintable()


def test_a_path_in_bytes_that_are_no_text_is_read_and_reported(vislam, capfd):
    folder = shutil.copytree(RECORDING, os.fsdecode(b"caf\xe9"))
    assert vislam("compare", folder, *QUICK, "--out", os.fsdecode(b"r\xe9sultats")) == 0
    assert "results: r\\udce9sultats" in capfd.readouterr().out
    assert vislam("report", os.fsdecode(b"r\xe9sultats")) == 0
