"""Built-in simulated recordings: drive, drive-imu and flight, and with realistic tracks, made afresh from a seed."""

from collections.abc import Callable, Mapping
from functools import partial

from toolkit.sequence import Sequence
from toolkit.simulation import SCENARIOS, simulate

BUILT_IN: Mapping[str, Callable[[int], Sequence]] = {
    name: partial(simulate, scenario) for name, scenario in SCENARIOS.items()
}
