"""A shell completes commands, options, choices and the names that are known here (5 s)."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from toolkit.cli import main

OFFERED = {
    "comp": ["compare", "completion"],
    "evaluate --format m": ["markdown"],
    "compare --estimators ekf,msckf-s": ["ekf,msckf-slam"],
    "compare fli": ["flight", "flight-realistic"],
    "compare --set noise.pix": ["noise.pixel_sigma_px="],
    "report no": ["notes.txt"],  # files
}


@pytest.mark.parametrize("line", OFFERED)
def test_what_is_offered_for_the_last_word_of_a_line(line, tmp_path):
    (tmp_path / "notes.txt").touch()
    asked = {"COMP_LINE": f"vislam {line}", "COMP_POINT": str(len(f"vislam {line}")), "_ARGCOMPLETE": "1"}
    asked |= {"_ARGCOMPLETE_STDOUT_FILENAME": str(tmp_path / "offered"), "_ARGCOMPLETE_IFS": "\n"}
    asked |= {"PYTHONPATH": str(Path(__file__).parents[2])}
    subprocess.run([sys.executable, "-m", "toolkit.cli"], env=os.environ | asked, cwd=tmp_path, check=False)
    assert sorted(word.strip() for word in (tmp_path / "offered").read_text().splitlines()) == OFFERED[line]


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_the_script_of_a_shell_is_whole(shell, capsys):
    assert main(["completion", shell]) == 0
    script = capsys.readouterr().out
    assert "vislam" in script
    if shutil.which(shell):
        subprocess.run([shell, "-n"], input=script, text=True, check=True)
