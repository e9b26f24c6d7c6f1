"""Typed descriptions of random scenes; every range is checked."""
