"""What happens beside a training step: one class and one line of YAML each."""
