"""Run studies: plan them, run what is missing, keep logs."""
