"""What makes a recovered pose precise."""
