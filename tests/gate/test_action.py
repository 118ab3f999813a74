"""The action that gates another project's pull requests: its steps, run here as a runner runs them."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

PROJECT = Path(__file__).parents[2]
ACTION = yaml.safe_load((PROJECT / ".github/actions/check/action.yml").read_text(encoding="utf-8"))
STEPS = {step["name"]: step for step in ACTION["runs"]["steps"] if "name" in step}


@pytest.fixture
def run(tmp_path: Path):
    """Run a step in an empty workspace, with the environment of a runner and the commands of this environment."""
    (tmp_path / "temp/vislam").mkdir(parents=True)
    (tmp_path / "temp/vislam/bin").symlink_to(Path(sys.executable).parent)

    def run(name: str, **env: str) -> subprocess.CompletedProcess[str]:
        files = {
            "GITHUB_STEP_SUMMARY": "summary.md",
            "GITHUB_OUTPUT": "output",
            "GITHUB_WORKSPACE": "",
            "RUNNER_TEMP": "temp",
        }
        places = {key: str(tmp_path / value) for key, value in files.items()}
        command = ["bash", "--noprofile", "--norc", "-eo", "pipefail", "-c", STEPS[name]["run"]]
        return subprocess.run(command, env={**os.environ, **places, **env}, capture_output=True, text=True, check=False)

    return run


def baseline_of(folder: Path, runs: int) -> None:
    """Write a truth and equal runs, and their baseline."""
    poses = "".join(f"{t}.0 {t * t * 0.1} {t} 0 0 0 0 1\n" for t in range(40))
    for name in ("truth/lap.tum", *(f"results/lap/{run}.tum" for run in range(runs))):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(poses)
    words = ["baseline", "--trajectories", "results", "--truth", "truth", "--out", "base.json"]
    subprocess.run([sys.executable, "-m", "toolkit.cli", *words], cwd=folder, check=True, capture_output=True)


def test_the_check_of_the_action_passes_fails_and_says_why_in_the_summary(run, tmp_path):
    baseline_of(tmp_path, 1)
    inputs = {
        "BASELINE": "base.json",
        "TRAJECTORIES": "results",
        "TRUTH": "truth",
        "ARGUMENTS": "--accept-better --verbose",
    }
    assert run("check", **inputs).returncode == 0
    (tmp_path / "results/lap/0.tum").unlink()
    (tmp_path / "results/new.tum").write_text((tmp_path / "truth/lap.tum").read_text())
    assert run("check", **inputs).returncode == 1
    assert run("check", **{**inputs, "BASELINE": "nowhere.json"}).returncode == 3
    summary = (tmp_path / "summary.md").read_text()
    assert summary.count("## ") == 3
    assert "Nothing got worse" not in summary.partition("nowhere.json")[2]
    assert (tmp_path / "output").read_text().split() == ["passed=true", "passed=false", "passed=false"]


@pytest.mark.parametrize(("earlier", "method"), [("", "POST"), ("17", "PATCH"), (None, "")])
def test_the_comment_is_written_once_and_then_rewritten_and_one_that_may_not_be_is_a_warning(
    run, tmp_path, earlier, method
):
    answers = f'case "$*" in *--paginate*) echo "{earlier}";; *) echo "$@" >> "{tmp_path}/calls";; esac'
    (tmp_path / "gh").write_text(f"#!/bin/sh\n{'exit 1' if earlier is None else answers}\n")
    (tmp_path / "gh").chmod(0o755)
    (tmp_path / "temp/gate").mkdir()
    (tmp_path / "temp/gate/gate.md").write_text("## Accuracy gate\n\n<details>\nall\n</details>\n")
    done = run("comment", PATH=f"{tmp_path}:{os.environ['PATH']}", GITHUB_REPOSITORY="a/b", PULL_REQUEST="3")
    assert done.returncode == 0
    assert ("::warning::" in done.stdout) is (earlier is None)
    if earlier is not None:
        assert f"--method {method}" in (tmp_path / "calls").read_text()
        assert "details" not in (tmp_path / "temp/gate/comment.txt").read_text()


def test_the_documented_workflow_gives_inputs_that_the_action_has_and_all_it_requires():
    text = (PROJECT / "docs/gate.md").read_text(encoding="utf-8")
    workflow = yaml.safe_load(re.findall(r"```yaml\n(.*?)```", text, flags=re.S)[0])
    given = next(step["with"] for step in workflow["jobs"]["gate"]["steps"] if "check@" in step.get("uses", ""))
    assert set(given) <= set(ACTION["inputs"])
    assert {name for name, one in ACTION["inputs"].items() if one.get("required")} <= set(given)
    assert not [step for step in STEPS.values() if "${{" in step.get("run", "")], "an input would be part of a script"
