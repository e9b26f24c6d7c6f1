"""BOP-WebDataset: tar shards of which any image can be read at random."""
