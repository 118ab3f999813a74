"""A bundle holds what repeats a run; reproducing it says what differs, and a damaged one is told in one line."""

import hashlib
import json
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

from toolkit.cli import main
from toolkit.errors import DataError
from toolkit.report import export
from toolkit.report.export import installed_packages, unpack_bundle

COMPARE = ("compare", "drive", "--estimators", "dead-reckoning", "--max-frames", "8", "--workers", "1", "--seed", "3")


@pytest.fixture(scope="module")
def bundle(tmp_path_factory: pytest.TempPathFactory, without_pixels) -> Path:
    root = tmp_path_factory.mktemp("bundle")
    with without_pixels():
        assert main([*COMPARE, "--set", "noise.motion_scale=1.25", "--out", str(root / "run")]) == 0
    assert main(["export", str(root / "run"), "--bundle", str(root / "run.zip")]) == 0
    return root / "run.zip"


@pytest.fixture
def reproduce(tmp_path: Path, monkeypatch, capsys, without_pixels) -> Callable[..., tuple[int, str, str]]:
    """Reproduce a bundle in an empty folder; return the exit status and what was said."""
    monkeypatch.chdir(tmp_path)
    capsys.readouterr()

    def run(*words: str) -> tuple[int, str, str]:
        with without_pixels():
            status = main(["reproduce", *words, "--workers", "1"])
        return status, *capsys.readouterr()

    return run


def edited(bundle: Path, target: Path, edit: Callable[[dict[str, bytes]], None]) -> Path:
    """Write a bundle with other contents."""
    with zipfile.ZipFile(bundle) as archive:
        contents = {name: archive.read(name) for name in archive.namelist()}
    edit(contents)
    with zipfile.ZipFile(target, "w") as archive:
        for name, content in contents.items():
            archive.writestr(name, content)
    return target


def with_hashes(contents: dict[str, bytes]) -> None:
    """Have bundle.json agree with the contents again."""
    record = json.loads(contents["bundle.json"])
    record["files"] = {name: hashlib.sha256(contents[name]).hexdigest() for name in record["files"]}
    contents["bundle.json"] = json.dumps(record).encode()


def test_it_holds_settings_versions_hashes_trajectories_and_metrics_and_is_reproduced(
    bundle: Path, reproduce, tmp_path: Path
) -> None:
    with zipfile.ZipFile(bundle) as archive:
        names = set(archive.namelist())
        lock = archive.read("requirements.txt").decode()
    assert {"bundle.json", "manifest.json", "metrics.json", "trajectories/dead-reckoning_causal.tum"} <= names
    assert not any(name.startswith("figures/") for name in names)
    record = unpack_bundle(bundle, tmp_path)
    assert record.packages == installed_packages()
    assert f"numpy=={record.packages['numpy']}\n" in lock
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert record.hashes == (metrics["sequence"]["hash"],)
    assert json.loads((tmp_path / "manifest.json").read_text())["settings"]["noise"]["motion_scale"] == 1.25
    status, messages, _ = reproduce(str(bundle), "--out", "here")
    assert (status, "run.zip: reproduced" in messages) == (0, True)
    assert Path("here/metrics.json").is_file()


def test_a_result_that_is_another_one_is_reported(bundle: Path, reproduce, tmp_path: Path) -> None:
    def change(contents: dict[str, bytes]) -> None:
        metrics = json.loads(contents["metrics.json"])
        metrics["runs"][0]["metrics"]["ate_se3_m"] *= 1.01
        metrics["sequence"]["hash"] = "0" * 64
        manifest = json.loads(contents["manifest.json"])
        manifest["versions"]["numpy"] = "1.0"
        manifest["sequence"]["hash"] = "0" * 64
        contents["metrics.json"], contents["manifest.json"] = (json.dumps(d).encode() for d in (metrics, manifest))
        with_hashes(contents)

    status, messages, _ = reproduce(str(edited(bundle, tmp_path / "other.zip", change)))
    assert status == 1
    for word in ("versions.numpy", "sequence.hash", "ate_se3_m", "not reproduced"):
        assert word in messages
    assert not list(tmp_path.glob("runs*"))


@pytest.mark.parametrize(
    ("edit", "expected"),
    [
        (lambda c: c.update({"metrics.json": b"{}"}), "metrics.json is not as it was when the bundle was made"),
        (lambda c: c.pop("metrics.json"), "metrics.json is missing"),
        (lambda c: c.pop("bundle.json"), "a zip archive without bundle.json"),
        (
            lambda c: c.update({"bundle.json": c["bundle.json"].replace(b'"metrics.json"', b'"../metrics.json"')}),
            "no path inside a run directory",
        ),
    ],
)
def test_a_damaged_bundle_is_reported_in_one_line(bundle: Path, reproduce, tmp_path: Path, edit, expected: str) -> None:
    status, _, reported = reproduce(str(edited(bundle, tmp_path / "bad.zip", edit)))
    assert status == 3
    assert expected in reported
    assert reported.count("\n") == 1


def test_a_bundle_that_would_unpack_to_more_than_its_limit_is_not_unpacked(
    bundle: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(export, "_MOST_BYTES", 1000)
    with pytest.raises(DataError, match="would unpack to more than"):
        unpack_bundle(bundle, tmp_path / "out")
    assert not (tmp_path / "out").exists()
