"""Any systems' trajectory files against the truth, without recording or estimator: ``vislam evaluate``.

Reading order: gathering (which files there are) -> scoring (one file) -> standings (over runs and sequences) ->
document (what is kept, and what the gate reads of it). Nothing here needs GTSAM.
"""
