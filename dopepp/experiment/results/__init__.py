"""What was measured: reports, conditions, tables and comparisons."""
