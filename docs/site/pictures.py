"""Make the pictures of the docs again: python docs/site/pictures.py [NAME.png ...]

Each is a figure of a run that the page beside it names, with fewer colours. Those of the course need its recordings in
the folder that VISLAM_DATA names, and that of the report page a chromium.
"""

import io
import os
import subprocess
import sys
import tempfile
from functools import cache
from pathlib import Path

from PIL import Image

from toolkit.cli import main

IMAGES = Path(__file__).resolve().parents[1] / "images"
UCSD = Path(os.environ.get("VISLAM_DATA", "../shared/data")).resolve() / "ucsd"
# The page has many shades of grey; the two rounds of k-means below keep greys from a tint.
COLOURS, COLOURS_OF_PAGE = 48, 256

RUNS = {
    "kitti00": "compare kitti00 --estimators dead-reckoning,ekf,batch",
    "realistic": "compare drive-realistic",
    "bound": "compare drive --columns bound",
    "seeds": "compare drive --seeds 8 --max-frames 200 --estimators dead-reckoning,ekf,msckf-fej,ekf-slam",
    "given": f"compare {UCSD}/03.npz --estimators dead-reckoning,seed-ekf,ekf --no-repair",
    "repaired": f"compare {UCSD}/03.npz --estimators dead-reckoning,mapping,seed-ekf,ekf,batch",
    "stress": "sweep drive --each --seeds 8 --to 20s --over fault:outlier_tracks=0.05,0.15,0.3,0.6 "
    "--over fault:few_tracks=3,6,12,25 --over fault:camera_clock=0.01,0.02,0.05,0.1 "
    "--over fault:turned_camera=0.003,0.01,0.03,0.1 --over fault:wrong_noise=0.25,0.5,2,4",
    "ten": f"compare {UCSD}/10_imu_only.npz --estimators dead-reckoning",
}
FIGURES = {
    "kitti00.png": ("kitti00", "figures/top_all.png"),
    "errors_over_time.png": ("realistic", "figures/errors_over_time.png"),
    "components_ekf.png": ("realistic", "figures/components_ekf.png"),
    "components_batch.png": ("realistic", "figures/components_batch.png"),
    "against_bound.png": ("bound", "figures/against_bound.png"),
    "nees_over_seeds.png": ("seeds", "figures/nees_over_seeds.png"),
    "report_page.png": ("realistic", "page.png"),
    "course_a.png": ("repaired", "figures/top_dead-reckoning.png"),
    "course_b.png": ("repaired", "figures/top_mapping.png"),
    "course_c_given.png": ("given", "figures/top_seed-ekf.png"),
    "course_c_repaired.png": ("repaired", "figures/top_all.png"),
    "course_10.png": ("ten", "figures/top_dead-reckoning.png"),
    **{
        f"stress_{fault}.png": ("stress", f"figures/sweep_fault_{fault}.png")
        for fault in ("outlier_tracks", "few_tracks", "camera_clock", "turned_camera", "wrong_noise")
    },
}


@cache
def run(name: str, folder: Path) -> Path:
    """Return the run directory of a name, made in a folder."""
    out = folder / name
    words = RUNS[name].split()
    status = main([*words, *(["--figures", "all"] if words[0] == "compare" else []), "--out", str(out)])
    if status not in (0, 1):  # 1: an estimator diverged, which a page may be about
        raise SystemExit(status)
    return out


def photograph(directory: Path) -> None:
    """Write page.png, the top of a run's report page."""
    main(["report", str(directory)])
    page = f"--screenshot={directory / 'page.png'}", f"file://{directory / 'report.html'}"
    options = ["--headless=new", "--no-sandbox", "--hide-scrollbars", "--virtual-time-budget=5000"]
    subprocess.run(["chromium", *options, "--window-size=1400,1500", *page], check=True, timeout=60)


def small(picture: Path, colours: int) -> bytes:
    """Return a picture with few colours, chosen so that a thin line in a colour of its own keeps it."""
    few = Image.open(picture).convert("RGB").quantize(colours, Image.Quantize.MAXCOVERAGE, 2, dither=Image.Dither.NONE)
    few.save(written := io.BytesIO(), "PNG", optimize=True)
    return written.getvalue()


def make(names: list[str]) -> None:
    """Make the pictures of the names, or all."""
    with tempfile.TemporaryDirectory() as folder:
        for name in names or FIGURES:
            directory = run(FIGURES[name][0], Path(folder))
            is_page = FIGURES[name][1] == "page.png"
            if is_page:
                photograph(directory)
            data = small(directory / FIGURES[name][1], COLOURS_OF_PAGE if is_page else COLOURS)
            (IMAGES / name).write_bytes(data)
            print(f"{name}: {len(data) / 1000:.0f} kB")


if __name__ == "__main__":
    make(sys.argv[1:])
