"""Simulated recordings with exact truth: a smooth trajectory, landmarks to look at, and sensors with known noise.

Read ``scenarios`` (what is simulated, and ``simulate``), then ``scenes`` (trajectory, of B-splines, and landmarks of
each) and ``sensors`` (visibility, tracks and noise). ``faults`` plants faults in a recording.
``filming`` renders images instead of tracks, with ``renderer`` (which has the visible world), and measures the
errors of tracks made of them.
"""

from toolkit.simulation import faults as faults
from toolkit.simulation.scenarios import DRIVE as DRIVE
from toolkit.simulation.scenarios import DRIVE_IMU as DRIVE_IMU
from toolkit.simulation.scenarios import DRIVE_REALISTIC as DRIVE_REALISTIC
from toolkit.simulation.scenarios import FLIGHT as FLIGHT
from toolkit.simulation.scenarios import FLIGHT_REALISTIC as FLIGHT_REALISTIC
from toolkit.simulation.scenarios import SCENARIOS as SCENARIOS
from toolkit.simulation.scenarios import Scenario as Scenario
from toolkit.simulation.scenarios import noise_free as noise_free
from toolkit.simulation.scenarios import simulate as simulate
