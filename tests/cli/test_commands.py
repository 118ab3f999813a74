"""What the subcommands do when all is well."""

import json
import re
from collections.abc import Callable
from pathlib import Path

import pytest

from toolkit import audit
from toolkit.audit import Audit, Finding
from toolkit.experiment import recording
from toolkit.report.records import read_metrics
from toolkit.report.run_directory import unique_names

Vislam = Callable[..., int]
pytestmark = pytest.mark.usefixtures("unrendered")

# Nobody looks at the figures here: drawing them takes as long as all else.
DEAD_RECKONING = ("--estimators", "dead-reckoning", "--max-frames", "10", "--workers", "1", "--figures", "none")


def test_several_sequences_get_a_directory_each(vislam: Vislam) -> None:
    assert vislam("compare", "drive", "drive-imu", "drive", *DEAD_RECKONING, "--out", "all") == 0
    assert sorted(path.name for path in Path("all").iterdir()) == ["drive", "drive-2", "drive-imu"]
    for path in Path("all").iterdir():
        assert read_metrics(path / "metrics.json").runs


def test_several_sequences_take_the_place_of_an_earlier_run_of_theirs(vislam: Vislam) -> None:
    for _ in range(2):
        assert vislam("compare", "drive", "drive-imu", *DEAD_RECKONING, "--out", "all") == 0
    Path("file").touch()
    assert vislam("compare", "drive", "drive-imu", *DEAD_RECKONING, "--out", "file") == 4


def test_results_go_to_a_new_directory_each_time(vislam: Vislam) -> None:
    for _ in range(2):
        assert vislam("compare", "drive", *DEAD_RECKONING) == 0
    assert len(list(Path("runs").iterdir())) == 2


def test_the_command_is_in_the_manifest(vislam: Vislam) -> None:
    vislam("compare", "drive", *DEAD_RECKONING, "--out", "with space", "--seed", "2")
    manifest = json.loads(Path("with space/manifest.json").read_text())
    assert manifest["command"].endswith("--out 'with space' --seed 2")
    assert manifest["seeds"] == {"sequence": 2}


def test_a_start_from_the_truth_is_labelled(vislam: Vislam, capsys: pytest.CaptureFixture[str]) -> None:
    assert vislam("compare", "drive", *DEAD_RECKONING, "--start", "truth", "--out", "run") == 0
    assert "started from the truth" in capsys.readouterr().out


def test_list_counts_every_kind_and_names_all_of_one(vislam: Vislam, capsys: pytest.CaptureFixture[str]) -> None:
    assert vislam("list") == 0
    counts = re.findall(r"^ *(\d+) (\w+)", capsys.readouterr().out, flags=re.MULTILINE)
    listed = {kind: (vislam("list", kind), capsys.readouterr().out)[1] for _, kind in counts}
    for count, kind in counts:
        assert len(re.findall(r"^\S", listed[kind], flags=re.MULTILINE)) == int(count), kind
    names = {"estimators": ["dead-reckoning"], "sequences": ["kitti00", "drive"], "metrics": ["ate_se3_m"]}
    names |= {"faults": list(audit.faults()), "settings": ["window.lag_s"], "formats": ["euroc"]}
    for kind, some in names.items():
        assert {*some} <= {line.split()[0] for line in listed[kind].splitlines()}


def test_list_answers_an_unknown_kind_with_those_there_are(vislam: Vislam, one_line: Callable[[], str]) -> None:
    assert vislam("list", "cameras") == 2
    assert "estimators, metrics, faults" in one_line()


def test_a_simulated_recording_can_be_compared(vislam: Vislam) -> None:
    assert vislam("simulate", "flight", "--out", "recordings/flight", "--seed", "3", "--duration", "2") == 0
    assert vislam("check-data", "recordings/flight") == 0
    assert vislam("compare", "recordings/flight", *DEAD_RECKONING, "--out", "run") == 0


@pytest.mark.parametrize(("repaired", "blocking", "status"), [(True, False, 0), (False, True, 1), (False, False, 0)])
def test_check_data_fails_on_a_fault_that_stays(
    vislam: Vislam,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    *,
    repaired: bool,
    blocking: bool,
    status: int,
) -> None:
    finding = Finding("time-gap", 2, repaired, "two frames are 3 s apart", blocking)
    monkeypatch.setattr(recording, "audit", lambda sequence, _keep: Audit(sequence, (finding,)))
    assert vislam("check-data", "drive") == status
    messages = capsys.readouterr().out
    assert "time-gap" in messages
    assert finding.detail in messages
    assert ("not repaired" in messages) == blocking


def test_check_data_says_what_was_done_to_read_the_recording(
    vislam: Vislam, capsys: pytest.CaptureFixture[str]
) -> None:
    """Images that cannot be used are left out, and tracks simulated where there are none: no fault, and to be known."""
    assert vislam("simulate", "flight", "--images", "--duration", "0.4", "--out", "film") == 0
    sorted(Path("film/mav0/cam0/data").iterdir())[3].write_bytes(b"")
    vislam("check-data", "film")
    assert "facts: " in (messages := capsys.readouterr().out)
    assert "1 of 9 image pairs could not be used and are left out" in " ".join(messages.split())


def test_keep_reaches_the_audit(vislam: Vislam, monkeypatch: pytest.MonkeyPatch) -> None:
    kept: list[frozenset[str]] = []
    first, second = list(audit.faults())[:2]

    def listening(sequence: object, keep: frozenset[str]) -> Audit:
        kept.append(keep)
        return Audit(sequence, ())

    monkeypatch.setattr(recording, "audit", listening)
    vislam("check-data", "drive")
    vislam("check-data", "drive", "--no-repair")
    vislam("check-data", "drive", "--keep", f"{first},{second}")
    assert kept == [frozenset(), frozenset(audit.faults()), frozenset({first, second})]


def test_directory_names_are_plain_and_differ() -> None:
    assert unique_names(["drive", "a/b c", "drive", "..", "drive"]) == [
        "drive",
        "a_b_c",
        "drive-2",
        "sequence",
        "drive-3",
    ]


@pytest.mark.parametrize(
    ("requested", "expected"),
    [
        (["--lens", "radtan"], "--lens is of images; add --images"),
        (["--images", "--blur", "50"], "expected milliseconds from 0 to 40"),
        (["--images", "--lens", "fov"], "fov"),
    ],
)
def test_what_images_cannot_be_is_a_line(
    vislam: Vislam, capsys: pytest.CaptureFixture[str], requested: list[str], expected: str
) -> None:
    assert vislam("simulate", "flight", "--out", "filmed", *requested) == 2
    assert expected in capsys.readouterr().err
    assert not Path("filmed").exists()


def test_a_scenario_of_points_gives_no_images(vislam: Vislam, capsys: pytest.CaptureFixture[str]) -> None:
    assert vislam("simulate", "drive", "--images", "--out", "filmed") == 2
    assert "flight has" in capsys.readouterr().err
