"""Test benches of the estimators: known truth, stated errors, and what each estimator makes of them."""
