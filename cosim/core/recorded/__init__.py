"""What can be read of a finished run, in memory and from file alike: signals, parts, tables."""
