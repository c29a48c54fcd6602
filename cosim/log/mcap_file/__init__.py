"""An MCAP file, whatever is in it: records, chunks, the summary, and how it stays whole."""
