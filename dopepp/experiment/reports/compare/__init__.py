"""Several results side by side: one table, how sure its differences are, curves and pictures."""
