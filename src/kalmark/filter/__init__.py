"""The stochastic map and the estimators that correct it."""
