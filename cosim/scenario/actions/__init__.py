"""What happens in a run: actions, the parameters that they set, components that they swap."""
