"""Faults of time: stamps that repeat, jump or are uneven, gaps in the samples, clocks that differ.

Read ``time_order`` for the stamps themselves, ``time_gap`` and ``motion_gap`` for gaps, ``sparse_motion`` for samples
that come too rarely, ``outside_motion`` for frames that no sample covers, and ``uneven_stamps``; then ``time_offset``
for a constant offset of two clocks, ``clock_jump`` and ``clock_change`` for clocks that are set or drift during the
recording, and ``twist_lag``.
"""
