"""Where the notebooks find real recordings, and what stands in for one that is not there."""

import os
from pathlib import Path

PROJECT = Path(__file__).resolve().parents[1]


def real(name: str) -> Path | None:
    """Return a real recording below the folder VISLAM_DATA (from the repository: ../shared/data), or None."""
    path = (PROJECT / os.environ.get("VISLAM_DATA", "../shared/data") / name).resolve()
    return path if path.exists() else None
