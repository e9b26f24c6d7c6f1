"""Jobs of a run: training, evaluation, tuning, export, resuming and tracking."""
