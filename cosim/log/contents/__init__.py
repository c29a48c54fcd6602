"""What a log holds beside its rows, and how the signals of a component become messages."""
