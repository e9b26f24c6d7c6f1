"""YCB-Video's own layout."""
