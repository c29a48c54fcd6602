"""The dataset of a study: what its members came to, as columns, in a folder or an object store."""
