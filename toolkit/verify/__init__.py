"""The promises of every estimator as checks, for ``vislam verify`` and for the contract tests.

Reading order: promises (which estimator, its recorded run, and each property that it must have) -> threads ->
verification (all checks of one estimator).
"""
