"""BOP's scenewise layout: LM-O, T-LESS, YCB-V, ITODD, or a rendered data set."""
