"""Components that advance together in one call."""
