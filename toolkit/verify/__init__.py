"""What every estimator promises, whoever wrote it, as checks: for ``vislam verify`` and for the contract tests alike.

Reading order: promises (a run with all that went in and came out, what must hold of it) -> threads -> subject (whose
estimator it is) -> verification (all of it, of one estimator).
"""
