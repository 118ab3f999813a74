"""What every estimator promises, whoever wrote it, as checks: for ``vislam verify`` and for the contract tests alike.

Reading order: watching (a run with all that went in and came out) -> promises (what must hold of it) -> trouble (what a
recording may hold) -> threads -> verification (all of it, of one estimator).
"""
