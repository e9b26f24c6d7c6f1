"""Sources of samples other than files: renders, cached renders, and mixtures."""
