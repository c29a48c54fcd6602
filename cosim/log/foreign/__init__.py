"""MCAP files of other tools: their topics, and numeric fields of their messages as samples."""
