"""Any systems' trajectory files against the truth, without recording or estimator: ``vislam evaluate``.

Reading order: gathering (the files) -> scoring (one file) -> standings (over runs and sequences, and
evaluation.json) -> against_baseline (the accuracy gate for such files, which alone needs GTSAM).
"""
