"""Measurement and motion models that filters and smoothers share: pure functions with Jacobians, vectorised."""
