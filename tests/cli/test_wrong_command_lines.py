"""Whatever is asked for that is not there: an exit status and one line that names it, before anything runs.

That who does what such a line says is not refused again is in test_advice.py.
"""

import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from toolkit import runner

Vislam = Callable[..., int]
ENDLESS = "n" * 300

# Words, exit status, and what the line has to say. The files named here are those of ``files`` below.
WRONG: list[tuple[str, int, str]] = [
    ("", 2, "COMMAND"),
    ("compair", 2, "did you mean compare?"),
    ("compare --max-frames many", 2, "expected a whole number, at least 2, not 'many'"),
    ("compare drive --workers 100000", 2, "at most 1024"),
    ("compare --estimators ,", 2, "expected names separated by commas"),
    ("compare drive flight --truth gt.tum", 2, "exactly one sequence"),
    ("compare drive --no-repair --keep time-gap", 2, "not allowed with"),
    ("compare drive --json --quiet", 2, "not allowed with"),
    # Names that are misspelt get the nearest.
    ("compare drive --max 10", 2, "there is no option --max; did you mean --max-frames? (see vislam compare --help)"),
    ("compare drive --max-frames 9 batch", 2, "unexpected argument batch (see"),
    ("compare drive --estimators EKF", 5, "did you mean ekf?"),
    ("compare drive --estimators dead-reckoning,oracle", 5, "no estimator is called oracle"),
    ("compare drive --start Truth", 2, "did you mean truth?"),
    ("compare drive --keep stale", 2, "did you mean stale-frames?"),
    ("compare drive --keep tim", 2, "did you mean time-order, time-gap or time-offset?"),
    ("compare drive --columns ate_se3", 2, "no metric is called ate_se3; did you mean ate_se3_m?"),
    ("list cameras", 2, "estimators, metrics, faults"),
    ("cite mscf", 5, "no estimator or format is called mscf"),
    # Settings, and files of them.
    ("compare drive --set window.lag=3", 2, "there is no setting window.lag; did you mean window.lag_s?"),
    ("compare drive --set window.lag_s", 2, "--set takes KEY=VALUE"),
    ("compare drive --set estimators.ekff.gain=1", 5, "did you mean ekf?"),
    ("compare drive --estimators ekf --set estimators.ekf.gain=2", 5, "estimator ekf has no option gain"),
    ("compare drive --config wrong.toml", 2, "wrong.toml: there is no setting outliers.gate; did you mean"),
    ("compare drive --config sound.toml --set window.lag=3", 2, "sound.toml or the command line: there is no setting"),
    ("compare drive --config asked.toml", 2, "asked.toml: there is no compare.estimator; did you mean estimators?"),
    ("compare drive --config typed.toml", 2, "typed.toml: compare.max_frames: expected integer >= 2"),
    ("compare drive --config kept.toml", 2, "no fault is called stale (did you mean stale-frames?)"),
    ("compare drive --config broken.toml", 2, "broken.toml: is not TOML"),
    ("compare drive --config absent.toml", 2, "absent.toml: cannot be read"),
    *(
        (
            f"compare drive {option} --set {text}",
            2,
            f"{option} and --set {text} give {text.partition('=')[0]} two values",
        )
        for option, text in (
            ("--window 3", "window.lag_s=2"),
            ("--outliers gate", "outliers.policy=robust"),
            ("--columns bound", "metrics.bound=false"),
            ("--set window.lag_s=1", "window.lag_s=2"),
        )
    ),
    # Baselines.
    ("baseline drive:1 --set seeds=9", 2, "--set seeds=9 is for compare"),
    ("check", 2, "--baseline"),
    ("baseline drive --seeds 4", 2, "at least 5"),
    ("baseline drive drive:2", 2, "a sequence is named twice"),
    ("baseline drive --truth gt.tum", 2, "--truth takes SEQUENCE=FILE.tum, not gt.tum"),
    ("baseline drive --truth kitti00=gt.tum", 2, "--truth is for kitti00, which is none of the sequences"),
    ("baseline drive --truth drive=gt.tum", 2, "--truth is for recorded sequences"),
    ("baseline nowhere.npz --out new.json", 3, "nowhere.npz: no such file"),
    ("baseline drive:soon --out new.json", 3, "drive:soon: no such file"),
    ("baseline drive --out t", 4, "t is a directory"),
    ("baseline drive --out gt.tum", 4, "gt.tum is a file of another kind, which would be lost"),
    ("baseline drive --estimators oracle --out new.json", 5, "no estimator is called oracle"),
    # Before anything is read:
    ("check --baseline broken.toml --skip-speed --json t", 4, "t is a directory"),
    ("check --baseline broken.toml --junit new.xml --json gt.tum", 4, "gt.tum is a file of another kind"),
    # Recordings, trajectories, and what does not go together.
    ("compare no/such.npz", 3, "no/such.npz: no such file or directory"),
    ("compare run", 3, "is a run directory and no recording: vislam report shows it, and --config run/manifest.json"),
    ("compare drive --truth missing.tum", 3, "missing.tum"),
    ("compare kitti00 --seeds 2", 3, "kitti00 is the same under every seed"),
    ("compare drive --seeds 2 --truth gt.tum", 2, "exclude each other"),
    ("compare drive --trajectory gt.tum", 2, "expected NAME=FILE"),
    ("compare drive --trajectory ekf=gt.tum --estimators ekf", 2, "name ekf is taken by ekf"),
    ("compare drive --trajectory a=gt.tum --trajectory a.=gt.tum", 2, "a. is taken by another trajectory"),
    ("compare drive --trajectory (!)=gt.tum", 2, "has no letter or digit"),
    (f"compare drive --trajectory {ENDLESS}=gt.tum", 2, "a trajectory's name of 300 characters is too long"),
    ("compare drive flight --trajectory a=gt.tum", 2, "exactly one sequence"),
    ("compare drive --trajectory theirs=missing.tum", 3, "missing.tum: cannot be read"),
    ("compare drive --trajectory theirs=empty", 3, "empty: the file holds no poses"),
    ("simulate drive --out d --duration 1e9", 2, "its duration is from 0.1 to 3600 s"),
    ("simulate flight --out d --images --blur 50", 2, "expected milliseconds from 0 to 40"),
    ("simulate drive --out d --images", 2, "flight has"),
    ("tracks drive --out x", 3, "drive: holds no images"),
    ("tracks nowhere --out x --set frontend.window=9", 2, "did you mean frontend.window_px?"),
    ("report", 2, "RUN_DIR"),
    ("report t", 3, "t is not a run directory"),
    ("evaluate gt.tum gt.tum --runs 1000000000", 2, "at most 10000"),  # counts beyond any use took all memory
    ("tracks film --count 1000000000 --out x", 2, "at most 10000"),
    ("simulate flight --images --moving 1000000000 --out d", 2, "at most 1000,"),
    # Sweeps; what else cannot be swept is in tests/experiment/test_sweep.py.
    ("sweep drive --over fault:blackout", 2, "expected KEY=V1,V2,... or fault:NAME=D1,D2,..., not 'fault:blackout'"),
    ("export run --bundle a.zip --format tum", 2, "--bundle goes without any other option"),
    ("check --baseline b.json --trajectories t --speed-against HEAD", 2, "with --trajectories nothing runs"),
    # Outputs that cannot be written.
    ("compare drive --estimators dead-reckoning --out taken", 4, "taken exists and is not a directory"),
    (f"compare drive --estimators dead-reckoning --out {ENDLESS}", 4, "File name too long"),
    # Of a word of thousands of letters both ends are told.
    (f"diff {ENDLESS * 20} run", 3, "nnn...nnn"),
    (f"cite {ENDLESS}", 5, "or name a run directory"),
]


@pytest.fixture
def files(vislam: Vislam) -> None:
    del vislam  # in whose directory they stand
    Path("asked.toml").write_text('[compare]\nestimator = ["ekf"]\n')
    Path("typed.toml").write_text("[compare]\nmax_frames = 1\n")
    Path("kept.toml").write_text('[compare]\nkeep = ["stale"]\n')
    Path("broken.toml").write_text("window = [")
    Path("sound.toml").write_text("seeds = 1")
    Path("wrong.toml").write_text("outliers.gate = 1")
    Path("gt.tum").write_text("0 0 0 0 0 0 0 1\n")
    for name in ("taken", "empty"):
        Path(name).touch()
    for name in ("t", "run"):
        Path(name).mkdir()
    for name in ("manifest.json", "metrics.json"):
        Path("run", name).write_text("{}")


@pytest.mark.usefixtures("files")
@pytest.mark.parametrize(("words", "status", "why"), WRONG, ids=[one[0][:80] for one in WRONG])
def test_a_wrong_command_line_is_answered_in_one_line_before_anything_runs(
    vislam, one_line, monkeypatch, words, status, why
):
    monkeypatch.setattr(runner, "run", None)
    before = sorted(Path().rglob("*"))
    assert vislam(*words.split()) == status
    assert why in (told := one_line())
    assert len(told) < 1000
    assert sorted(Path().rglob("*")) == before


def test_a_cluster_needs_a_package_that_is_named(vislam, one_line, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert vislam("compare", "drive", "--estimators", "dead-reckoning", "--scheduler", "tcp://host:8786") == 71
    assert "a cluster needs the package distributed: pip install 'vislam-toolkit[cluster]'" in one_line()
