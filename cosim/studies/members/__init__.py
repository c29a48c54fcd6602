"""Members of a study, run one after the other in this process."""
