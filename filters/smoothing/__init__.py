"""Parts of the GTSAM smoothers: keys, factors, robust schedules."""
