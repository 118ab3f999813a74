"""Truths and trajectories of made-up systems as files."""

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from toolkit.cli import main
from toolkit.datasets.trajectories import tum
from toolkit.estimate import Trajectory
from toolkit.geometry import Array, IntArray, se3, se3_exp, so3_exp

START_NS, S = 1_700_000_000 * 10**9, 10**9
OWN_WORLD = se3(so3_exp(np.array([0.0, 0.0, 0.7])), np.array([3.0, -2.0, 1.0]))


def poses_at(t_ns: IntArray) -> Array:
    """A vehicle on a wavy circle of 40 m that rolls and pitches and looks where it goes (N, 4, 4), a lap a minute."""
    angle = 2.0 * np.pi * (t_ns - START_NS) / S / 60.0
    turned = so3_exp(np.stack([0.1 * np.sin(9.0 * angle), 0.08 * np.cos(7.0 * angle), angle + np.pi / 2.0], axis=-1))
    return se3(turned, np.stack([20.0 * np.cos(angle), 20.0 * np.sin(angle), np.sin(2.0 * angle)], axis=-1))


def stamps(rate_hz: float, begin_s: float = 0.0, end_s: float = 60.0) -> IntArray:
    return START_NS + np.arange(round(begin_s * S), round(end_s * S), round(S / rate_hz), dtype=np.int64)


def estimated(t_ns: IntArray, error: float, seed: int = 0) -> Array:
    """What a system with errors of so many metres and centiradians says, in its own world (N, 4, 4)."""
    errors = error * np.random.default_rng(seed).standard_normal((t_ns.size, 6)) * np.repeat([0.01, 1.0], 3)
    return OWN_WORLD @ poses_at(t_ns) @ se3_exp(errors)


def write(path: str | Path, t_ns: IntArray, poses: Array) -> Path:
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_text(tum.text(Trajectory(t_ns, poses)))
    return target


def runs_in(folder: str = "out") -> list[dict[str, Any]]:
    return list(json.loads(Path(folder, "evaluation.json").read_text())["runs"])


def run_of(vislam: Callable[..., int], *words: str) -> dict[str, Any]:
    """Evaluate a file against truth.tum, and return the one run."""
    assert vislam("evaluate", "truth.tum", *words, "--out", "out", "--quiet") == 0
    (run,) = runs_in()
    return run


@pytest.fixture(scope="session")
def scene() -> SimpleNamespace:
    """The functions that make the files."""
    return SimpleNamespace(poses_at=poses_at, stamps=stamps, estimated=estimated, write=write, own_world=OWN_WORLD)


@pytest.fixture
def vislam(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., int]:
    """Run a command in an empty folder but for a truth, truth.tum; figures, which take long, only where asked for."""
    monkeypatch.chdir(tmp_path)
    write("truth.tum", stamps(20.0), poses_at(stamps(20.0)))

    def run(*words: str) -> int:
        unseen = words[0] == "evaluate" and "--figures" not in words
        return main([*words, *(("--figures", "none") if unseen else ())])

    return run


@pytest.fixture
def tree(vislam: Callable[..., int]) -> Callable[..., int]:
    """Two systems in three runs on seven sequences of 10 s, the first with half the error of the second."""
    t_ns = stamps(10.0, end_s=10.0)
    for sequence in range(7):
        write(f"truths/S{sequence}.tum", t_ns, poses_at(t_ns))
        for system, error in (("good", 0.1), ("poor", 0.2)):
            for run in range(3):
                path = f"results/{system}/S{sequence}/{run}.tum"
                write(path, t_ns, estimated(t_ns, error, 100 * sequence + run))
    return vislam
