"""Logs read: pieces of the file, checked; rows; a run as arrays."""
