"""Faults of what a run is compared with: the truth and the direction of gravity.

Read ``truth_mismatch`` (a truth of another recording or frame), ``truth_clock`` (by a clock of another pace) and
``gravity_direction`` (a first orientation that gravity contradicts).
"""
