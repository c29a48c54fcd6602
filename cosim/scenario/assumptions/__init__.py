"""The assumptions of the method that a scenario rests on, one by one."""
