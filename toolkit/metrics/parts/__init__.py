"""Parts of the metric files; no file here is a metric.

Read ``scores`` (what a metric file declares and returns) and ``evaluation`` (one output of a run and its sequence;
association, alignment, errors of pairs). ``consistency`` has the errors of the whole state, NEES and NIS, without
GTSAM, ``readings`` which convention the covariances of a file are in, ``leave_one_out`` predicts withheld sightings,
``cramer_rao`` is the bound.
"""
