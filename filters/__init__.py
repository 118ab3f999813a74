"""The estimators, side by side: a file is an estimator, a folder holds parts."""
