"""Parts of the metric files; no file here is a metric.

Read ``scores`` (what a metric file declares and returns), ``evaluation`` (one output of a run and its sequence), then
``association``, ``alignment`` and ``residuals``; ``consistency`` computes NEES and NIS of the pose, ``state_errors``
the errors of the whole state, ``leave_one_out`` the held-out prediction, ``cramer_rao`` the bound from
``sound_sightings`` and ``information_filter``.
"""
