"""The central controller: robot model, whole-body operational space control, tasks, behaviours, estimators."""
