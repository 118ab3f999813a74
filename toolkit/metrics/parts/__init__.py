"""Parts of the metric files; no file here is a metric.

Read ``scores`` (what a metric file declares and returns), ``evaluation`` (one output of a run and its sequence) and
``against_truth`` (association, alignment, errors of pairs). ``consistency`` computes NEES of the pose and NIS, without
GTSAM, ``readings`` which convention the covariances of a file are in, ``state_errors`` the errors of the whole state,
``leave_one_out`` predicts withheld sightings, ``cramer_rao`` is the bound.
"""
