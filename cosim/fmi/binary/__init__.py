"""The FMI calls of an FMU's binary, version by version, behind one protocol."""
