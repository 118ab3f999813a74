"""The promises of every estimator as checks, for ``vislam verify`` and for the contract tests.

Reading order: promises (a recorded run, and each property that it must have) -> threads -> subject (finds the
estimator) -> verification (all checks of one estimator).
"""
