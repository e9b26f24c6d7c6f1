"""``search=optuna``: jobs of a multirun whose options a study chooses."""
