"""The photoreal renderer: path tracing by Mitsuba 3 (extra ``photoreal``)."""
