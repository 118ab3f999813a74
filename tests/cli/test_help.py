"""Help is quick, complete, and its examples work."""

import re
import shlex
import shutil
import subprocess
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from toolkit import cli
from toolkit.cli import recordings, runs
from toolkit.datasets import load_sequence
from toolkit.datasets.trajectories import tum
from toolkit.estimate import Trajectory

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
        write_tables(Path())
    if command == "tracks":
        shutil.copytree(kitti_drive, "kitti/sequences/06")
    examples = re.findall(r"^  \$ vislam (.*)$", help_of(command).stdout, flags=re.MULTILINE)
    assert examples
    for example in examples:
        assert vislam(*shlex.split(example)) == 0, example


def write_tables(folder: Path) -> None:
    """Write a few frames of the drive as tables of one's own."""
    drive = load_sequence("drive").truncated(4)
    rig, seen, motion, truth = drive.rig, drive.observations, drive.motion, drive.truth
    tracks = np.column_stack([drive.frames_t_ns[seen.frame], seen.track_id, seen.uv_px]).tolist()
    twists = np.column_stack([motion.t_ns, motion.values]).tolist()
    tables = {"tracks": ("t_ns,track_id,uL,uR,v", tracks), "twist": ("t_ns,vx,vy,vz,wx,wy,wz", twists)}
    for name, (heading, rows) in tables.items():
        lines = [heading, *(",".join([f"{row[0]:.0f}", *map(repr, row[1:])]) for row in rows)]
        (folder / f"{name}.csv").write_text("\n".join(lines))
    numbers = {key: getattr(rig, key) for key in ("fx_px", "fy_px", "cx_px", "cy_px", "baseline_m")}
    values = {**numbers, "T_imu_cam": rig.T_imu_cam.tolist()}
    (folder / "rig.toml").write_text("".join(f"{key} = {value}\n" for key, value in values.items()))
    (folder / "truth.tum").write_text(tum.text(Trajectory(truth.t_ns, truth.T_world_imu)))


def test_what_the_help_repeats_is_what_there_is():
    """Their own modules take too long to import for a help text."""
    from toolkit.datasets.trajectories import FORMATS
    from toolkit.simulation import SCENARIOS

    assert set(recordings.SCENARIOS) == set(SCENARIOS)
    assert tuple(FORMATS) == runs.FORMATS
