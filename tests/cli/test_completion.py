"""The scripts of ``vislam completion`` are whole, and bash completes with its own."""

import shutil
import subprocess

import pytest

from toolkit.cli import main


def script(shell: str, capsys: pytest.CaptureFixture[str]) -> str:
    assert main(["completion", shell]) == 0
    return capsys.readouterr().out


def completed(text: str, *words: str) -> list[str]:
    """Return what bash offers for the last of the words."""
    line = " ".join(f"'{word}'" for word in words)
    program = f"{text}\nCOMP_WORDS=(vislam {line}); COMP_CWORD={len(words)}; _vislam; echo ${{COMPREPLY[@]}}"
    messages = subprocess.run(["bash", "-c", program], capture_output=True, text=True, check=True)
    return messages.stdout.split()


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
def test_bash_completes_commands_options_and_choices(capsys) -> None:
    text = script("bash", capsys)
    assert completed(text, "comp") == ["compare", "completion"]
    assert completed(text, "evaluate", "--max") == ["--max-dt"]
    assert completed(text, "evaluate", "--format", "m") == ["markdown"]
    assert completed(text, "simulate", "dr") == ["drive", "drive-imu", "drive-realistic"]
    assert completed(text, "report", "runs/") == []  # files, which bash itself completes


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
def test_bash_completes_the_names_that_are_known_here_also_in_a_list(capsys) -> None:
    text = script("bash", capsys)
    assert completed(text, "compare", "--estimators", "msckf-f") == ["msckf-fej"]
    assert completed(text, "compare", "--estimators", "ekf,msckf-s") == ["ekf,msckf-slam"]
    assert completed(text, "compare", "fli") == ["flight", "flight-realistic"]
    assert completed(text, "compare", "--keep", "time-off") == ["time-offset"]
    assert completed(text, "compare", "--set", "noise.pix") == ["noise.pixel_sigma_px="]
    assert completed(text, "evaluate", "--metric", "ate_se3_m") == ["ate_se3_m"]
    assert completed(text, "tracks", "dri") == []  # it draws images, which no built-in sequence has


@pytest.mark.parametrize("shell", ["zsh", "fish"])
def test_the_scripts_of_other_shells_have_every_command(shell: str, capsys) -> None:
    text = script(shell, capsys)
    for command in ("compare", "evaluate", "diff", "verify", "cite"):
        assert command in text
    if shutil.which(shell):
        subprocess.run([shell, "-n"], input=text, text=True, check=True)
