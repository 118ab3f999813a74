"""Parts of the metric files; no file here is a metric.

Read ``scores`` (what a metric file declares and returns), ``evaluation`` (one output of a run and its sequence), then
``association``, ``alignment`` and ``residuals``; ``consistency`` computes NEES and NIS, ``leave_one_out`` the held-out
prediction, ``cramer_rao`` the bound.
"""
