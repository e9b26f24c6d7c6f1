"""What everything stands on, nothing of the field: errors, files, JSON, YAML, interruption."""
