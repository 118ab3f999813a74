"""Faults of the truth, with which runs are compared, and of the direction of gravity in its world.

Read ``truth_mismatch`` (a truth of another motion, frame or unit), ``truth_clock`` (stamps by a clock of another rate)
and ``gravity_direction`` (the truth's world against the IMU).
"""
