"""Search the values of some keys that minimize a metric; every trial is a member of a study."""
