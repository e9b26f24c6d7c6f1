"""Where samples come from besides files: renders, kept renders, and mixtures."""
