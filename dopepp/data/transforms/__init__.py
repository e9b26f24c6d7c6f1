"""What happens to a sample before it is learned from or measured."""
