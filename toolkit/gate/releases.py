"""Which releases a baseline was made with, and whether this installation has the same."""

from collections.abc import Mapping
from importlib.metadata import version

# Another GTSAM may linearise otherwise, another NumPy draw otherwise; NumPy's third number is for repairs alone.
_DIGITS_THAT_MATTER = {"gtsam": 3, "numpy": 2}


def installed() -> dict[str, str]:
    """Return the releases that results depend on, as they are installed."""
    return {name: version(name) for name in _DIGITS_THAT_MATTER}


def differences(releases: Mapping[str, str]) -> tuple[str, ...]:
    """Say what here is another release than in a baseline; nothing where all that matters is the same."""
    return tuple(
        f"{name} {releases.get(name, '(not given)')}, here {here}"
        for name, here in installed().items()
        if _matters(name, releases.get(name, "")) != _matters(name, here)
    )


def _matters(name: str, release: str) -> list[str]:
    return release.split(".")[: _DIGITS_THAT_MATTER[name]]


def label() -> str:
    """Return the installed releases as part of a file name."""
    return "_".join(f"{name}-{'.'.join(_matters(name, release))}" for name, release in installed().items())
