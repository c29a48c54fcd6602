"""The certificate of a run: how large the error of its communication step is."""
