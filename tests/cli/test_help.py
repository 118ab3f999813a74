"""Help is quick, complete, and its examples work; a shell completes what is typed (5 s)."""

import os
import re
import shlex
import shutil
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

from tests.datasets.test_own_tables import recorded, written
from toolkit import cli
from toolkit.cli import arguments, main, recordings, runs

COMMANDS = ("", *(command.name for command in cli._COMMANDS))
_SLOW = ("numpy", "scipy", "gtsam", "cv2", "matplotlib", "importlib.metadata")


@cache
def help_of(command: str) -> "subprocess.CompletedProcess[str]":
    """Return what help prints in a process of its own, and on its stderr which slow packages it imported."""
    program = (
        "import sys; from toolkit.cli import main\n"
        f"try: sys.exit(main({[*command.split(), '--help']!r}))\n"
        f"finally: print([name for name in {_SLOW!r} if name in sys.modules], file=sys.stderr)"
    )
    return subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=300)


@pytest.mark.parametrize("command", COMMANDS)
def test_help_imports_nothing_slow(command):
    """The 0.3 s that help may take are kept on any machine if nothing slow is imported on the way."""
    assert help_of(command).stderr.strip() == "[]"


@pytest.mark.usefixtures("one_process", "unrendered", "own_cache")
# An estimator is verified in tests/verify, which takes longer than all others here.
@pytest.mark.parametrize("command", [command for command in COMMANDS if command != "verify"])
def test_examples_in_help_run(command, vislam, kitti_drive):
    if command == "import":
        shutil.copytree(written(recorded("twist"), Path("tables")), ".", dirs_exist_ok=True)
    if command == "tracks":
        shutil.copytree(kitti_drive, "kitti/sequences/06")
    examples = re.findall(r"^  \$ vislam (.*)$", help_of(command).stdout, flags=re.MULTILINE)
    assert examples
    for example in examples:
        assert vislam(*shlex.split(example)) == 0, example


def test_what_the_help_repeats_is_what_there_is():
    """Their own modules take too long to import for a help text."""
    from toolkit.datasets.bags import ROLES
    from toolkit.datasets.trajectories import FORMATS
    from toolkit.datasets.trajectories.covariances import CONVENTIONS
    from toolkit.simulation import SCENARIOS

    assert set(recordings.SCENARIOS) == set(SCENARIOS)
    repeated = (runs.FORMATS, arguments.TOPIC_ROLES, arguments.COV_CONVENTIONS)
    assert repeated == (tuple(FORMATS), tuple(ROLES), tuple(CONVENTIONS))


# Completion -----------------------------------------------------------------------------------------------------------

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
