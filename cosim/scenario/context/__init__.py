"""What components are built with: models, files, other components, and what is kept of each."""
