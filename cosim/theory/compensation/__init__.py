"""The controller that uses the estimates: state feedback, feedforward, an internal model."""
