"""Faults of time: stamps that repeat, leap or come unevenly, holes in the samples, clocks apart.

Read ``time_order`` for the stamps themselves, ``time_gap`` and ``motion_gap`` for holes, ``sparse_motion`` for samples
that come too rarely, ``outside_motion`` for frames that no sample reaches, ``uneven_stamps``; then ``time_offset`` for
two clocks beside one another, ``clock_jump`` and ``clock_change`` for clocks that are set under way, ``twist_lag``.
"""
