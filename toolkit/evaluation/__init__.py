"""Any systems' trajectory files against the truth, without recording or estimator: ``vislam evaluate``.

Reading order: gathering (the files) -> scoring (one file) -> standings (over runs and sequences) -> document
(evaluation.json, which the gate reads as well). Nothing here needs GTSAM.
"""
