"""Whoever changes a command line, or a call, as the refusal says is not refused for the same again (4 s)."""

import re
import shutil
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import pytest

import toolkit
from tests.advice import TOOLKIT, advice_in, is_followed
from toolkit.cli import main
from toolkit.errors import DataError
from toolkit.settings import SettingsError

Vislam = Callable[..., int]
# Seven poses on a bend, so that they can be fitted to others.
POSES = "".join(f"{k}.0 {k} {k * k} 0 0 0 {k / 20} {(1 - k * k / 400) ** 0.5}\n" for k in range(7))
NAME = "n" * 201
BASELINE = "baseline --trajectories results/ours --truth truths --out"
EVALUATED = "check --baseline b.json --trajectories e/evaluation.json"
CHECK = "check --baseline b.json --trajectories"
# What is typed, the advice, and what is typed then. Where the command would go on to run something the recording is one
# that is not there, and that it says.
ROWS = [
    tuple(part.strip() for part in row.split(" | "))
    for row in f"""
compare no --window 3 --set window.lag_s=2 | two values; leave one out | compare no --window 3
check-data no --topics imu=/a,imu=/b | imu is named twice; leave one out | check-data no --topics imu=/a
compare no --config a.toml --config a.toml | it takes one file | compare no --config a.toml
compare no --estimators ekf batch | give names with commas: --estimators ekf,batch | compare no --estimators ekf,batch
compare no --estimtors ekf | did you mean --estimators? | compare no --estimators ekf
compare no --trajectory truth=a.tum | choose another | compare no --trajectory theirs=truths/A.tum
compare no --trajectory {NAME}=a.tum | shorten it | compare no --trajectory theirs=truths/A.tum
compare no --config other.json | name the manifest.json of a comparison, or a TOML file | compare no --config a.toml
simulate flight --out d --duration 0.1 --lens radtan | add --images \
    | simulate flight --out d --duration 0.1 --lens radtan --images
sweep --over window.lag_s=1,2 | name the sequence to sweep, a path or a built-in name as drive \
    | sweep no --over window.lag_s=1,2
sweep no | name a setting or a fault and its values | sweep no --over window.lag_s=1,2
sweep no --over window.lag_s=1 --over window.lag_s=2 | give all its values at once | sweep no --over window.lag_s=1,2
sweep no --over window.lag_s=1 --over noise.motion_scale=2 --over noise.pixel_sigma_px=2 \
    | cross two, or sweep each by itself \
    | sweep no --over window.lag_s=1 --over noise.motion_scale=2
sweep no --over fault:outlier_tracks=many | is no dose; give numbers, in | sweep no --over fault:outlier_tracks=0.1
sweep no --over fault:blackout=nan | give a finite dose, in s | sweep no --over fault:blackout=1
export run --format tum | give --format and --out for a trajectory | export run --format tum --out a.tum
report nowhere | give a run directory, as vislam compare writes it | report run
export run --format kitti --cov-convention rot-pos/right --out x | has no place for covariances; choose another format \
    | export run --format tum --cov-convention rot-pos/right --out x
export run --estimator truth --format tum --cov-convention rot-pos/right --out x | leave out --cov-convention \
    | export run --estimator truth --format tum --out x
evaluate truths/A.tum nowhere.tum | no such file; check the path | evaluate truths/A.tum results/ours/A/1.tum
evaluate nowhere results/ours/A/1.tum | give a file, or a folder that has SEQUENCE.tum | evaluate truths results
evaluate truths/A.tum results/ours/A | a folder of one system's runs needs its name, NAME=results/ours/A \
    | evaluate truths/A.tum ours=results/ours/A
evaluate truths/A.tum results/ours/A | or give a folder of truths | evaluate truths results
evaluate truths results/ours/A/1.tum | where the truth is a folder, give systems as NAME=FOLDER \
    | evaluate truths ours=results/ours
evaluate two results | it has 2 truths for A; leave one, A.tum | evaluate truths results
evaluate truths ours=both | A is given twice, as A.csv and A.tum; keep one | evaluate truths ours=results/ours
evaluate truths results ours=results/ours | ours is given twice; give each system another name \
    | evaluate truths results theirs=results/ours
evaluate truths ours=a.toml | where the truth is a folder, give systems as NAME=FOLDER \
    | evaluate truths ours=results/ours
baseline --trajectories a.toml --truth truths --out b.json \
    | it is no folder; give one that has SEQUENCE.tum or SEQUENCE/RUN.tum \
    | {BASELINE} b.json
baseline --out b.json | name a SEQUENCE, or --trajectories DIR | {BASELINE} b.json
baseline --trajectories results/ours --out b.json | name it with --truth A=FILE.tum or --truth DIR \
    | baseline --trajectories results/ours --truth A=truths/A.tum --out b.json
{BASELINE} c.json --truth two | --truth names two folders, truths and two; give one | {BASELINE} c.json
{CHECK} results/ours --truth A=absent.tum | check the path | {CHECK} results/ours
{CHECK} results/ours --truth A=other.tum | make a new baseline | {BASELINE} c.json
check --baseline b.json | check it with --trajectories DIR | {CHECK} results/ours
{CHECK} results/ours --json c.json --markdown c.json | are files of their own; give each its name \
    | {CHECK} results/ours --json c.json --markdown c.md
evaluate truths ours=results/ours --max-dt 0.1 --out e && {EVALUATED} | evaluate again without --max-dt \
    | evaluate truths ours=results/ours --out e && {EVALUATED}
evaluate truths ours=results/ours --gap 9 --out e && {EVALUATED} | evaluate again with --gap 5 \
    | evaluate truths ours=results/ours --gap 5 --out e && {EVALUATED}
baseline --plan --trajectories truths --truth truths | give the files of repeated runs, SEQUENCE/RUN.tum \
    | baseline --plan --trajectories results/ours --truth truths
""".strip().splitlines()
]


def compared(*given: Any, **options: Any) -> Callable[[], object]:
    return lambda: toolkit.compare(*given, **options)


# The same from Python.
CALLS = [
    (compared("no", "ekf,rts"), "give several names as a list: ['ekf', 'rts']", compared("no", ["ekf", "rts"])),
    (compared(3), "give one recording: a path, a built-in name, a Sequence", compared("no")),
    (compared("no", {"my": print}), "functions build(setup) go by name into own", compared("no", own={"my": print})),
    (compared("no", own=[print]), "give a dict, by name", compared("no", own={"my": print})),
    (compared("no", own={"my": 3}), "give functions build(setup), each by a name", compared("no", own={"my": print})),
    (compared("no", ["ekf"], own={"ekf": print}), "give it another name", compared("no", ["ekf"], own={"my": print})),
    (compared("no", settings=3), "give nested values, as {'seeds': 3}", compared("no", settings={"seeds": 3})),
    (compared("no", settings={3: 1}), "for a name, 3; give a text", compared("no", settings={"seeds": 1})),
    (compared("no", resume="kept"), "and there is one seed: give seeds", compared("no", resume="kept", seeds=2)),
    (compared("no", []), "name an estimator, or a trajectory of another system", compared("no", ["ekf"])),
    (
        lambda: toolkit.explain("no", own={"my": print}),
        "give the path of a file with INGREDIENTS",
        lambda: toolkit.explain("no", "ekf", "batch"),
    ),
]
# What is followed in another test, or nothing that is typed.
ELSEWHERE = re.compile(
    r"^(install|pip|build|start|look|correct|rename|give the file another name|keep to one"
    r"|repeat|delete the line|make room|make one with|make a baseline with|name a (wheel|later one)|name another"
    r"|name one of them|allow more|change to another|film less|use the scenario's own|simulate a scene|give it more"
    r"|give a path|give (names, as)"
    r"|give one like|check the address|name the two|run one seed|choose one with|choose a format"
    r"|write a pose for each|give \{\} another name)"
)


@pytest.fixture(scope="module")
def short_run(
    tmp_path_factory: pytest.TempPathFactory, without_pixels: Callable[[], AbstractContextManager[None]]
) -> Path:
    """Return what a comparison of a few frames left."""
    run = tmp_path_factory.mktemp("short") / "run"
    words = ("compare", "drive", "--estimators", "dead-reckoning", "--max-frames", "10", "--workers", "1")
    with without_pixels():
        assert main([*words, "--out", str(run)]) == 0
    return run


@pytest.fixture
def files(vislam: Vislam, short_run: Path) -> None:
    shutil.copytree(short_run, "run")
    for name in ("truths/A.tum", "two/A/1.tum", "two/A/2.tum", "both/A.tum", "both/A.csv", "other.tum"):
        Path(name).parent.mkdir(parents=True, exist_ok=True)
        Path(name).write_text(POSES.replace("3.0 3", "3.0 3.5") if name == "other.tum" else POSES)
    Path("results/ours/A").mkdir(parents=True)
    for run in (1, 2, 3):
        Path(f"results/ours/A/{run}.tum").write_text(POSES.replace("5.0 5", f"5.0 5.{run}"))
    Path("a.toml").write_text("seeds = 1\n")
    Path("other.json").write_text("{}")
    assert vislam(*f"{BASELINE} b.json".split()) == 0


def test_every_advice_about_a_command_line_is_followed_in_a_test() -> None:
    folders = ("cli", "evaluation", "experiment", "gate", "report", "simulation")
    modules = {path for folder in folders for path in (TOOLKIT / folder).glob("*.py")}
    modules = (modules | {TOOLKIT / "api.py"}) - {TOOLKIT / "evaluation/scoring.py"}  # evaluation/test_public_cases
    told = advice_in(modules, raised=True)
    followed = [advice for _, advice, _ in (*ROWS, *CALLS)]
    assert not [one for one in told if not (ELSEWHERE.match(one) or is_followed(one, followed))]


@pytest.mark.usefixtures("files")
@pytest.mark.parametrize(("typed", "advice", "then"), ROWS, ids=[f"{one[0][:60]}" for one in ROWS])
def test_who_types_what_is_advised_is_not_refused_for_the_same_again(
    vislam: Vislam, capsys: pytest.CaptureFixture[str], typed: str, advice: str, then: str
) -> None:
    assert [vislam(*words.split()) for words in typed.split(" && ")][-1] != 0
    assert advice in "".join(capsys.readouterr())
    status = [vislam(*words.split()) for words in then.split(" && ")][-1]
    told = "".join(capsys.readouterr())
    assert advice not in told
    assert status in (0, 1) or "no: no such file" in told


@pytest.mark.parametrize(("call", "advice", "then"), CALLS, ids=[advice for _, advice, _ in CALLS])
def test_who_calls_as_is_advised_is_not_refused_for_the_same_again(
    call: Callable[[], object], advice: str, then: Callable[[], object]
) -> None:
    with pytest.raises(SettingsError, match=re.escape(advice)):
        call()
    with pytest.raises(DataError, match="no: no such file"):
        then()
